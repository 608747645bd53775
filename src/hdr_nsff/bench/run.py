"""One run of a benchmark: its scene prepared, the method trained, the result measured.
Each part keeps its results, so a killed run goes on.

The training clock pauses while snapshots are written, and measuring comes after it.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import replace

import numpy as np
import torch

from hdr_nsff.bench.config import BenchRun, BenchScene
from hdr_nsff.bench.curve import SHARES, curve_of
from hdr_nsff.bench.machine import this_machine
from hdr_nsff.core import notes
from hdr_nsff.core.checkpoints import latest_checkpoint
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hashes import hash_file
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.notes import RunRecord, Trained
from hdr_nsff.core.process import peak_memory
from hdr_nsff.core.progress import say
from hdr_nsff.core.tensors import to_device
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.prepare.prepare import prepare_scenes
from hdr_nsff.rendering.stills import device_of
from hdr_nsff.scene.scene import Frame
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train

METRICS = "metrics.json"  # of `evaluate`, in the run folder
LOG = "HDR_NSFF_BENCH_LOG"  # environment: the log file of this process
TIMED_FRAMES = 5  # rendered to time a frame (hand-chosen)
MAX_TIMING_S = 10.0  # seconds of rendering after which no further frame is timed (hand-chosen)


def prepare_scene(scene: BenchScene) -> None:
    """Prepare a scene, once however many processes ask for it."""
    if scene.footage is None or scene.ready:
        return
    with lock_output(scene.folder, wait=True):
        prepare_scenes(scene.footage, part_cuts=False)


def do_run(run: BenchRun, views: int, lpips: str | None) -> None:
    """All parts of a run that are not done yet.

    The reason of a failure is kept in `failure.json`, and the error raised.
    """
    with lock_output(run.folder):
        run.failure.unlink(missing_ok=True)
        try:
            prepare_scene(run.scene)
            train_run(run, views)
            measure_run(run, views, lpips)
        except Exception as error:
            failure = notes.Failure(reason=reason_of(error), log=os.environ.get(LOG))
            notes.write(run.failure, failure)
            raise


def reason_of(error: Exception) -> str:
    """The last line of an error, with its kind where it is not the user's."""
    lines = str(error).strip().splitlines()
    words = lines[-1] if lines else ""
    return words if isinstance(error, InputError) else f"{type(error).__name__}: {words}"


def read_record(run: BenchRun) -> RunRecord:
    """The record of a run, a new one where there is none."""
    return notes.read(run.record, RunRecord) or RunRecord(scene_key=run.scene.key)


def measure_key(run: BenchRun, views: int, lpips: str | None) -> str:
    """A hash of the truth that a run is measured on, and of the settings."""
    files: list[tuple[str, str]] = []  # of the truth: names and contents
    if (truth := run.scene.truth) is not None:
        paths = sorted(path for path in truth.rglob("*") if path.is_file())
        files = [(path.relative_to(truth).as_posix(), hash_file(path)) for path in paths]
    return hashlib.sha256(json.dumps([files, lpips, views]).encode()).hexdigest()[:16]


def is_complete(run: BenchRun, views: int, lpips: str | None) -> bool:
    """Whether nothing is left to do."""
    return run.scene.ready and is_measured(run, measure_key(run, views, lpips))


def is_measured(run: BenchRun, key: str) -> bool:
    """Whether the metrics.json of a run is the one that was written for `key`, and not
    that of an `evaluate` of the user's.
    """
    record, path = read_record(run), run.folder / METRICS
    if record.measured != key or not path.is_file():
        return False
    return record.metrics in (None, hash_file(path))


def train_run(run: BenchRun, views: int) -> None:
    """Train, and note the cost."""
    record = read_record(run)
    if record.trained is not None:
        return
    notes.write(run.record, record)  # which holds the scene it is trained on
    start = time.monotonic()
    found = latest_checkpoint(run.folder)
    train(run.config, keep_at=SHARES if views else (), previews=False)
    wall_seconds = time.monotonic() - start
    memory = peak_memory()
    trained = Run.open(run.folder, run.config.device)
    seconds_here = trained.seconds - (found.seconds if found else 0.0)
    device = device_of(trained)
    on_gpu = device.type == "cuda"
    cost = Trained(
        steps=trained.step,
        seconds=round(trained.seconds, 3),
        start_seconds=round(max(wall_seconds - seconds_here, 0.0), 3),
        memory=memory,
        gpu_memory=torch.cuda.max_memory_allocated(device) if on_gpu else None,
        device=torch.cuda.get_device_name(device) if on_gpu else "cpu",
        threads=int(os.environ.get("OMP_NUM_THREADS") or torch.get_num_threads()),
        frame_seconds=frame_seconds(trained),
        seed=run.config.seed,
        machine=this_machine(),
    )
    notes.write(run.record, record.model_copy(update={"trained": cost}))


def measure_run(run: BenchRun, views: int, lpips: str | None) -> None:
    """Evaluate the run, and its snapshots on a few views."""
    key = measure_key(run, views, lpips)
    if is_measured(run, key):
        return
    record = read_record(run)
    start = time.monotonic()
    trained = Run.open(run.folder, run.config.device)
    truth = run.scene.truth
    evaluate_run(trained, truth, lpips)
    curve, shown = curve_of(trained, truth, views) if views else ([], [])
    seconds = round(time.monotonic() - start, 2)
    measured = {"measured": key, "metrics": hash_file(run.folder / METRICS), "seconds": seconds}
    update = measured | {"curve": curve, "shown": shown}
    notes.write(run.record, record.model_copy(update=update))


@torch.no_grad()
def frame_seconds(run: Run) -> float:
    """Median seconds to render a frame of the scene, without writing it.

    Radiance, depth and motion are rendered.
    """
    frames = run.scene.train[:: max(1, len(run.scene.train) // TIMED_FRAMES)][:TIMED_FRAMES]
    camera = frames[0].camera
    small = replace(frames[0], camera=camera.resized(camera.width // 4, camera.height // 4))
    time_frame(run, small)  # compiles the kernels
    seconds: list[float] = []
    for frame in frames:
        seconds.append(time_frame(run, frame))
        if sum(seconds) > MAX_TIMING_S:
            break
    median = float(np.median(seconds))
    say(f"{median:.3g} s per frame")
    return median


def time_frame(run: Run, frame: Frame) -> float:
    """Seconds to render one frame."""
    camera = to_device(frame.camera, device_of(run))
    start = time.perf_counter()
    seen = run.field.render(camera, frame.time)
    float(seen.radiance[0, 0])  # a GPU has finished by then
    return time.perf_counter() - start
