"""The poses of all frames from a reconstruction of the views of a clip.

They lie in a world of their own: +z is the mean viewing direction, near is 1. Poses are
camera to world, OpenCV axes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.core.errors import NoSceneError
from hdr_nsff.footage.colmap import ColmapModel, views_of_images
from hdr_nsff.geometry.pinhole import intrinsics
from hdr_nsff.geometry.poses import (
    ADVICE,
    RIG_ADVICE,
    Poses,
    format_ranges,
    interpolate,
    project,
    trusted_points,
)
from hdr_nsff.priors.poses.reconstruct import ReconstructionTuning, SfmViews


def poses_from_model(
    model: ColmapModel,
    views: SfmViews,
    scale: int,
    size: tuple[int, int],
    tuning: ReconstructionTuning,
) -> Poses:
    """Poses of all frames from a reconstruction of the views, in a normalized world.

    `scale`: how many times larger the images of the reconstruction are than the frames
    of `size` (height, width). NoSceneError where a camera has no registered view, or
    too few points remain.
    """
    count, (height, width) = len(views.of_frame), size
    image_of = views_of_images(model)
    registered = np.array([int(v) in image_of for v in views.of_frame])
    K = np.zeros((count, 3, 3))
    for group in views.groups:
        images = [image_of[v] for v in group if v in image_of]
        if not images:
            raise NoSceneError(
                "poses failed: none of the frames of one camera could be registered "
                f"(views {format_ranges(group)}); {RIG_ADVICE}"
            )
        focal = model.cameras[images[0].camera_id].K[0, 0] / scale  # one for the group
        K[np.isin(views.of_frame, group)] = intrinsics(focal, width, height)
    c2w = np.tile(np.eye(4)[:3], (count, 1, 1))
    for t in np.flatnonzero(registered):
        c2w[t] = image_of[int(views.of_frame[t])].c2w
    tracks = gather_tracks(model, views, scale)
    poses = Poses(K, c2w, registered, "full", model.points, model.errors / scale, tracks)
    poses = trusted_points(poses, tuning.min_track_views)
    frame_groups = [np.flatnonzero(np.isin(views.of_frame, g)).tolist() for g in views.groups]
    poses = interpolate(normalize_world(poses, tuning), frame_groups)
    return replace(poses, notes=(*poses.notes, summary(poses)))


def gather_tracks(model: ColmapModel, views: SfmViews, scale: int) -> np.ndarray:
    """All observations (O, 4): frame, row of the point, x, y in pixels of the frames. A
    view shared by many frames counts for its first.
    """
    row_of_point = {int(key): row for row, key in enumerate(model.point_ids)}
    first_frame = {int(v): int(np.argmax(views.of_frame == v)) for v in views.of_frame}
    observations = []
    for view, image in views_of_images(model).items():
        for xy, point in zip(image.xy, image.point_ids, strict=True):
            if point >= 0:
                observations.append((first_frame[view], row_of_point[int(point)], *(xy / scale)))
    return np.array(observations, np.float64).reshape(-1, 4)


def normalize_world(poses: Poses, tuning: ReconstructionTuning) -> Poses:
    """The same cameras and points in a world of their own: the mean registered camera
    at the origin, looking along +z, near at 1. NoSceneError for too few points.
    """
    if len(poses.points) < tuning.min_points:
        raise NoSceneError(
            f"poses failed: only {len(poses.points)} static points were reconstructed; {ADVICE}"
        )
    registered = poses.c2w[poses.registered]
    rotation = Rotation.from_matrix(registered[:, :, :3]).mean().as_matrix()
    center = registered[:, :, 3].mean(0)
    frames, rows = poses.tracks[:, 0].astype(int), poses.tracks[:, 1].astype(int)
    _, depth = project(poses, frames, poses.points[rows])
    near = tuning.near_factor * np.percentile(depth, tuning.near_percentile)
    far = tuning.far_factor * np.percentile(depth, tuning.far_percentile)
    centers = (poses.c2w[:, :, 3] - center) @ rotation / near
    c2w = np.concatenate([rotation.T @ poses.c2w[:, :, :3], centers[:, :, None]], 2)
    points = (poses.points - center) @ rotation / near
    return replace(poses, c2w=c2w, points=points, near=1.0, far=float(far / near))


def summary(poses: Poses) -> str:
    """One sentence: frames, points, focal length, errors."""
    focal = poses.K[:, 0, 0]
    fov = np.degrees(2 * np.arctan(poses.K[:, :2, 2].max(1) / focal))
    focal_range = f"{focal.min():.0f}"
    if np.ptp(focal) >= 1e-6:
        focal_range += f" to {focal.max():.0f}"
    return (
        f"{int(poses.registered.sum())} of {len(focal)} frames registered, "
        f"{len(poses.points)} static points, focal length {focal_range} px "
        f"({fov.max():.0f} degrees across the longer side), "
        f"median reprojection error {np.nanmedian(poses.frame_errors):.2f} px"
    )
