"""Structure from motion by pycolmap, in a process of its own (`sfm_worker.py`): jobs,
the files they exchange, and the parent's side.

A separate process because pycolmap brings its own zlib, which breaks PNG and EXR
writing in the process that imports it, and because native code that crashes must not
take the user's run along. The parent shows the worker's progress and kills it when it
is itself interrupted.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import Literal

import numpy as np

from hdr_nsff.core.progress import track
from hdr_nsff.priors.poses.trimming import TrimmingTuning

Task = Literal["match", "incremental", "global", "adjust"]
WORKER = "hdr_nsff.priors.poses.sfm_worker"
MATCHES_FILE = "matches.npz"
MIN_FREE_BYTES = 2**20  # a disk with less free space is full
DISK_FULL_WORDS = ("No space left", "disk is full")
KILLED = "its process was killed, probably because memory did not suffice"


@dataclass(frozen=True)
class SfmTuning:
    """Settings of COLMAP, hand-chosen on rendered scenes."""

    max_features: int = 4096  # SIFT keypoints per image
    max_epipolar_error_px: float = 3.0  # of verified matches; COLMAP's default is 4
    max_models: int = 4  # kept by incremental mapping
    min_model_images: int = 3
    # of an image whose pose is known from before; with fewer points it counts as lost
    min_known_points: int = 15
    # global bundle adjustment while images are added: after this growth of the model
    # (COLMAP: 1.1), at most this many times in a row (COLMAP: 5), until the cost falls
    # by less than this share (COLMAP: 0, which costs half of the time of mapping). The
    # final adjustment runs to convergence.
    global_growth: float = 1.3
    max_global_refinements: int = 2
    mapping_tolerance: float = 1e-5
    # the same between two rounds of trimming, of at most so many iterations
    trimming_tolerance: float = 1e-6
    max_trimming_iterations: int = 25
    # free focal lengths must lower the mean reprojection error below this share of the
    # error with focal lengths held: thousands of observations gain less by chance
    max_free_focal_error_share: float = 0.9998
    # the same of focal lengths that an earlier round found: others fit better by 0.25 %
    # before a flight straight ahead, which does not determine them, and by 0.36 % on
    # `cloth`, where they are nearer the truth
    max_free_known_focal_error_share: float = 0.997
    trimming: TrimmingTuning = field(default_factory=TrimmingTuning)


@dataclass(frozen=True)
class Job:
    """One run of structure from motion; every path is inside `folder`."""

    folder: str  # holds images/NAME.png, and to map them, matches (`write_matches`)
    groups: list[list[str]]  # image names of each physical camera, which share intrinsics
    pairs: list[tuple[str, str]]  # image names to match
    focal: float  # first guess, pixels of the images
    # match: find keypoints and matches; incremental, global: map the images from
    # matches; adjust: from matches and the poses of the model in `start`
    task: Task
    threads: int = 0  # 0 = all cores
    keyframes: list[str] = field(default_factory=list)  # mapped first; empty: all at once
    start: str = ""  # folder of a model
    # k1, k2 of the images, to start from; empty: a pinhole camera
    distortion: list[float] = field(default_factory=list)
    refine_distortion: bool = True
    refine_focal: bool = True  # while images are added; afterwards in any case
    # also fit another lens to every model, and write it to its folder (`LensFit`)
    try_lens: bool = False

    @property
    def out(self) -> Path:
        """Where the models go."""
        name = f"{self.task}-{self.focal:.0f}"
        name += "-keyframes" if self.keyframes else ""
        return Path(self.folder) / (name if self.refine_focal else f"{name}-held")

    tuning: SfmTuning = field(default_factory=SfmTuning)


@dataclass(frozen=True)
class LensFit:
    """Another lens fit to the cameras of a model: k1 and k2 instead of a pinhole, or k1
    alone instead of both.
    """

    # by camera: focal length in pixels of the images, k1, k2
    cameras: dict[int, tuple[float, float, float]]
    model_error_px: float  # mean reprojection error of the model, pixels of the images
    error_px: float  # the same with this lens


LENS_FILE = "lens.json"  # in the folder of a model


def parse_lens_fit(content: bytes) -> LensFit:
    """The lens fit that a worker wrote."""
    raw = json.loads(content)
    cameras = {int(key): tuple(values) for key, values in raw["cameras"].items()}
    return LensFit(cameras, raw["model_error_px"], raw["error_px"])


class SfmError(RuntimeError):
    """The worker ended without a result. The message is its last line."""


def read_job(path: Path) -> Job:
    """A job as `Worker` wrote it."""
    raw = json.loads(path.read_text())
    tuning = raw.pop("tuning")
    trimming = TrimmingTuning(**tuning.pop("trimming"))
    return Job(**raw, tuning=SfmTuning(**tuning, trimming=trimming))


class Worker:
    """A worker process that does the task of a job."""

    def __init__(self, job: Job) -> None:
        self.job = job
        file = job.out.with_suffix(".json")
        file.write_text(json.dumps(asdict(job)))
        self.process = subprocess.Popen(  # -P: no module is read from the current folder
            [sys.executable, "-P", "-m", WORKER, str(file)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace",
        )  # fmt: skip
        # read at once, so that a worker need not wait for others to be shown; errors in
        # memory, as on a full disk a log would stay empty
        self.messages: SimpleQueue[str] = SimpleQueue()
        self.error_lines: deque[str] = deque(maxlen=20)
        self.listeners = [
            threading.Thread(target=self.listen, daemon=True),
            threading.Thread(target=self.listen_to_errors, daemon=True),
        ]
        for listener in self.listeners:
            listener.start()

    def listen(self) -> None:
        """Keep what the worker reports, and an empty line after the last one."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.messages.put(line)
        self.messages.put("")

    def listen_to_errors(self) -> None:
        """Keep the last lines of errors."""
        assert self.process.stderr is not None
        self.error_lines.extend(self.process.stderr)

    def finish(self) -> None:
        """Wait for the end, with progress. SfmError when the worker breaks down,
        OSError where the disk is full.
        """
        show_progress(iter(self.messages.get, ""))
        code = self.process.wait()
        self.end()
        check_free_space(Path(self.job.folder), " ".join(self.error_lines))
        if code == -signal.SIGKILL:
            raise SfmError(KILLED)
        if code != 0:
            messages = [line.strip() for line in self.error_lines if line.strip()]
            raise SfmError(messages[-1] if messages else f"pycolmap ended with code {code}")

    def end(self) -> None:
        """Stop the worker, if it still works."""
        self.process.kill()
        self.process.wait()
        for listener in self.listeners:
            listener.join()


def run_worker(job: Job) -> None:
    """Do the task of `job` in a worker process; errors as of `Worker.finish`."""
    worker = Worker(job)
    try:
        worker.finish()
    finally:
        worker.end()


def run_in_turn(jobs: Sequence[Job], at_once: int) -> Generator[list[Path] | SfmError]:
    """Map the images of one folder by several `jobs`: of each, in their order, the
    folders of the models it found, largest first, or why it broke down. OSError where
    the disk is full.

    The first job works alone, since most clips need no other; after that, `at_once` of
    them work at a time. Close the iterator to stop those whose results are not needed.
    """
    ahead: deque[Worker] = deque()
    rest = iter(jobs)
    try:
        for k in range(len(jobs)):
            ahead.extend(Worker(job) for job in islice(rest, (at_once if k else 1) - len(ahead)))
            worker = ahead[0]
            try:
                worker.finish()
                result: list[Path] | SfmError = models_of(worker.job)
            except SfmError as error:
                result = error
            ahead.popleft()
            yield result
    finally:
        for worker in ahead:
            worker.end()


def models_of(job: Job) -> list[Path]:
    """The folders of the models that a job left behind, largest first."""
    return sorted(p for p in job.out.iterdir() if p.is_dir())


def write_matches(
    folder: Path,
    names: list[str],
    keypoints: list[np.ndarray],
    pairs: list[tuple[str, str]],
    matches: list[np.ndarray],
) -> None:
    """Write keypoints (N, 2) of each image, pixels with centers at +0.5, and matches
    (M, 2) of each pair, rows of both, into the folder of a job.
    """
    points = {
        f"points_{name}": xy.astype(np.float32) for name, xy in zip(names, keypoints, strict=True)
    }
    rows = {
        f"matches_{a}|{b}": m.astype(np.uint32) for (a, b), m in zip(pairs, matches, strict=True)
    }
    np.savez(folder / MATCHES_FILE, allow_pickle=False, **points, **rows)


def read_matches(
    folder: Path, names: list[str], pairs: list[tuple[str, str]]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The keypoints of each image and the matches of each pair, as `write_matches` or a
    worker wrote them.
    """
    with np.load(folder / MATCHES_FILE) as stored:
        keypoints = [stored[f"points_{name}"] for name in names]
        return keypoints, [stored[f"matches_{a}|{b}"] for a, b in pairs]


def check_free_space(folder: Path, worker_errors: str) -> None:
    """OSError where the disk is full, or was when the worker wrote `worker_errors`.

    On a full disk COLMAP may die without a message, or cut files short and not notice,
    so free space is tested however the worker ended.
    """
    if any(words in worker_errors for words in DISK_FULL_WORDS):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder.parent))
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(MIN_FREE_BYTES))
        file.flush()
        os.fsync(file.fileno())


def show_progress(lines: Iterator[str]) -> None:
    """Show the worker's stages ("stage NAME TOTAL", then "tick" lines, then "end") as
    progress bars.
    """

    def ticks() -> Iterator[None]:
        for line in lines:
            if line.startswith("end"):
                return
            yield None

    for line in lines:
        if line.startswith("stage "):
            _, name, total = line.split()
            for _ in track(ticks(), f"poses: {name}", int(total)):
                pass
