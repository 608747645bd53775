"""What stands still, told by structure from motion itself: trimmed least squares (Rousseeuw 1984) over whole points.

A cloth in the wind or a dancer who stays in place is matched from frame to frame as well as a wall is. Its points fit a rigid world
worse, but where they are many they bend cameras and focal length until they fit better. So points whose error is far beyond that of the
best ones are dropped and everything is adjusted anew, until nothing changes: each time the static ones fit better and the others worse.
Runs in the process of `sfm.py`, on a `pycolmap.Reconstruction`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

ROUNDS = 8
BEST = 0.25  # share of all points that surely stand still
BEYOND = 2.0  # times the error of the worst of those: what does not stand still
NEEDED = 30  # points of an image; one that would keep fewer keeps all it has


def trim(model: Any, adjust: Callable[[Any], object]) -> None:
    """Drop the points that do not stand still; `adjust` fits cameras and points of the `model` to what is left."""
    before = len(model.points3D)
    for _ in range(ROUNDS if before else 0):
        model.update_point_3d_errors()
        bad = misfits(model, int(BEST * before))
        for key in bad:
            model.delete_point3D(key)
        if len(bad) < 0.005 * before:
            break
        adjust(model)


def misfits(model: Any, best: int) -> list[int]:
    """The points that fit far worse than the `best` ones do, but for those that an image needs."""
    keys = np.array(sorted(model.points3D), np.int64)
    points = [model.points3D[int(k)] for k in keys]
    views = np.array([len(p.track.elements) for p in points])
    noise = np.array([p.error for p in points]) * np.sqrt(2 * views / (2 * views - 3))  # what three coordinates took away
    bad = noise > BEYOND * np.sort(noise)[min(best, len(noise) - 1)]
    row = {int(key): n for n, key in enumerate(keys)}
    for image in model.images.values():
        seen = [row[int(p.point3D_id)] for p in image.points2D if p.has_point3D()]
        if np.sum(~bad[seen]) < NEEDED:
            bad[seen] = False
    return [int(k) for k in keys[bad]]
