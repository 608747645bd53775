"""Camera poses of a clip, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hdr_nsff.core.errors import InputError


@dataclass(frozen=True)
class Poses:
    """Cameras of all frames of a clip, and the static points they were found from."""

    K: np.ndarray  # (T, 3, 3) pixels
    c2w: np.ndarray  # (T, 3, 4) OpenCV camera to world, scene units
    registered: np.ndarray  # (T,) bool; the others are interpolated
    parallax: Literal["full", "rotation", "none"]
    # (P, 3) static, scene units
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    # (P,) mean reprojection error, pixels
    point_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))
    # (O, 4) one view of a point: frame, point, x, y in pixels
    tracks: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    # (T,) median reprojection error in pixels, NaN = none
    frame_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))
    near: float | None = None  # z-depth, scene units
    far: float | None = None
    notes: tuple[str, ...] = ()  # sentences for people


def intrinsics(focal: float, width: int, height: int) -> np.ndarray:
    """K (3, 3) with the principal point in the middle."""
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def ranges(numbers: list[int]) -> str:
    """[1, 2, 3, 7] as "1-3, 7", shortened after eight ranges."""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], n]
        else:
            runs.append([n, n])
    words = [str(a) if a == b else f"{a}-{b}" for a, b in runs]
    return ", ".join(words[:8]) + (", ..." if len(words) > 8 else "")


def project(poses: Poses, frames: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and z-depths (N,) of world `points` (N, 3), each in its own one of
    `frames` (N,).
    """
    local = np.einsum("nji,nj->ni", poses.c2w[frames, :, :3], points - poses.c2w[frames, :, 3])
    pixels = np.einsum("nij,nj->ni", poses.K[frames], local)
    return pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-9), local[:, 2]


def trusted_points(poses: Poses, views: int = 3, error: float = 2.0) -> Poses:
    """Without points of fewer than `views` views, of a larger mean `error` (pixels) or
    behind a camera; with every frame's error.
    """
    frames, rows = poses.tracks[:, 0].astype(int), poses.tracks[:, 1].astype(int)
    pixels, depth = project(poses, frames, poses.points[rows])
    residual = np.linalg.norm(pixels - poses.tracks[:, 2:], axis=1)
    size = len(poses.points)
    good = (np.bincount(rows, minlength=size) >= views) & (poses.point_errors < error)
    good &= np.bincount(rows, weights=depth <= 0, minlength=size) == 0
    kept = good[rows]
    errors = np.full(len(poses.c2w), np.nan)
    for t in np.unique(frames[kept]):
        errors[t] = np.median(residual[kept & (frames == t)])
    tracks = poses.tracks[kept]
    tracks[:, 1] = (np.cumsum(good) - 1)[rows[kept]]
    return replace(
        poses,
        points=poses.points[good],
        point_errors=poses.point_errors[good],
        tracks=tracks,
        frame_errors=errors,
    )


def interpolate(poses: Poses, groups: list[list[int]]) -> Poses:
    """Poses of frames that did not register, between their registered neighbors of the
    same camera (held at the ends of the clip).
    """
    c2w, lost = poses.c2w.copy(), []
    for group in groups:
        known = [t for t in group if poses.registered[t]]
        missing = [t for t in group if not poses.registered[t]]
        if not missing:
            continue
        if not known:
            raise InputError(
                f"poses failed: none of the frames of one camera could be placed (frames {ranges(missing)}); {ADVICE}"
            )
        when = np.clip(missing, known[0], known[-1])
        c2w[missing, :, 3] = np.stack(
            [np.interp(when, known, c2w[known, k, 3]) for k in range(3)], -1
        )
        turn = Rotation.from_matrix(c2w[known, :, :3])
        c2w[missing, :, :3] = (
            Slerp(known, turn)(when).as_matrix() if len(known) > 1 else c2w[known[0], :, :3]
        )
        lost += missing
    if not lost:
        return poses
    note = f"{len(lost)} of {len(c2w)} frames did not register; their poses are interpolated (frames {ranges(sorted(lost))})"
    return replace(poses, c2w=c2w, notes=(*poses.notes, note))


ADVICE = (
    "film with the camera moving sideways past textured, unmoving things, give masks of the moving objects (--mask FOLDER), "
    "or import poses (--poses FOLDER or FILE)"
)


ENOUGH, LEAST = 0.9, 0.6  # share of frames to be content with, and below which poses have failed
