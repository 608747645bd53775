"""Where tracks of moving pixels start: on a grid in a few frames spread over the clip,
then wherever a region moves that no track reaches, as of somebody who passes between
two of these frames.

A `moving` mask is (H, W) bool; pixels are (x, y) with centers at +0.5.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy import ndimage

from hdr_nsff.priors.movers.tuning import TRACK_TUNING, TrackTuning


def spread_times(num: int, tuning: TrackTuning = TRACK_TUNING) -> list[int]:
    """The times, of `num`, at which tracks start everywhere."""
    spread = np.linspace(0, num - 1, min(tuning.start_frames, num))
    return sorted({round(time) for time in spread.tolist()})


def start_spacing(moving: Iterable[np.ndarray], tuning: TrackTuning = TRACK_TUNING) -> int:
    """Pixels from one start to the next, in x and in y, of tracks that start in all
    these masks.
    """
    num_pixels = sum(int(inner_pixels(mask).sum()) for mask in moving)
    return max(tuning.stride_px, math.ceil(math.sqrt(num_pixels / tuning.max_starts)))


def starting_pixels(moving: np.ndarray, spacing: int) -> np.ndarray:
    """The pixels (N, 2) of a mask at which tracks start."""
    y, x = np.nonzero(inner_pixels(moving))
    on_grid = (x % spacing == 0) & (y % spacing == 0)
    return np.stack([x[on_grid], y[on_grid]], -1) + 0.5


def inner_pixels(moving: np.ndarray) -> np.ndarray:
    """The moving pixels (H, W) that have moving ones on all sides."""
    return ndimage.binary_erosion(moving)


def missed_regions(
    moving: Sequence[np.ndarray], pixels: np.ndarray, tuning: TrackTuning = TRACK_TUNING
) -> dict[int, np.ndarray]:
    """The regions of the masks in which no track has `pixels` (N, T, 2): one mask for
    each time that has some.
    """
    missed = {}
    for t, mask in enumerate(moving):
        regions, count = ndimage.label(mask)
        large = np.bincount(regions.ravel(), minlength=count + 1) >= (
            tuning.min_region_share * mask.size
        )
        x, y = pixels[np.isfinite(pixels[:, t, 0]), t].astype(int).T
        large[regions[y, x]] = False
        large[0] = False
        if large.any():
            missed[t] = large[regions]
    return missed


def middle_times(missed: Mapping[int, np.ndarray], tried: Iterable[int]) -> list[int]:
    """The time in the middle of every run of consecutive times with missed regions, or
    the one next to it that was not `tried` before.
    """
    times = np.array(sorted(missed), int)
    runs = np.split(times, np.flatnonzero(np.diff(times) > 1) + 1)
    chosen = []
    for run in runs:
        untried = np.setdiff1d(run, np.fromiter(tried, int))
        if len(untried):
            chosen.append(int(untried[np.argmin(np.abs(untried - run.mean()))]))
    return chosen
