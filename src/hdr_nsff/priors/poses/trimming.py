"""Static points separated from moving ones by structure from motion itself: trimmed
least squares (Rousseeuw and Leroy 1987) over whole points.

A cloth in the wind or a dancer who stays in place is matched from frame to frame as
well as a wall is. Its points fit a rigid world worse, but where they are many they bend
cameras and focal length until they fit better. So points whose error is far beyond that
of the best ones are dropped and everything is adjusted again, until nothing changes:
each time the static ones fit better and the others worse. In the end, dropped points
that fit the cameras found that way are restored. Runs in the process of `sfm.py`, on a
`pycolmap.Reconstruction`.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdr_nsff.geometry import pinhole

NUM_PINHOLE_PARAMS = 3  # focal length and principal point


@dataclass(frozen=True)
class TrimmingTuning:
    """Which points are dropped, and which are restored.

    Hand-chosen on a rendered clip of a cloth and a tube in the wind.
    """

    max_rounds: int = 8
    static_share: float = 0.25  # share of all points that surely stand still
    drop_factor: float = 2.0  # times the error of the worst of those: dropped
    restore_factor: float = 3.0  # times the same, in the end: restored
    min_image_points: int = 30  # an image that would keep fewer keeps all it has
    min_dropped_share: float = 0.005  # share of all points: a round that drops fewer is the last


def trim(
    model: Any, adjust: Callable[[Any], object], tuning: TrimmingTuning = TrimmingTuning()
) -> None:
    """Drop the points that do not stand still, in place; `adjust` fits cameras and
    points of the `model` to what is left.
    """
    num_points = len(model.points3D)
    num_static = int(tuning.static_share * num_points)
    dropped = []
    for _ in range(tuning.max_rounds if num_points else 0):
        keys, errors = point_errors(model)
        is_outlier = errors > tuning.drop_factor * static_error(errors, num_static)
        outliers = droppable_points(model, keys, is_outlier, tuning.min_image_points)
        dropped += [deepcopy(model.points3D[key].track) for key in outliers]
        for key in outliers:
            model.delete_point3D(key)
        if len(outliers) < tuning.min_dropped_share * num_points:
            break
        adjust(model)
    if not dropped:
        return
    _, errors = point_errors(model)
    limit = tuning.restore_factor * static_error(errors, num_static)
    for track in dropped:
        point, error = triangulate(model, track)
        if error < limit:
            model.add_point3D(point, track)
    adjust(model)


def point_errors(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """The keys (P,) of all points, and their unbiased errors (P,) in pixels."""
    model.update_point_3d_errors()
    keys = np.array(sorted(model.points3D), np.int64)
    points = [model.points3D[int(key)] for key in keys]
    return keys, np.array([unbiased_error(p.error, len(p.track.elements)) for p in points])


def unbiased_error(error: float, num_views: int) -> float:
    """A mean reprojection error over `num_views` >= 2 views as it would be had the
    point's three coordinates not been fitted to them.
    """
    return error * float(np.sqrt(2 * num_views / (2 * num_views - 3)))


def static_error(errors: np.ndarray, num_static: int) -> float:
    """The highest of the `num_static` lowest point `errors` (P,)."""
    return float(np.sort(errors)[min(num_static, len(errors) - 1)])


def droppable_points(
    model: Any, keys: np.ndarray, is_outlier: np.ndarray, min_image_points: int
) -> list[int]:
    """Those of the points `keys` (P,) that are outliers (P,) bool, without those of
    images that would keep fewer than `min_image_points`.
    """
    row = {int(key): n for n, key in enumerate(keys)}
    droppable = is_outlier.copy()
    for image in model.images.values():
        seen = [row[int(p.point3D_id)] for p in image.points2D if p.has_point3D()]
        if np.sum(~droppable[seen]) < min_image_points:
            droppable[seen] = False
    return [int(key) for key in keys[droppable]]


def triangulate(model: Any, track: Any) -> tuple[np.ndarray, float]:
    """The point (3,) nearest to the rays of a `track`, and its unbiased error in
    pixels, infinite behind a camera.
    """
    images = [model.images[e.image_id] for e in track.elements]
    pixels = np.array(
        [i.points2D[e.point2D_idx].xy for i, e in zip(images, track.elements, strict=True)]
    )
    cameras = [model.cameras[i.camera_id] for i in images]
    if any(len(camera.params) > NUM_PINHOLE_PARAMS for camera in cameras):
        pixels = np.array([undistorted(c, xy) for c, xy in zip(cameras, pixels, strict=True)])
    K = np.array([model.cameras[i.camera_id].calibration_matrix() for i in images])
    w2c = np.array([i.cam_from_world().matrix() for i in images])  # (V, 3, 4)
    rotations = np.swapaxes(w2c[:, :, :3], 1, 2)
    centers = -np.einsum("vij,vj->vi", rotations, w2c[:, :, 3])
    c2w = np.concatenate([rotations, centers[:, :, None]], 2)
    rays = np.einsum("vij,vj->vi", rotations, pinhole.camera_rays(pixels, K))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]  # projects onto a ray's normal plane
    right = np.einsum("vij,vj->i", across, centers)
    point = np.linalg.lstsq(across.sum(0), right, rcond=None)[0]
    projected, depth = pinhole.project(point, K, c2w)
    if (depth <= 0).any():
        return point, np.inf
    error = float(np.linalg.norm(projected - pixels, axis=1).mean())
    return point, unbiased_error(error, len(pixels))


def undistorted(camera: Any, pixel: np.ndarray) -> np.ndarray:
    """The pixel (2,) that a recorded one would be without the lens's distortion."""
    plane = camera.cam_from_img(pixel)
    return camera.calibration_matrix()[:2] @ np.append(plane, 1.0)
