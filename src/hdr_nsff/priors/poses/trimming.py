"""What stands still, told by structure from motion itself: trimmed least squares
(Rousseeuw and Leroy 1987) over whole points.

A cloth in the wind or a dancer who stays in place is matched from frame to frame as
well as a wall is. Its points fit a rigid world worse, but where they are many they bend
cameras and focal length until they fit better. So points whose error is far beyond that
of the best ones are dropped and everything is adjusted anew, until nothing changes:
each time the static ones fit better and the others worse. In the end what fits the
cameras found that way comes back. Runs in the process of `sfm.py`, on a
`pycolmap.Reconstruction`.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np

ROUNDS = 8
BEST = 0.25  # share of all points that surely stand still
BEYOND = 2.0  # times the error of the worst of those: dropped
BACK = 3.0  # times the same, in the end: comes back
NEEDED = 30  # points of an image; one that would keep fewer keeps all it has


def trim(model: Any, adjust: Callable[[Any], object]) -> None:
    """Drop the points that do not stand still; `adjust` fits cameras and points of the
    `model` to what is left.
    """
    before, dropped = len(model.points3D), []
    for _ in range(ROUNDS if before else 0):
        keys, noise = errors(model)
        bad = misfits(model, keys, noise > BEYOND * best_of(noise, before))
        dropped += [deepcopy(model.points3D[key].track) for key in bad]
        for key in bad:
            model.delete_point3D(key)
        if len(bad) < 0.005 * before:
            break
        adjust(model)
    if dropped:
        limit = BACK * best_of(errors(model)[1], before)
        for track in dropped:
            place, off = triangulated(model, track)
            if off < limit:
                model.add_point3D(place, track)
        adjust(model)


def errors(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Every point's key (P,) and its error (P,) in pixels, made up for the three
    coordinates that were fitted to it.
    """
    model.update_point_3d_errors()
    keys = np.array(sorted(model.points3D), np.int64)
    points = [model.points3D[int(k)] for k in keys]
    return keys, np.array([made_up(p.error, len(p.track.elements)) for p in points])


def made_up(error: float, views: int) -> float:
    """A mean reprojection error of `views` >= 2 views as it would be had the point not
    been fitted to them.
    """
    return error * float(np.sqrt(2 * views / (2 * views - 3)))


def best_of(noise: np.ndarray, before: int) -> float:
    """The error of the worst of the best points."""
    return float(np.sort(noise)[min(int(BEST * before), len(noise) - 1)])


def misfits(model: Any, keys: np.ndarray, bad: np.ndarray) -> list[int]:
    """The `bad` (P,) ones of the points `keys` (P,), but for those that an image needs."""
    row = {int(key): n for n, key in enumerate(keys)}
    for image in model.images.values():
        seen = [row[int(p.point3D_id)] for p in image.points2D if p.has_point3D()]
        if np.sum(~bad[seen]) < NEEDED:
            bad[seen] = False
    return [int(k) for k in keys[bad]]


def triangulated(model: Any, track: Any) -> tuple[np.ndarray, float]:
    """The point (3,) nearest to the rays of a `track`, and its error in pixels;
    infinite behind a camera.
    """
    images = [model.images[e.image_id] for e in track.elements]
    seen = np.array(
        [i.points2D[e.point2D_idx].xy for i, e in zip(images, track.elements, strict=True)]
    )
    K = np.array([model.cameras[i.camera_id].calibration_matrix() for i in images])
    pose = np.array([i.cam_from_world().matrix() for i in images])  # (V, 3, 4)
    turn, shift = pose[:, :, :3], pose[:, :, 3]
    rays = np.einsum(
        "vji,vjk,vk->vi", turn, np.linalg.inv(K), np.concatenate([seen, np.ones((len(seen), 1))], 1)
    )
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]  # what lies beside the ray
    centers = -np.einsum("vji,vj->vi", turn, shift)
    place = np.linalg.lstsq(across.sum(0), np.einsum("vij,vj->i", across, centers), rcond=None)[0]
    local = turn @ place + shift
    if (local[:, 2] <= 0).any():
        return place, np.inf
    found = np.einsum("vij,vj->vi", K, local / local[:, 2:])[:, :2]
    return place, made_up(float(np.linalg.norm(found - seen, axis=1).mean()), len(seen))
