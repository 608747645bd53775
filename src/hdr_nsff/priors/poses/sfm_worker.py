"""The worker of structure from motion: `python -m hdr_nsff.priors.poses.sfm_worker
JOB.json`.

One job either finds keypoints and matches, or maps images from given ones and leaves
COLMAP models behind (Schonberger and Frahm 2016; global: Pan et al. 2024). Incremental
mapping starts with keyframes, whose number is bounded; the other images are then
registered one by one, each with its neighborhood adjusted, so the time grows with the
number of images and not with its square.

Mapping and adjustment use one thread, so that a clip has the same poses in every run.
With more, the first pair is the one that a thread finds first, and sums are rounded in
another order, which an ill-conditioned lens makes large: focal lengths of 73 or 79
pixels for one clip. It takes up to 1.2 times as long on two cores.
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hdr_nsff.core.process import die_with_parent, prepare_process, usable_cores
from hdr_nsff.priors.poses.colmap import load_pycolmap
from hdr_nsff.priors.poses.colmap_matches import (
    find_matches,
    image_names,
    import_images,
    set_cameras,
    set_lens,
    verify,
)
from hdr_nsff.priors.poses.sfm import LENS_FILE, Job, LensFit, SfmTuning, read_job, read_matches
from hdr_nsff.priors.poses.sfm_child import send
from hdr_nsff.priors.poses.trimming import NUM_PINHOLE_PARAMS, trim

NEVER = 1e9  # growth of a model that it does not reach
LOST_PX = 1e6  # COLMAP's error of a point behind a camera that sees it is far beyond


def load_matches(job: Job, database: Path) -> None:
    """The keypoints and matches in the job's folder into the database, verified."""
    pycolmap = load_pycolmap()
    ids = import_images(job, database)
    names = image_names(job)
    keypoints, matches = read_matches(Path(job.folder), names, job.pairs)
    with pycolmap.Database.open(database) as db:
        for name, points in zip(names, keypoints, strict=True):
            db.write_keypoints(ids[name], points)
        for (a, b), rows in zip(job.pairs, matches, strict=True):
            db.write_matches(ids[a], ids[b], rows)
    verify(job, database)


def reconstruct(job: Job, database: Path) -> None:
    """Map the matches; models are left in numbered folders, adjusted to the points that
    stand still.
    """
    out = job.out
    out.mkdir(exist_ok=True)
    images = Path(job.folder) / "images"
    match job.task:
        case "incremental":
            models = map_incrementally(job, database)
        case "adjust":
            models = {0: from_known_poses(job, database)}
        case _:
            models = map_globally(database, images, out)
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
    pycolmap = load_pycolmap()
    other = pycolmap.Reconstruction(model)
    for camera in other.cameras.values():
        radial = list(camera.params[NUM_PINHOLE_PARAMS:])
        set_lens(camera, radial[:1] if radial else [0.0, 0.0])
    pycolmap.bundle_adjustment(other, adjustment_options(tuning, final=False))
    lenses = {}
    for key, camera in other.cameras.items():
        focal, _, _, k1, k2 = [*(float(value) for value in camera.params), 0.0][:5]
        lenses[int(key)] = (focal, k1, k2)
    return LensFit(lenses, mean_error(model), mean_error(other))


def adjustment_options(tuning: SfmTuning, final: bool) -> Any:
    """How cameras and points are adjusted. Only the `final` adjustment runs to
    convergence.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    if not final:
        options.ceres.solver_options.function_tolerance = tuning.trimming_tolerance
        options.ceres.solver_options.max_num_iterations = tuning.max_trimming_iterations
    return options


def incremental_options(job: Job) -> Any:
    """How images are added to a model."""
    pycolmap = load_pycolmap()
    tuning = job.tuning
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = 0
    options.extract_colors = False
    options.max_num_models = tuning.max_models
    options.min_model_size = tuning.min_model_images
    options.ba_global_frames_ratio = options.ba_global_points_ratio = tuning.global_growth
    options.ba_global_max_refinements = tuning.max_global_refinements
    options.ba_global_function_tolerance = tuning.mapping_tolerance
    options.ba_local_function_tolerance = tuning.mapping_tolerance
    options.ba_refine_focal_length = job.refine_focal
    options.ba_refine_extra_params = job.refine_distortion
    return options


def map_incrementally(job: Job, database: Path) -> dict[int, Any]:
    """Models of the images: of keyframes first; the others are added to the largest."""
    pycolmap = load_pycolmap()
    folder = Path(job.folder)
    images, out = folder / "images", job.out
    options = incremental_options(job)
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
        rest = incremental_options(job)
        rest.multiple_models = False
        rest.ba_global_frames_ratio = rest.ba_global_points_ratio = NEVER
        models = pycolmap.incremental_mapping(
            database, images, out, rest, start, next_image_callback=lambda: send("tick")
        )
    send("end")
    return dict(models)


def map_globally(database: Path, images: Path, out: Path) -> dict[int, Any]:
    """Models of all images at once."""
    pycolmap = load_pycolmap()
    send("stage mapping", 1)
    calibration = pycolmap.ViewGraphCalibrationOptions()
    options = pycolmap.GlobalPipelineOptions()
    mapper = options.mapper
    parts = mapper.global_positioning, mapper.rotation_averaging, mapper.retriangulation
    for seeded in (calibration, options, mapper, *parts):
        seeded.random_seed = 0
    options.num_threads = mapper.num_threads = 1
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    pycolmap.calibrate_view_graph(database, calibration)
    models = pycolmap.global_mapping(database, images, out, options)
    send("end")
    return dict(models)


def from_known_poses(job: Job, database: Path) -> Any:
    """The model of the poses in `job.start`, with points triangulated anew. Where its
    cameras are pinholes and those of the job are not, the poses first follow the lens.
    """
    pycolmap = load_pycolmap()
    send("stage triangulation", 1)
    start = pycolmap.Reconstruction(job.start)
    pinholes = [c for c in start.cameras.values() if len(c.params) == NUM_PINHOLE_PARAMS]
    if job.distortion and pinholes:
        for camera in pinholes:
            camera.focal_length = job.focal
            set_lens(camera, job.distortion)
        pycolmap.bundle_adjustment(start, adjustment_options(job.tuning, final=False))
    options = incremental_options(job)
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
    error, clearly if an earlier round found them: a camera that slides without turning
    does not determine them. Only the `final` adjustment runs to convergence.
    """
    pycolmap = load_pycolmap()
    tuning = job.tuning
    held, free = [adjustment_options(tuning, final) for _ in range(2)]
    held.refine_focal_length = False
    for options in (held, free):
        options.refine_extra_params = job.refine_distortion
    pycolmap.bundle_adjustment(model, held)
    drop_lost_points(model)
    before = {key: list(camera.params) for key, camera in model.cameras.items()}
    held_error = mean_error(model)
    pycolmap.bundle_adjustment(model, free)
    max_share = tuning.max_free_focal_error_share
    if job.task == "adjust" and not job.distortion:
        max_share = tuning.max_free_known_focal_error_share
    if mean_error(model) > max_share * held_error:
        for key, params in before.items():
            model.cameras[key].params = params
        pycolmap.bundle_adjustment(model, held)
    drop_lost_points(model)
    send("tick")


def drop_lost_points(model: Any) -> None:
    """Drop the points that an adjustment has left behind a camera, in place: a single
    one would be all that a mean error shows.
    """
    model.update_point_3d_errors()
    lost = [key for key, point in model.points3D.items() if point.error > LOST_PX]
    for key in lost:
        model.delete_point3D(key)


def mean_error(model: Any) -> float:
    """The mean reprojection error of all observations, in pixels."""
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())


def main() -> None:
    """The worker."""
    die_with_parent()
    prepare_process()
    job = read_job(Path(sys.argv[1]))
    folder = Path(job.folder)
    if job.task == "match":
        find_matches(job, folder / "features.db", job.threads or usable_cores())
        return
    verified, own = folder / "database.db", job.out.with_suffix(".db")
    if not verified.exists():
        load_matches(job, verified)
    shutil.copy(verified, own)
    set_cameras(job, own)
    reconstruct(job, own)
    own.unlink()


if __name__ == "__main__":
    main()
