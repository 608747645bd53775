"""One run of a benchmark: its scene prepared, trained, measured. Each part keeps what
it has done, so a killed run goes on.

The clock of the training stands still while snapshots are written, and measuring comes
after it.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import replace

import numpy as np
import torch

from hdr_nsff.bench.curve import SHARES, curve_of
from hdr_nsff.bench.plan import BenchRun, BenchScene
from hdr_nsff.core import notes
from hdr_nsff.core.checkpoints import latest_checkpoint
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.notes import RunRecord, Trained
from hdr_nsff.core.process import peak_memory
from hdr_nsff.core.progress import say
from hdr_nsff.core.tensors import to_device
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.prepare.prepare import prepare
from hdr_nsff.rendering.shots import device_of
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train

FRAMES = 5  # rendered to time it
ENOUGH = 10.0  # seconds after which no further one is


def get_ready(scene: BenchScene) -> None:
    """Prepare a scene, once however many processes ask for it."""
    if scene.footage is None or scene.ready:
        return
    with lock_output(scene.folder, wait=True):
        prepare(scene.footage)


def run_cell(cell: BenchRun, views: int, lpips: str | None) -> None:
    """All of a run that is not done yet. What makes it fail is kept in `failure.json`,
    and raised.
    """
    with lock_output(cell.folder):
        (cell.folder / "failure.json").unlink(missing_ok=True)
        try:
            get_ready(cell.scene)
            train_cell(cell, views)
            measure_cell(cell, views, lpips)
        except Exception as error:
            told = str(error).strip().splitlines()[-1:] or [""]
            reason = (
                told[0] if isinstance(error, InputError) else f"{type(error).__name__}: {told[0]}"
            )
            notes.write(
                cell.folder / "failure.json", notes.Failure(reason=reason, log=os.environ.get(LOG))
            )
            raise


LOG = "HDR_NSFF_BENCH_LOG"  # environment: where what this process says is written


def read_trial(cell: BenchRun) -> RunRecord:
    """What is known of a run."""
    return notes.read(cell.folder / "trial.json", RunRecord) or RunRecord(scene_key=cell.scene.key)


def measure_key(cell: BenchRun, views: int, lpips: str | None) -> str:
    """A hash of what a run is measured on, and how."""
    truth = cell.scene.truth
    told = hashlib.sha256((truth / "truth.json").read_bytes()).hexdigest() if truth else None
    return hashlib.sha256(json.dumps([told, lpips, views]).encode()).hexdigest()[:16]


def complete(cell: BenchRun, views: int, lpips: str | None) -> bool:
    """Whether nothing is left to do."""
    if not cell.scene.ready or not (cell.folder / "metrics.json").is_file():
        return False
    return read_trial(cell).measured == measure_key(cell, views, lpips)


def train_cell(cell: BenchRun, views: int) -> None:
    """Train, and note what it took."""
    trial = read_trial(cell)
    if trial.trained is not None:
        return
    notes.write(cell.folder / "trial.json", trial)  # what it is trained on
    start = time.monotonic()
    found = latest_checkpoint(cell.folder)
    train(cell.config, keep_at=SHARES if views else (), previews=False)
    wall = time.monotonic() - start
    memory = peak_memory()
    run = Run.open(cell.folder, cell.config.device)
    device = device_of(run)
    cuda = device.type == "cuda"
    trained = Trained(
        steps=run.step,
        seconds=round(run.seconds, 3),
        start_seconds=round(max(wall - (run.seconds - (found.seconds if found else 0.0)), 0.0), 3),
        memory=memory,
        gpu_memory=torch.cuda.max_memory_allocated(device) if cuda else None,
        device=torch.cuda.get_device_name(device) if cuda else "cpu",
        threads=int(os.environ.get("OMP_NUM_THREADS") or torch.get_num_threads()),
        frame_seconds=frame_seconds(run),
    )
    notes.write(cell.folder / "trial.json", trial.model_copy(update={"trained": trained}))


def measure_cell(cell: BenchRun, views: int, lpips: str | None) -> None:
    """Evaluate the run, and on a few views what it was on the way."""
    key, trial, start = measure_key(cell, views, lpips), read_trial(cell), time.monotonic()
    if trial.measured == key and (cell.folder / "metrics.json").is_file():
        return
    run, truth = Run.open(cell.folder, cell.config.device), cell.scene.truth
    evaluate_run(run, truth, lpips)
    curve, shown = curve_of(run, truth, views) if views else ([], [])
    seconds = round(time.monotonic() - start, 2)
    update = {"measured": key, "seconds": seconds, "curve": curve, "shown": shown}
    notes.write(cell.folder / "trial.json", trial.model_copy(update=update))


@torch.no_grad()
def frame_seconds(run: Run) -> float:
    """Median seconds to render a frame of the scene: radiance, depth and motion,
    nothing written.
    """
    frames = run.scene.train[:: max(1, len(run.scene.train) // FRAMES)][:FRAMES]
    small = replace(
        frames[0],
        camera=frames[0].camera.resized(frames[0].camera.width // 4, frames[0].camera.height // 4),
    )
    taken: list[float] = []
    for warm, frame in (
        (True, small),
        *((False, f) for f in frames),
    ):  # the first compiles the kernels
        camera, start = to_device(frame.camera, device_of(run)), time.perf_counter()
        seen = run.field.render(camera, frame.time)
        float(seen.radiance[0, 0])  # a GPU has finished by then
        taken += [] if warm else [time.perf_counter() - start]
        if sum(taken) > ENOUGH:
            break
    say(f"{np.median(taken):.3g} s a frame")
    return float(np.median(taken))
