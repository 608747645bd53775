"""Keypoints as a camera without a rolling shutter would have seen them.

Row y of frame t is recorded at t + r (y / H - 1/2), with r the readout in frames. Every
keypoint is moved to where it was when the middle row was read, at the velocity that its
matches with neighboring frames show. Structure from motion then finds the cameras of
the middle rows, with which a field is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from hdr_nsff.priors.poses.view_matches import ViewMatches

MAX_GAP = 8  # frames between views whose matches show a keypoint's velocity; the nearest count
MIN_ELAPSED = 0.2  # share of the time between two frames; a match across more rows is wrong
NEIGHBORS = 5  # keypoints whose velocity stands for that of one without such matches


@dataclass(frozen=True)
class ReadoutTuning:
    """How a readout is measured, in frames."""

    step: float = 0.4  # the error is measured with 0, 1 and 2 of them
    # share by which the error must fall: 9 and 4 % on rendered clips with a readout of
    # 0.6, less than 1 % on those without and on two filmed ones
    min_gain_share: float = 0.02
    max_readout: float = 1.2  # no shutter takes longer than a frame's time


def best_readout(error: Callable[[float], float], tuning: ReadoutTuning = ReadoutTuning()) -> float:
    """The readout in frames at which a parabola through three squares of the `error` is
    least; 0 where it falls too little, or no shutter is like that.

    Keypoints miss by a constant, and in proportion to the error of the readout: squares
    add up.
    """
    none, once, twice = (error(k * tuning.step) ** 2 for k in range(3))
    slope, curvature = (twice - none) / 2, none - 2 * once + twice
    if curvature <= 0:
        return 0.0
    readout = tuning.step * (1 - slope / curvature)
    least = once - slope**2 / (2 * curvature)
    is_possible = 0 < readout <= tuning.max_readout
    falls = least < (1 - tuning.min_gain_share) ** 2 * none
    return readout if is_possible and falls else 0.0


def at_middle_rows(
    found: ViewMatches, groups: Sequence[Sequence[int]], readout: float, height: int
) -> ViewMatches:
    """The keypoints of static points at the time of the middle row of their view.

    `groups`: the views of each camera, in time, one per frame; `readout`: from the
    first row to the last, in frames; `height`: of the images, pixels.
    """
    delays = [readout * (xy[:, 1] / height - 0.5) for xy in found.keypoints]
    keypoints = [
        xy - delay[:, None] * of_all(velocity, xy)
        for xy, delay, velocity in zip(
            found.keypoints, delays, velocities(found, groups, delays), strict=True
        )
    ]
    return replace(found, keypoints=keypoints)


def velocities(
    found: ViewMatches, groups: Sequence[Sequence[int]], delays: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """The velocity (N, 2) of the keypoints of each view, pixels a frame, NaN where no
    match shows it; `delays` (N,): when each was read, frames after the middle row.

    The mean of those from the frame before and to the frame after, either of them where
    the other is not known.
    """
    order = {view: (k, place) for k, group in enumerate(groups) for place, view in enumerate(group)}
    before, after = ([np.full(xy.shape, np.nan) for xy in found.keypoints] for _ in range(2))
    gaps = [
        order[b][1] - order[a][1] if order[a][0] == order[b][0] else MAX_GAP + 1
        for a, b in found.pairs
    ]
    nearest_last = sorted(range(len(gaps)), key=lambda k: -abs(gaps[k]))
    for k in nearest_last:
        (a, b), (rows, columns), gap = found.pairs[k], found.matches[k].T, gaps[k]
        if abs(gap) > MAX_GAP:
            continue
        moved = found.keypoints[b][columns] - found.keypoints[a][rows]
        elapsed = (gap + delays[b][columns] - delays[a][rows])[:, None]
        velocity = np.divide(
            moved, elapsed, out=np.full(moved.shape, np.nan), where=elapsed / gap > MIN_ELAPSED
        )
        (after if gap > 0 else before)[a][rows] = velocity
        (before if gap > 0 else after)[b][columns] = velocity
    return [mean_of_known(first, second) for first, second in zip(before, after, strict=True)]


def mean_of_known(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The mean of two arrays, either of them where the other is NaN."""
    filled = np.where(np.isnan(first), second, first), np.where(np.isnan(second), first, second)
    return (filled[0] + filled[1]) / 2


def of_all(velocity: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """The velocity (N, 2) of all keypoints `xy` (N, 2) of a view; where it is NaN, the
    median of the nearest ones that have it, 0 where none has.
    """
    known = ~np.isnan(velocity[:, 0])
    if not known.any():
        return np.zeros_like(velocity)
    count = min(NEIGHBORS, int(known.sum()))
    _, nearest = KDTree(xy[known]).query(xy[~known], range(1, count + 1))
    filled = velocity.copy()
    filled[~known] = np.median(velocity[known][nearest], 1)
    return filled
