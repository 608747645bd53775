"""The worker of structure from motion: `python -m hdr_nsff.priors.poses.sfm_worker
JOB.json`.

One job either finds keypoints and matches, or maps images from given ones and leaves
COLMAP models behind (Schonberger and Frahm 2016; global: Pan et al. 2024). Incremental
mapping starts with keyframes, whose number is bounded; the other images are then
registered one by one, each with its neighborhood adjusted, so the time grows with the
number of images and not with its square.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.process import prepare_process
from hdr_nsff.priors.poses.sfm import (
    LENS_FILE,
    Job,
    LensFit,
    SfmTuning,
    read_job,
    read_matches,
    write_matches,
)
from hdr_nsff.priors.poses.trimming import NUM_PINHOLE_PARAMS, trim

EXTRACTION_BATCH = 6  # images per call, between two steps of progress
MATCHING_STEPS = 24  # of progress
NEVER = 1e9  # growth of a model that it does not reach


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


def image_names(job: Job) -> list[str]:
    """All images of a job, camera by camera."""
    return [name for group in job.groups for name in group]


def import_images(job: Job, database: Path) -> dict[str, int]:
    """Images into the database, one camera per group with the first guess of its focal
    length; the id of every image.

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
            if job.distortion:
                set_lens(camera, job.distortion)
            db.update_camera(camera)
        return {image.name: image.image_id for image in db.read_all_images()}


def set_lens(camera: Any, distortion: list[float]) -> None:
    """Give a camera, in place, a lens with k1 and k2, or k1 alone."""
    import pycolmap

    focal, x, y = list(camera.params)[:3]
    models = (pycolmap.CameraModelId.SIMPLE_RADIAL, pycolmap.CameraModelId.RADIAL)
    camera.model = models[len(distortion) - 1]
    camera.params = [focal, x, y, *distortion]


def find_matches(job: Job, database: Path, threads: int) -> None:
    """Keypoints of all images and matches of the job's pairs, written by
    `write_matches`.
    """
    import pycolmap

    ids = import_images(job, database)
    extract(job, database, threads)
    match(job, database, threads)
    names = image_names(job)
    keypoints: list[np.ndarray] = []
    matches: list[np.ndarray] = []
    with pycolmap.Database.open(database) as db:
        for name in names:
            points = np.zeros((0, 2))
            if db.exists_keypoints(ids[name]):
                points = np.asarray(db.read_keypoints(ids[name]), np.float64)
            keypoints.append(points[:, :2])
        for a, b in job.pairs:
            rows = np.zeros((0, 2), np.int64)
            if db.exists_matches(ids[a], ids[b]):
                rows = np.asarray(db.read_matches(ids[a], ids[b]), np.int64)
            matches.append(rows.reshape(-1, 2))
    write_matches(Path(job.folder), names, keypoints, job.pairs, matches)


def extract(job: Job, database: Path, threads: int) -> None:
    """SIFT keypoints of all images into the database."""
    import pycolmap

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


def match(job: Job, database: Path, threads: int) -> None:
    """Matches of the job's pairs into the database, not verified."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.skip_geometric_verification = True
    pairing = pycolmap.ImportedPairingOptions()
    for file in pair_files(job, "matches"):
        pairing.match_list_path = str(file)
        pycolmap.match_image_pairs(
            database, matching, pairing, verification_options(job), pycolmap.Device.cpu
        )


def verify(job: Job, database: Path) -> None:
    """Matches of the job's pairs that obey a two-view geometry into the database."""
    import pycolmap

    for file in pair_files(job, "geometry"):
        pycolmap.verify_matches(database, file, verification_options(job))


def verification_options(job: Job) -> Any:
    """How the geometry of two views is found."""
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    verification.ransac.max_error = job.tuning.max_epipolar_error_px
    verification.detect_watermark = False  # a still camera is not a watermark
    return verification


def pair_files(job: Job, stage: str) -> Any:
    """Yield files that list the job's pairs, a part each, and report progress."""
    num_pairs = len(job.pairs)
    step = max(1, -(-num_pairs // MATCHING_STEPS))
    send("stage", stage, -(-num_pairs // step))
    for k in range(0, num_pairs, step):
        file = Path(job.folder) / "pairs.txt"
        file.write_text("".join(f"{a} {b}\n" for a, b in job.pairs[k : k + step]))
        yield file
        send("tick")
    send("end")


def load_matches(job: Job, database: Path, threads: int) -> None:
    """The keypoints and matches in the job's folder into the database, verified."""
    import pycolmap

    ids = import_images(job, database)
    names = image_names(job)
    keypoints, matches = read_matches(Path(job.folder), names, job.pairs)
    with pycolmap.Database.open(database) as db:
        for name, points in zip(names, keypoints, strict=True):
            db.write_keypoints(ids[name], points)
        for (a, b), rows in zip(job.pairs, matches, strict=True):
            db.write_matches(ids[a], ids[b], rows)
    verify(job, database)


def reconstruct(job: Job, database: Path, threads: int) -> None:
    """Map the matches; models are left in numbered folders, adjusted to the points that
    stand still.
    """
    import pycolmap

    out = job.out
    out.mkdir(exist_ok=True)
    images = Path(job.folder) / "images"
    match job.task:
        case "incremental":
            models = map_incrementally(job, database, threads)
        case "adjust":
            models = {0: from_known_poses(job, database, threads)}
        case _:
            send("stage mapping", 1)
            options = pycolmap.GlobalPipelineOptions()
            options.num_threads = threads
            options.random_seed = 0
            pycolmap.calibrate_view_graph(database)
            models = pycolmap.global_mapping(database, images, out, options)
            send("end")
    models = {key: model for key, model in models.items() if len(model.points3D)}
    send("stage adjustment", (job.tuning.trimming.max_rounds + 1) * len(models))
    for key, model in models.items():
        trim(model, lambda m: adjust(m, job, final=False), job.tuning.trimming)
        adjust(model, job, final=True)
        (out / str(key)).mkdir(exist_ok=True)
        model.write_binary(out / str(key))
        if job.try_lens:
            fit = fit_lens(model, job.tuning)
            (out / str(key) / LENS_FILE).write_text(json.dumps(asdict(fit)))
    send("end")


def fit_lens(model: Any, tuning: SfmTuning) -> LensFit:
    """Another lens for the cameras of an adjusted `model`, which stays as it is."""
    import pycolmap

    other = pycolmap.Reconstruction(model)
    for camera in other.cameras.values():
        radial = list(camera.params[NUM_PINHOLE_PARAMS:])
        set_lens(camera, radial[:1] if radial else [0.0, 0.0])
    pycolmap.bundle_adjustment(other, quick_adjustment(tuning))
    lenses = {}
    for key, camera in other.cameras.items():
        focal, _, _, k1, k2 = [*(float(value) for value in camera.params), 0.0][:5]
        lenses[int(key)] = (focal, k1, k2)
    return LensFit(lenses, mean_error(model), mean_error(other))


def quick_adjustment(tuning: SfmTuning) -> Any:
    """How cameras and points are adjusted where convergence comes later."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.function_tolerance = tuning.trimming_tolerance
    options.ceres.solver_options.max_num_iterations = tuning.max_trimming_iterations
    return options


def incremental_options(job: Job, threads: int) -> Any:
    """How images are added to a model."""
    import pycolmap

    tuning = job.tuning
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    options.random_seed = 0
    options.extract_colors = False
    options.max_num_models = tuning.max_models
    options.min_model_size = tuning.min_model_images
    options.ba_global_frames_ratio = options.ba_global_points_ratio = tuning.global_growth
    options.ba_global_max_refinements = tuning.max_global_refinements
    options.ba_global_function_tolerance = tuning.mapping_tolerance
    options.ba_local_function_tolerance = tuning.mapping_tolerance
    options.ba_refine_extra_params = job.refine_distortion
    return options


def map_incrementally(job: Job, database: Path, threads: int) -> dict[int, Any]:
    """Models of the images: of keyframes first; the others are added to the largest."""
    import pycolmap

    folder = Path(job.folder)
    images, out = folder / "images", job.out
    options = incremental_options(job, threads)
    send("stage mapping", len(image_names(job)))
    if not job.keyframes:
        models = pycolmap.incremental_mapping(
            database, images, out, options, next_image_callback=lambda: send("tick")
        )
        send("end")
        return dict(models)
    options.image_names = job.keyframes
    of_keyframes = pycolmap.incremental_mapping(
        database, images, out, options, next_image_callback=lambda: send("tick")
    )
    models = {}
    if of_keyframes:
        largest = max(of_keyframes.values(), key=lambda m: (m.num_reg_images(), len(m.points3D)))
        start = folder / "start-of-others"
        start.mkdir(exist_ok=True)
        largest.write_binary(start)
        rest = incremental_options(job, threads)
        rest.multiple_models = False
        rest.ba_global_frames_ratio = rest.ba_global_points_ratio = NEVER
        models = pycolmap.incremental_mapping(
            database, images, out, rest, start, next_image_callback=lambda: send("tick")
        )
    send("end")
    return dict(models)


def from_known_poses(job: Job, database: Path, threads: int) -> Any:
    """The model of the poses in `job.start`, with points triangulated anew. Where its
    cameras are pinholes and those of the job are not, the poses first follow the lens.
    """
    import pycolmap

    send("stage triangulation", 1)
    start = pycolmap.Reconstruction(job.start)
    pinholes = [c for c in start.cameras.values() if len(c.params) == NUM_PINHOLE_PARAMS]
    if job.distortion and pinholes:
        for camera in pinholes:
            camera.focal_length = job.focal
            set_lens(camera, job.distortion)
        pycolmap.bundle_adjustment(start, quick_adjustment(job.tuning))
    options = incremental_options(job, threads)
    model = pycolmap.triangulate_points(
        start,
        database,
        Path(job.folder) / "images",
        job.out,
        options=options,
    )
    for image in list(model.images.values()):
        if image.has_pose and image.num_points3D < job.tuning.min_known_points:
            model.deregister_frame(image.frame_id)
    send("end")
    return model


def adjust(model: Any, job: Job, final: bool) -> None:
    """Adjust cameras and points to each other, and focal lengths where that lowers the
    error: a camera that slides without turning does not determine them. Only the
    `final` adjustment runs to convergence.
    """
    import pycolmap

    tuning = job.tuning
    held, free = [
        pycolmap.BundleAdjustmentOptions() if final else quick_adjustment(tuning) for _ in range(2)
    ]
    held.refine_focal_length = False
    for options in (held, free):
        options.print_summary = False
        options.refine_extra_params = job.refine_distortion
    pycolmap.bundle_adjustment(model, held)
    before = {key: list(camera.params) for key, camera in model.cameras.items()}
    held_error = mean_error(model)
    pycolmap.bundle_adjustment(model, free)
    if mean_error(model) > tuning.max_free_focal_error_share * held_error:
        for key, params in before.items():
            model.cameras[key].params = params
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
    folder = Path(job.folder)
    if job.task == "match":
        find_matches(job, folder / "features.db", threads)
        return
    database = folder / "database.db"
    if not database.exists():
        load_matches(job, database, threads)
    reconstruct(job, database, threads)


if __name__ == "__main__":
    main()
