"""Structure from motion by pycolmap, in a process of its own: `python -m
hdr_nsff.priors.poses.sfm JOB.json`.

A separate process because pycolmap brings its own zlib, which breaks PNG and EXR
writing in the process that imports it, and because native code that crashes must not
take the user's run along. The worker extracts and matches keypoints once per job
folder, maps, and leaves COLMAP models behind (Schonberger and Frahm 2016; global: Pan
et al. 2024). The parent shows its progress and kills it when it is itself interrupted.
"""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from hdr_nsff.core.process import prepare_process
from hdr_nsff.core.progress import track
from hdr_nsff.priors.poses.trimming import TrimmingTuning, trim

Mapping = Literal["incremental", "global"]
MATCHES_FILE = "given.npz"
EXTRACTION_BATCH = 6  # images per call, between two steps of progress
MATCHING_STEPS = 24  # of progress
MIN_FREE_BYTES = 2**20  # a disk with less free space is full
DISK_FULL_WORDS = ("No space left", "disk is full")


@dataclass(frozen=True)
class SfmTuning:
    """Settings of COLMAP, hand-chosen on rendered scenes."""

    max_features: int = 4096  # SIFT keypoints per image
    max_epipolar_error_px: float = 3.0  # of verified matches; COLMAP's default is 4
    max_models: int = 4  # kept by incremental mapping
    min_model_images: int = 3
    # free focal lengths must lower the mean reprojection error below this share of the
    # error with focal lengths held: thousands of observations gain less by chance
    max_free_focal_error_share: float = 0.9998
    trimming: TrimmingTuning = field(default_factory=TrimmingTuning)


@dataclass(frozen=True)
class Job:
    """One run of structure from motion; every path is inside `folder`."""

    # holds images/NAME.png, and masks/NAME.png.png where black pixels carry no
    # keypoints
    folder: str
    groups: list[list[str]]  # image names of each physical camera, which share intrinsics
    pairs: list[tuple[str, str]]  # image names to match
    focal: float  # first guess, pixels of the images
    mapping: Mapping
    threads: int = 0  # 0 = all cores
    # keypoints and matches lie in the folder (`write_matches`): none are extracted
    matches_given: bool = False
    tuning: SfmTuning = field(default_factory=SfmTuning)


class SfmError(RuntimeError):
    """The worker ended without a result. The message is its last line."""


def read_job(path: Path) -> Job:
    """A job as `run` wrote it."""
    raw = json.loads(path.read_text())
    tuning = raw.pop("tuning")
    trimming = TrimmingTuning(**tuning.pop("trimming"))
    return Job(**raw, tuning=SfmTuning(**tuning, trimming=trimming))


def run(job: Job) -> list[Path]:
    """Run `job` in a worker process, with progress; the folders of the models it found,
    largest first. SfmError when it breaks down, OSError where the disk is full.
    """
    folder = Path(job.folder)
    (folder / "job.json").write_text(json.dumps(asdict(job)))
    command = [sys.executable, "-m", "hdr_nsff.priors.poses.sfm", str(folder / "job.json")]
    worker = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace"
    )
    assert worker.stdout is not None and worker.stderr is not None
    # kept in memory: on a full disk a log would stay empty
    error_lines: deque[str] = deque(maxlen=20)
    listener = threading.Thread(target=error_lines.extend, args=(worker.stderr,), daemon=True)
    listener.start()
    try:
        show_progress(worker.stdout)
        code = worker.wait()
    finally:
        worker.kill()
        worker.wait()
        listener.join()
    check_free_space(folder, " ".join(error_lines))
    if code != 0:
        messages = [line.strip() for line in error_lines if line.strip()]
        raise SfmError(messages[-1] if messages else f"pycolmap ended with code {code}")
    return sorted(p for p in (folder / job.mapping).iterdir() if p.is_dir())


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


def show_progress(lines: IO[str]) -> None:
    """Show the worker's stages ("stage NAME TOTAL", then "tick" lines, then "end") as
    progress bars.
    """

    def ticks() -> Iterator[None]:
        for line in iter(lines.readline, ""):
            if line.startswith("end"):
                return
            yield None

    for line in iter(lines.readline, ""):
        if line.startswith("stage "):
            _, name, total = line.split()
            for _ in track(ticks(), f"poses: {name}", int(total)):
                pass


def send(*words: object) -> None:
    """Send one line to the parent."""
    print(*words, flush=True)


def die_with_parent() -> None:
    """End this process soon after its parent is gone (killed, too)."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def extract(job: Job, database: Path, threads: int) -> None:
    """Keypoints of all images into the database, one camera per group."""
    import pycolmap

    import_images(job, database)
    if job.matches_given:
        load_matches(job, database)
        return
    folder = Path(job.folder)
    reading = pycolmap.ImageReaderOptions()
    if (folder / "masks").is_dir():
        reading.mask_path = str(folder / "masks")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    extraction.sift.max_num_features = job.tuning.max_features
    send("stage keypoints", sum(len(g) for g in job.groups))
    for group in job.groups:
        for k in range(0, len(group), EXTRACTION_BATCH):
            names = group[k : k + EXTRACTION_BATCH]
            pycolmap.extract_features(
                database,
                folder / "images",
                names,
                pycolmap.CameraMode.AUTO,
                reading,
                extraction,
                pycolmap.Device.cpu,
            )
            for _ in names:
                send("tick")
    send("end")


def import_images(job: Job, database: Path) -> None:
    """Images into the database, one camera per group with the first guess of its focal
    length.

    In the order of the job: threads that extract would number images as they come, and
    structure from motion depends on their order.
    """
    import pycolmap

    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = "SIMPLE_PINHOLE"
    pycolmap.Database.open(database).close()  # creates it
    for group in job.groups:
        pycolmap.import_images(
            database, Path(job.folder) / "images", pycolmap.CameraMode.SINGLE, group, reading
        )
    with pycolmap.Database.open(database) as db:
        for camera in db.read_all_cameras():
            camera.focal_length = job.focal
            db.update_camera(camera)


def load_matches(job: Job, database: Path) -> None:
    """The keypoints and matches that `write_matches` wrote into the database."""
    import pycolmap

    with (
        np.load(Path(job.folder) / MATCHES_FILE) as stored,
        pycolmap.Database.open(database) as db,
    ):
        ids = {}
        for name in (name for group in job.groups for name in group):
            image = db.read_image_with_name(name)
            if image is not None:
                ids[name] = image.image_id
        for name, image_id in ids.items():
            db.write_keypoints(image_id, stored[f"points_{name}"])
        for a, b in job.pairs:
            db.write_matches(ids[a], ids[b], stored[f"matches_{a}|{b}"])


def match(job: Job, database: Path, threads: int) -> None:
    """Verified matches of the job's pairs into the database."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    pairing = pycolmap.ImportedPairingOptions()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    verification.ransac.max_error = job.tuning.max_epipolar_error_px
    verification.detect_watermark = False  # a still camera is not a watermark
    num_pairs = len(job.pairs)
    step = -(-num_pairs // MATCHING_STEPS)
    send("stage matches", -(-num_pairs // step))
    for k in range(0, num_pairs, step):
        file = Path(job.folder) / "pairs.txt"
        file.write_text("".join(f"{a} {b}\n" for a, b in job.pairs[k : k + step]))
        pairing.match_list_path = str(file)
        if job.matches_given:
            pycolmap.verify_matches(database, file, verification)
        else:
            pycolmap.match_image_pairs(
                database, matching, pairing, verification, pycolmap.Device.cpu
            )
        send("tick")
    send("end")


def reconstruct(job: Job, database: Path, threads: int) -> None:
    """Map the matches; models are left in `<folder>/<mapping>/<n>`, adjusted to the
    points that stand still.
    """
    import pycolmap

    out = Path(job.folder) / job.mapping
    out.mkdir(exist_ok=True)
    images = Path(job.folder) / "images"
    send("stage mapping", sum(len(g) for g in job.groups))
    if job.mapping == "incremental":
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = threads
        options.random_seed = 0
        options.extract_colors = False
        options.max_num_models = job.tuning.max_models
        options.min_model_size = job.tuning.min_model_images
        models = pycolmap.incremental_mapping(
            database, images, out, options, next_image_callback=lambda: send("tick")
        )
    else:
        global_options = pycolmap.GlobalPipelineOptions()
        global_options.num_threads = threads
        global_options.random_seed = 0
        pycolmap.calibrate_view_graph(database)
        models = pycolmap.global_mapping(database, images, out, global_options)
    send("end")
    send("stage adjustment", (job.tuning.trimming.max_rounds + 1) * len(models))
    for key, model in models.items():
        trim(model, lambda m: adjust(m, job.tuning), job.tuning.trimming)
        (out / str(key)).mkdir(exist_ok=True)
        model.write_binary(out / str(key))
    send("end")


def adjust(model: Any, tuning: SfmTuning) -> None:
    """Adjust cameras and points to each other, and focal lengths where that lowers the
    error: a camera that slides without turning does not determine them.
    """
    import pycolmap

    held = pycolmap.BundleAdjustmentOptions()
    held.print_summary = held.refine_focal_length = False
    free = pycolmap.BundleAdjustmentOptions()
    free.print_summary = False
    pycolmap.bundle_adjustment(model, held)
    focal_lengths = {key: camera.focal_length for key, camera in model.cameras.items()}
    held_error = mean_error(model)
    pycolmap.bundle_adjustment(model, free)
    if mean_error(model) > tuning.max_free_focal_error_share * held_error:
        for key, focal in focal_lengths.items():
            model.cameras[key].focal_length = focal
        pycolmap.bundle_adjustment(model, held)
    send("tick")


def mean_error(model: Any) -> float:
    """The mean reprojection error of all observations, in pixels."""
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())


def main() -> None:
    """The worker."""
    import zlib  # the system's zlib must be in place before pycolmap brings its own

    die_with_parent()
    prepare_process()
    import pycolmap

    assert zlib and np
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(0)
    job = read_job(Path(sys.argv[1]))
    threads = job.threads or os.cpu_count() or 1
    database = Path(job.folder) / "database.db"
    if not database.exists():
        extract(job, database, threads)
        match(job, database, threads)
    reconstruct(job, database, threads)


if __name__ == "__main__":
    main()
