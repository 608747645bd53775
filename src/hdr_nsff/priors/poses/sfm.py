"""Structure from motion by pycolmap, in a process of its own: `python -m
hdr_nsff.priors.poses.sfm JOB.json`.

A separate process because pycolmap brings its own zlib, which breaks PNG and EXR
writing in the process that imports it, and because native code that crashes must not
take the user's run along. The worker extracts and matches keypoints once per job
folder, maps, and leaves COLMAP models behind; the parent shows its progress and kills
it when it is itself interrupted.
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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from hdr_nsff.core.process import prepare_process
from hdr_nsff.core.progress import track
from hdr_nsff.priors.poses.trimming import ROUNDS, trim

Mapping = Literal["incremental", "global"]
GIVEN = "given.npz"
CHUNKS = 24  # progress steps of matching
# of the error with focal lengths held: what others must reach, for thousands of
# observations tell less than that by chance
TOLD = 0.9998
ROOM = 2**20  # bytes: a disk with less than this free is full


@dataclass(frozen=True)
class Job:
    """One run of structure from motion; every path is inside `folder`."""

    folder: (
        str  # holds images/NAME.png, and masks/NAME.png.png where black pixels carry no keypoints
    )
    groups: list[list[str]]  # image names of each physical camera, which share intrinsics
    pairs: list[tuple[str, str]]  # image names to match
    focal: float  # first guess, pixels of the images
    mapping: Mapping
    threads: int = 0  # 0 = all cores
    # keypoints and matches lie in the folder (`write_matches`): none are looked for
    given: bool = False


class SfmError(RuntimeError):
    """The worker ended without a result. The message is its last line."""


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
    said: deque[str] = deque(maxlen=20)  # in memory: on a full disk a log would stay empty
    listener = threading.Thread(target=said.extend, args=(worker.stderr,), daemon=True)
    listener.start()
    try:
        follow(worker.stdout)
        code = worker.wait()
    finally:
        worker.kill()
        worker.wait()
        listener.join()
    need_room(folder, " ".join(said))
    if code != 0:
        words = [line.strip() for line in said if line.strip()]
        raise SfmError(words[-1] if words else f"pycolmap ended with code {code}")
    return sorted(p for p in (folder / job.mapping).iterdir() if p.is_dir())


def write_matches(
    folder: Path,
    names: list[str],
    keypoints: list[np.ndarray],
    pairs: list[tuple[str, str]],
    matches: list[np.ndarray],
) -> None:
    """Put keypoints (N, 2) of each image, pixels with centers at +0.5, and matches (M,
    2) of each pair, rows of both, beside a job.
    """
    points = {
        f"points_{name}": xy.astype(np.float32) for name, xy in zip(names, keypoints, strict=True)
    }
    rows = {
        f"matches_{a}|{b}": m.astype(np.uint32) for (a, b), m in zip(pairs, matches, strict=True)
    }
    np.savez(folder / GIVEN, allow_pickle=False, **points, **rows)


def need_room(folder: Path, said: str) -> None:
    """OSError where the disk is full, or was when the worker wrote `said`. On a full
    disk COLMAP may die without a word, or leave files cut short and not notice, so it
    is asked whatever the worker's end was.
    """
    if any(words in said for words in ("No space left", "disk is full")):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder.parent))
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(ROOM))
        file.flush()
        os.fsync(file.fileno())


def follow(lines: IO[str]) -> None:
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


def tell(*words: object) -> None:
    """One line to the parent."""
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

    enter(job, database)
    if job.given:
        return take_given(job, database)
    reading = pycolmap.ImageReaderOptions()
    masks = Path(job.folder) / "masks"
    if masks.is_dir():
        reading.mask_path = str(masks)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    extraction.sift.max_num_features = 4096
    tell("stage keypoints", sum(len(g) for g in job.groups))
    for group in job.groups:
        for k in range(0, len(group), 6):
            names = group[k : k + 6]
            pycolmap.extract_features(
                database,
                Path(job.folder) / "images",
                names,
                pycolmap.CameraMode.AUTO,
                reading,
                extraction,
                pycolmap.Device.cpu,
            )
            for _ in names:
                tell("tick")
    tell("end")


def enter(job: Job, database: Path) -> None:
    """Images into the database, one camera per group with the first guess of its focal
    length. In the order of the job, for threads that extract would number them as they
    come, and structure from motion of another order is another.
    """
    import pycolmap

    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = "SIMPLE_PINHOLE"
    pycolmap.Database.open(database).close()  # makes it
    for group in job.groups:
        pycolmap.import_images(
            database, Path(job.folder) / "images", pycolmap.CameraMode.SINGLE, group, reading
        )
    with pycolmap.Database.open(database) as db:
        for camera in db.read_all_cameras():
            camera.focal_length = job.focal
            db.update_camera(camera)


def take_given(job: Job, database: Path) -> None:
    """The keypoints and matches that lie beside the job."""
    import pycolmap

    with np.load(Path(job.folder) / GIVEN) as given, pycolmap.Database.open(database) as db:
        ids = {
            name: image.image_id
            for group in job.groups
            for name in group
            if (image := db.read_image_with_name(name)) is not None
        }
        for name, number in ids.items():
            db.write_keypoints(number, given[f"points_{name}"])
        for a, b in job.pairs:
            db.write_matches(ids[a], ids[b], given[f"matches_{a}|{b}"])


def match(job: Job, database: Path, threads: int) -> None:
    """Verified matches of the job's pairs into the database."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    pairing = pycolmap.ImportedPairingOptions()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    verification.ransac.max_error = 3.0
    verification.detect_watermark = False  # a still camera is not a watermark
    step = -(-len(job.pairs) // CHUNKS)
    tell("stage matches", -(-len(job.pairs) // step))
    for k in range(0, len(job.pairs), step):
        file = Path(job.folder) / "pairs.txt"
        file.write_text("".join(f"{a} {b}\n" for a, b in job.pairs[k : k + step]))
        pairing.match_list_path = str(file)
        if job.given:
            pycolmap.verify_matches(database, file, verification)
        else:
            pycolmap.match_image_pairs(
                database, matching, pairing, verification, pycolmap.Device.cpu
            )
        tell("tick")
    tell("end")


def reconstruct(job: Job, database: Path, threads: int) -> None:
    """Map the matches; models are left in `<folder>/<mapping>/<n>`, adjusted to the
    points that stand still.
    """
    import pycolmap

    out = Path(job.folder) / job.mapping
    out.mkdir(exist_ok=True)
    images = Path(job.folder) / "images"
    tell("stage mapping", sum(len(g) for g in job.groups))
    if job.mapping == "incremental":
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = threads
        options.random_seed = 0
        options.extract_colors = False
        options.max_num_models = 4
        options.min_model_size = 3
        models = pycolmap.incremental_mapping(
            database, images, out, options, next_image_callback=lambda: tell("tick")
        )
    else:
        whole = pycolmap.GlobalPipelineOptions()
        whole.num_threads = threads
        whole.random_seed = 0
        pycolmap.calibrate_view_graph(database)
        models = pycolmap.global_mapping(database, images, out, whole)
    tell("end")
    tell("stage adjustment", (ROUNDS + 1) * len(models))
    for key, model in models.items():
        trim(model, adjust)
        (out / str(key)).mkdir(exist_ok=True)
        model.write_binary(out / str(key))
    tell("end")


def adjust(model: Any) -> None:
    """Fit cameras and points to each other, and focal lengths where that lowers the
    error: a camera that slides without turning tells none.
    """
    import pycolmap

    held = pycolmap.BundleAdjustmentOptions()
    held.print_summary = held.refine_focal_length = False
    free = pycolmap.BundleAdjustmentOptions()
    free.print_summary = False
    pycolmap.bundle_adjustment(model, held)
    before, error = {key: c.focal_length for key, c in model.cameras.items()}, mean_error(model)
    pycolmap.bundle_adjustment(model, free)
    if mean_error(model) > TOLD * error:
        for key, focal in before.items():
            model.cameras[key].focal_length = focal
        pycolmap.bundle_adjustment(model, held)
    tell("tick")


def mean_error(model: Any) -> float:
    """Of all observations, in pixels."""
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
    raw = json.loads(Path(sys.argv[1]).read_text())
    job = Job(**raw)
    threads = job.threads or os.cpu_count() or 1
    database = Path(job.folder) / "database.db"
    if not database.exists():
        extract(job, database, threads)
        match(job, database, threads)
    reconstruct(job, database, threads)


if __name__ == "__main__":
    main()
