"""The white balance of every single frame, from static points: automatic white balance
that drifts.

A static point that frames t recorded gives a log exposure per frame and channel
(`frame_exposures.py`). What its channels have in common is exposure; the rest is white
balance. A drift is believed only where it exceeds that by which halves of the picture
differ, left and right or top and bottom (any halves, where one side has no points), and
where all brackets show it: a lamp that moves or changes its color does so where it
shines, and in the exposures that record it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from hdr_nsff.radiometry.frame_exposures import (
    FrameExposuresTuning,
    Readings,
    determined_frames,
    drift_is_shared,
    drift_within_brackets,
    frame_log_exposures,
    read_points,
)
from hdr_nsff.radiometry.static_samples import ResponseView

SEED = 0  # of the choice of static points


@dataclass(frozen=True)
class FrameColorsTuning:
    """When a drift of white balance is believed (hand-chosen on real clips with and
    without a drift that was put in).
    """

    # stops: smaller drifts (largest of all frames) are none; of twelve real clips ten
    # gave at most 0.05, one 0.09 that was worth 0.01 dB
    min_drift: float = 0.1
    sigmas: float = 4.0  # a drift exceeds half the difference of halves this many times
    # stops, or share of the drift: beyond, half their difference is that of a light (at
    # most 0.03 on nine clips with a drift of 0.15 put in; 0.04 of 0.33 on rendered
    # `night`, whose lamps move)
    max_difference: float = 0.03
    max_difference_share: float = 0.1
    smoothing_frames: float = 3.0  # sigma in time: white balance is changed slowly
    min_frames: int = 8
    frames: FrameExposuresTuning = field(default_factory=FrameExposuresTuning)


def frame_white_balance(
    views: Sequence[ResponseView],
    x: np.ndarray,
    y: np.ndarray,
    tuning: FrameColorsTuning = FrameColorsTuning(),
) -> np.ndarray | None:
    """The white balance (V, 3) of frames in stops, relative to their mean; None where
    there is no drift, or none that points determine.

    `x` (K,) and `y` (3, K) are the response curve. Channels have the mean 0 in every
    frame, and frames in every channel.
    """
    if len(views) < tuning.min_frames:
        return None
    ordered = sorted(range(len(views)), key=lambda i: views[i].time)
    in_time = [views[i] for i in ordered]
    brackets = np.array([v.bracket for v in in_time])
    readings = read_points(in_time, np.random.default_rng(SEED), tuning.frames)
    if not len(readings.frame):
        return None
    by_place = [readings.place[:, axis] < np.median(readings.place[:, axis]) for axis in (0, 1)]
    pairs = determined_halves(readings, by_place, len(views), tuning)
    if not pairs:  # points on one side only: any halves
        alternating = np.arange(len(readings.frame)) % 2 == 0
        pairs = determined_halves(readings, [alternating], len(views), tuning)
    if not pairs:
        return None
    halves = np.array(
        [[frame_colors(half, x, y, brackets, tuning) for half in pair] for pair in pairs]
    )  # (1 or 2, 2, V, 3)
    smoothed = np.stack([[smooth(h, tuning.smoothing_frames) for h in pair] for pair in halves])
    drift = smoothed.mean((0, 1))
    differences = smoothed[:, 0] - smoothed[:, 1]
    uncertainty = float(np.sqrt((differences**2).mean((1, 2)).max())) / 2
    most = float(np.abs(drift).max())
    if most < max(tuning.min_drift, tuning.sigmas * uncertainty):
        return None
    if uncertainty > max(tuning.max_difference, tuning.max_difference_share * most):
        return None
    of_brackets = smooth_within_brackets(halves.mean((0, 1)), brackets, tuning.smoothing_frames)
    largest = int(np.abs(drift).max(0).argmax())
    if not drift_is_shared(of_brackets[:, largest], brackets, tuning.frames):
        return None
    in_order = np.zeros((len(views), 3))
    in_order[ordered] = drift
    return in_order


def determined_halves(
    readings: Readings, splits: Sequence[np.ndarray], num_frames: int, tuning: FrameColorsTuning
) -> list[tuple[Readings, Readings]]:
    """The two halves of the points by each of `splits` (P,) bool, where both share
    enough points with every frame.
    """
    pairs = [(part_of(readings, split), part_of(readings, ~split)) for split in splits]
    return [
        pair
        for pair in pairs
        if all(determined_frames(half, num_frames, tuning.frames).all() for half in pair)
    ]


def part_of(readings: Readings, chosen: np.ndarray) -> Readings:
    """The `chosen` (P,) points."""
    samples = readings.samples
    return Readings(
        replace(
            samples,
            rgb=samples.rgb[chosen],
            valid=samples.valid[chosen],
            saturated=samples.saturated[chosen],
        ),
        readings.frame[chosen],
        readings.place[chosen],
    )


def frame_colors(
    readings: Readings,
    x: np.ndarray,
    y: np.ndarray,
    brackets: np.ndarray,
    tuning: FrameColorsTuning,
) -> np.ndarray:
    """The white balance (T, 3) of frames in stops, mean 0 in every bracket."""
    samples = readings.samples
    whole = samples.valid.all(-1)  # of all channels, so that these see the same points
    channels = []
    for channel in range(3):
        valid = np.zeros_like(samples.valid)
        valid[..., channel] = whole
        own = replace(readings, samples=replace(samples, valid=valid))
        exposures = frame_log_exposures(own, x, y, brackets, tuning.frames)
        channels.append(drift_within_brackets(exposures, brackets))
    colors = np.stack(channels, -1)
    return colors - colors.mean(1, keepdims=True)


def smooth(colors: np.ndarray, sigma: float) -> np.ndarray:
    """White balance (T, 3) without what changes within `sigma` frames, mean 0."""
    means = gaussian_filter1d(colors, sigma, axis=0, mode="nearest")
    return means - means.mean(0)


def smooth_within_brackets(colors: np.ndarray, brackets: np.ndarray, sigma: float) -> np.ndarray:
    """White balance (T, 3), smoothed over the frames of each bracket alone."""
    means = np.empty_like(colors)
    for bracket in np.unique(brackets):
        own = brackets == bracket
        means[own] = smooth(colors[own], sigma * own.mean())
    return means
