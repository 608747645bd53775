"""Keypoints and matches by COLMAP, for the worker of structure from motion.

Matches are found by processes of one thread each. COLMAP's own threads share the search
tree of an image, and once in a while two of them that ask it at the same time get wrong
answers: neighboring frames of 2,000 matches were left with 59.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.process import die_with_parent
from hdr_nsff.priors.poses.colmap import load_pycolmap
from hdr_nsff.priors.poses.sfm import Job, write_matches
from hdr_nsff.priors.poses.sfm_child import send

EXTRACTION_BATCH = 6  # images per call, between two steps of progress
MATCHING_STEPS = 24  # of progress
MIN_PAIRS_OF_PROCESS = 50  # for fewer, it takes longer to start than to work
MAX_PROCESSES = 8  # each has a copy of the descriptors

Pairs = list[tuple[str, str]]


def image_names(job: Job) -> list[str]:
    """All images of a job, camera by camera."""
    return [name for group in job.groups for name in group]


def import_images(job: Job, database: Path) -> dict[str, int]:
    """Images into the database, one camera per group with the first guess of its focal
    length; the id of every image.

    In the order of the job: threads that extract would number images as they come, and
    structure from motion depends on their order.
    """
    pycolmap = load_pycolmap()
    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = "SIMPLE_PINHOLE"
    pycolmap.Database.open(database).close()  # creates it
    for group in job.groups:
        pycolmap.import_images(
            database, Path(job.folder) / "images", pycolmap.CameraMode.SINGLE, group, reading
        )
    set_cameras(job, database)
    with pycolmap.Database.open(database) as db:
        return {image.name: image.image_id for image in db.read_all_images()}


def set_cameras(job: Job, database: Path) -> None:
    """Give the cameras of a database the first guess of their lens."""
    with load_pycolmap().Database.open(database) as db:
        for camera in db.read_all_cameras():
            camera.focal_length = job.focal
            if job.distortion:
                set_lens(camera, job.distortion)
            db.update_camera(camera)


def set_lens(camera: Any, distortion: list[float]) -> None:
    """Give a camera, in place, a lens with k1 and k2, or k1 alone."""
    pycolmap = load_pycolmap()
    focal, x, y = list(camera.params)[:3]
    models = (pycolmap.CameraModelId.SIMPLE_RADIAL, pycolmap.CameraModelId.RADIAL)
    camera.model = models[len(distortion) - 1]
    camera.params = [focal, x, y, *distortion]


def find_matches(job: Job, database: Path, threads: int) -> None:
    """Keypoints of all images and matches of the job's pairs, written by
    `write_matches`.
    """
    pycolmap = load_pycolmap()
    ids = import_images(job, database)
    extract(job, database, threads)
    names = image_names(job)
    keypoints: list[np.ndarray] = []
    with pycolmap.Database.open(database) as db:
        for name in names:
            points = np.zeros((0, 2))
            if db.exists_keypoints(ids[name]):
                points = np.asarray(db.read_keypoints(ids[name]), np.float64)
            keypoints.append(points[:, :2])
    matches = match(job, ids, database, threads)
    write_matches(Path(job.folder), names, keypoints, job.pairs, matches)


def extract(job: Job, database: Path, threads: int) -> None:
    """SIFT keypoints of all images into the database."""
    pycolmap = load_pycolmap()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    extraction.sift.max_num_features = job.tuning.max_features
    send("stage keypoints", len(image_names(job)))
    for group in job.groups:
        for k in range(0, len(group), EXTRACTION_BATCH):
            names = group[k : k + EXTRACTION_BATCH]
            pycolmap.extract_features(
                database,
                Path(job.folder) / "images",
                names,
                pycolmap.CameraMode.AUTO,
                pycolmap.ImageReaderOptions(),
                extraction,
                pycolmap.Device.cpu,
            )
            for _ in names:
                send("tick")
    send("end")


def match(job: Job, ids: dict[str, int], database: Path, processes: int) -> list[np.ndarray]:
    """Matches (M, 2) of each of the job's pairs, not verified."""
    processes = min(processes, MAX_PROCESSES, len(job.pairs) // MIN_PAIRS_OF_PROCESS)
    matches: list[np.ndarray] = []
    with ExitStack() as stack:
        mapped: Any = map
        if processes > 1:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(processes, context, initializer=die_with_parent)
            mapped = stack.enter_context(pool).map
        parts = parts_of_pairs(job)
        send("stage matches", len(parts))
        for found in mapped(partial(match_part, ids, database), parts):
            matches.extend(found)
            send("tick")
        send("end")
    for own in database.parent.glob(f"{database.stem}-*"):
        own.unlink()
    return matches


def match_part(ids: dict[str, int], database: Path, pairs: Pairs) -> list[np.ndarray]:
    """Matches (M, 2) of each pair, found in a copy of the database that belongs to this
    process.
    """
    pycolmap = load_pycolmap()
    own = database.with_name(f"{database.stem}-{os.getpid()}.db")
    if not own.exists():
        shutil.copy(database, own)
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.skip_geometric_verification = True
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(write_pairs(own.with_suffix(".txt"), pairs))
    pycolmap.match_image_pairs(
        own, matching, pairing, pycolmap.TwoViewGeometryOptions(), pycolmap.Device.cpu
    )
    matches: list[np.ndarray] = []
    with pycolmap.Database.open(own) as db:
        for a, b in pairs:
            rows = np.zeros((0, 2), np.int64)
            if db.exists_matches(ids[a], ids[b]):
                rows = np.asarray(db.read_matches(ids[a], ids[b]), np.int64)
            matches.append(rows.reshape(-1, 2))
    return matches


def verify(job: Job, database: Path) -> None:
    """Matches of the job's pairs that obey a two-view geometry into the database."""
    pycolmap = load_pycolmap()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    verification.ransac.max_error = job.tuning.max_epipolar_error_px
    verification.detect_watermark = False  # a still camera is not a watermark
    parts = parts_of_pairs(job)
    send("stage geometry", len(parts))
    for pairs in parts:
        file = write_pairs(Path(job.folder) / "pairs.txt", pairs)
        pycolmap.verify_matches(database, file, verification)
        send("tick")
    send("end")


def parts_of_pairs(job: Job) -> list[Pairs]:
    """The pairs of a job in parts, between which progress is reported."""
    size = max(1, -(-len(job.pairs) // MATCHING_STEPS))
    return [job.pairs[k : k + size] for k in range(0, len(job.pairs), size)]


def write_pairs(file: Path, pairs: Pairs) -> Path:
    """The file, with the names of a pair on each line."""
    file.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    return file
