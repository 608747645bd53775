"""Camera poses of a clip and the static points they were estimated from: checks,
interpolation of frames that did not register, and the words that report them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hdr_nsff.core.errors import NoSceneError
from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.lens import Lens

ADVICE = (
    "film with the camera moving sideways past textured, static surfaces, say `--tripod` if "
    "it stood still, give masks of the moving objects (--mask FOLDER), or import poses "
    "(--poses FOLDER or FILE)"
)
RIG_ADVICE = (
    "place the cameras nearer to each other, or give the poses of a calibration (--poses FILE); "
    "for still cameras one each is enough"
)
# share of frames with poses of their own below which poses have failed (hand-chosen)
MIN_REGISTERED_SHARE = 0.6
MAX_LISTED_RANGES = 8  # in a message


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
    # (O, 4) one observation of a point: frame, point, x, y in pixels
    tracks: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    # (T,) median reprojection error in pixels, NaN = none
    frame_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))
    near: float | None = None  # z-depth, scene units
    far: float | None = None
    notes: tuple[str, ...] = ()  # sentences for the user
    # {camera_id: lens} where the frames turned out to be distorted: these poses are
    # then only the start
    lenses: dict[int, Lens] = field(default_factory=dict)
    readout: float = 0.0  # of the rolling shutter that they were estimated with, in frames


def format_ranges(numbers: list[int]) -> str:
    """[1, 2, 3, 7] as "1-3, 7", shortened after eight ranges."""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], n]
        else:
            runs.append([n, n])
    words = [str(first) if first == last else f"{first}-{last}" for first, last in runs]
    shortened = ", ".join(words[:MAX_LISTED_RANGES])
    return shortened if len(words) <= MAX_LISTED_RANGES else f"{shortened}, ..."


def project(poses: Poses, frames: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and z-depths (N,) of world `points` (N, 3), the n-th point seen by
    the n-th of `frames` (N,).
    """
    return pinhole.project(points, poses.K[frames], poses.c2w[frames])


def trusted_points(poses: Poses, views: int = 3, error: float = 2.0) -> Poses:
    """Poses with only their reliable points, and every frame's median error.

    Points of fewer than `views` observations, with a mean reprojection error of `error`
    pixels or more, or behind a camera are dropped.
    """
    frames, rows = poses.tracks[:, 0].astype(int), poses.tracks[:, 1].astype(int)
    pixels, depth = project(poses, frames, poses.points[rows])
    residual = np.linalg.norm(pixels - poses.tracks[:, 2:], axis=1)
    count = len(poses.points)
    num_observations = np.bincount(rows, minlength=count)
    num_behind = np.bincount(rows, weights=depth <= 0, minlength=count)
    trusted = (num_observations >= views) & (poses.point_errors < error) & (num_behind == 0)
    kept = trusted[rows]
    tracks = poses.tracks[kept]
    new_rows = np.cumsum(trusted) - 1
    tracks[:, 1] = new_rows[rows[kept]]
    return replace(
        poses,
        points=poses.points[trusted],
        point_errors=poses.point_errors[trusted],
        tracks=tracks,
        frame_errors=median_per_frame(residual[kept], frames[kept], len(poses.c2w)),
    )


def median_per_frame(values: np.ndarray, frames: np.ndarray, count: int) -> np.ndarray:
    """The median (count,) of `values` (N,) over each of `frames` (N,), NaN for none."""
    medians = np.full(count, np.nan)
    for t in np.unique(frames):
        medians[t] = np.median(values[frames == t])
    return medians


def interpolate(poses: Poses, groups: list[list[int]]) -> Poses:
    """Poses with frames that did not register placed between their neighbors.

    `groups` holds the frames of each physical camera in order; neighbors are registered
    frames of the same camera. Poses are held constant at the ends of the clip.
    NoSceneError where a camera has no registered frame.
    """
    c2w = poses.c2w.copy()
    filled: list[int] = []
    for group in groups:
        known = [t for t in group if poses.registered[t]]
        missing = [t for t in group if not poses.registered[t]]
        if not missing:
            continue
        if not known:
            raise NoSceneError(
                f"poses failed: none of the frames of one camera could be registered "
                f"(frames {format_ranges(missing)}); {ADVICE}"
            )
        c2w[missing] = interpolated_c2w(c2w[known], known, missing)
        filled += missing
    if not filled:
        return poses
    note = (
        f"{len(filled)} of {len(c2w)} frames did not register; "
        f"their poses are interpolated (frames {format_ranges(sorted(filled))})"
    )
    return replace(poses, c2w=c2w, notes=(*poses.notes, note))


def interpolated_c2w(c2w: np.ndarray, known: list[int], missing: list[int]) -> np.ndarray:
    """Poses (M, 3, 4) of frames `missing` (M) from `c2w` (N, 3, 4) of frames `known`
    (N).

    Centers linearly, rotations along the shortest arc; constant beyond the first and
    last known frame.
    """
    frames = np.clip(missing, known[0], known[-1])
    centers = np.stack([np.interp(frames, known, c2w[:, k, 3]) for k in range(3)], -1)
    if len(known) > 1:
        rotations = Slerp(known, Rotation.from_matrix(c2w[:, :, :3]))(frames).as_matrix()
    else:
        rotations = np.repeat(c2w[:1, :, :3], len(missing), 0)
    return np.concatenate([rotations, centers[:, :, None]], 2)
