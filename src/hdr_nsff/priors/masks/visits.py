"""Moving masks and static pictures of cameras that take the frames of a clip in turn.

A camera of such a rig comes back to the same view every few frames: its visits. What
most of its visits show at a pixel is the static scene, and what differs from that
moves: background subtraction (Stauffer and Grimson 1999) with one value per pixel,
since visits are few. No flow and no poses are needed. Frames are equalized rgb in
[0, 1]; True means moving.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import cv2
import numpy as np

from hdr_nsff.core.stack import ArrayStack, spread_frames
from hdr_nsff.priors.masks.geometric import extract_objects
from hdr_nsff.priors.masks.geometric_tuning import GEOMETRIC_MASK_TUNING, GeometricMaskTuning
from hdr_nsff.radiometry.common_range import recorded_range

SIGMA_PER_MAD = 1.48  # standard deviation of a Gaussian per median absolute deviation


@dataclass(frozen=True)
class VisitTuning:
    """What differs between two visits (hand-chosen on rendered rigs)."""

    blur_px: float = 0.7
    """Standard deviation of the blur of the frames before they are compared."""
    noise_levels: int = 8
    """Ranges of brightness, each with its own noise."""
    min_noise: float = 0.004
    """Lower bound of the noise, in [0, 1] of equalized rgb."""
    relative_noise: float = 0.02
    """Noise as a share of the value: light changes by so much."""
    max_distance: float = 8.0
    """Distances are limited to this many standard deviations."""
    same_distance: float = 2.0
    """Two visits closer than this many standard deviations show the same."""
    score_scale: float = 0.5
    """Units of `objects` per standard deviation, where nothing else is known."""
    max_score: float = 4.5
    """Standard deviations that distances are limited to beside other evidence."""
    smoothing_px: float = 1.0
    """Standard deviation of the blur of the squared distances."""
    max_compared: int = 24
    """Visits of a camera that are compared with each other; of more, those spread
    evenly.
    """
    objects: GeometricMaskTuning = GEOMETRIC_MASK_TUNING
    """How scores become objects."""


VISIT_TUNING = VisitTuning()


@dataclass(frozen=True)
class StaticPictures:
    """What the cameras of a rig see of the static scene; N cameras."""

    video: np.ndarray  # (N, H, W, 3) equalized rgb in [0, 1]
    clipped: np.ndarray  # (N, H, W) bool: no information
    unknown: np.ndarray  # (N, H, W) bool: no two visits agree
    moving: np.ndarray  # (T, H, W) bool, of the frames
    # (T, H, W) between a frame and its camera's picture, standard deviations of noise
    distance: np.ndarray


def separate_movers(
    video: ArrayStack,
    clipped: ArrayStack,
    places: Sequence[int],
    learned: np.ndarray | None = None,
    tuning: VisitTuning = VISIT_TUNING,
) -> StaticPictures:
    """The static picture of every camera, and the moving pixels of every frame.

    `video` (T, H, W, 3) and `clipped` (T, H, W) are equalized frames; `places` (T,)
    number the camera of each from 0 without gaps. The pictures come from the `learned`
    (T,) frames, by default all.
    """
    camera_of = np.asarray(places)
    count = int(camera_of.max()) + 1
    if learned is None:
        learned = np.ones(len(video), bool)
    height, width = video.shape[1:3]
    pictures = np.zeros((count, height, width, 3), np.float32)
    unrecorded = np.ones((count, height, width), bool)
    unknown = np.ones((count, height, width), bool)
    moving = np.zeros((len(video), height, width), bool)
    difference = np.zeros((len(video), height, width), np.float32)
    for camera in range(count):
        times = np.flatnonzero(camera_of == camera)
        visits = read_visits(video, clipped, times, tuning)
        own = np.flatnonzero(learned[times])
        if not len(own):
            continue
        noise = noise_of_visits(visits, own, tuning)
        compared = own[spread_frames(len(own), tuning.max_compared)]
        chosen = most_supported(visits, noise, compared, tuning)
        from_static = distances_from(visits, noise, chosen, compared, tuning)
        supporters = from_static < tuning.same_distance
        supporters[~learned[times]] = False
        recorded = supporters & ~visits.clipped
        unrecorded[camera] = ~recorded.any(0)
        used = np.where(unrecorded[camera], supporters, recorded)
        pictures[camera] = weighted_mean(visits.frames, used)
        unknown[camera] = supporters.sum(0) < 2
        for t, distance in zip(times, from_static, strict=True):
            difference[t] = np.minimum(distance, tuning.max_score)
            moving[t] = extract_objects(tuning.score_scale * distance, tuning.objects)
    return StaticPictures(pictures, unrecorded, unknown, moving, difference)


@dataclass(frozen=True)
class Visits:
    """The frames of one camera; V visits."""

    frames: np.ndarray  # (V, H, W, 3) equalized rgb in [0, 1]
    blurred: np.ndarray  # (V, H, W, 3)
    clipped: np.ndarray  # (V, H, W) bool
    ranges: list[tuple[np.ndarray, np.ndarray]]  # the lowest and highest rgb of each

    def in_common(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Two blurred visits (H, W, 3), limited to the range that both recorded."""
        low = np.maximum(self.ranges[a][0], self.ranges[b][0])
        high = np.minimum(self.ranges[a][1], self.ranges[b][1])
        return np.clip(self.blurred[a], low, high), np.clip(self.blurred[b], low, high)


def read_visits(
    video: ArrayStack, clipped: ArrayStack, times: np.ndarray, tuning: VisitTuning = VISIT_TUNING
) -> Visits:
    """The frames `times` (V,) of one camera."""
    frames = np.stack([np.asarray(video[t], np.float32) for t in times])
    without = np.stack([np.asarray(clipped[t], bool) for t in times])
    blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), tuning.blur_px) for frame in frames])
    ranges = [recorded_range(f, c) for f, c in zip(frames, without, strict=True)]
    return Visits(frames, blurred, without, ranges)


def visit_distance(
    visits: Visits, noise: np.ndarray, a: int, b: int, tuning: VisitTuning
) -> np.ndarray:
    """The distance (H, W) between two visits in standard deviations of the `noise`
    (V, H, W, 3).
    """
    first, second = visits.in_common(a, b)
    variance = noise[a] ** 2 + noise[b] ** 2
    squared = ((first - second) ** 2 / variance).mean(-1)
    squared = np.minimum(squared, tuning.max_distance**2)
    return np.asarray(np.sqrt(cv2.GaussianBlur(squared, (0, 0), tuning.smoothing_px)), np.float32)


def noise_of_visits(
    visits: Visits, learned: np.ndarray, tuning: VisitTuning = VISIT_TUNING
) -> np.ndarray:
    """The standard deviation (V, H, W, 3) of the noise of every visit.

    It is that of the median difference of two visits, at pixels of one brightness: less
    than half of them move. `learned` (L,): the visits that it is estimated from.
    """
    middle = np.median(visits.blurred[learned], 0)
    edges = np.quantile(middle, np.linspace(0, 1, tuning.noise_levels + 1))

    def level(values: np.ndarray) -> np.ndarray:
        return np.clip(np.searchsorted(edges, values) - 1, 0, tuning.noise_levels - 1)

    common = [visits.in_common(a, b) for a, b in pairwise(learned)]
    differences = np.array([np.abs(a - b) for a, b in common])
    noise = np.full(tuning.noise_levels, tuning.min_noise, np.float32)
    level_of_middle = level(middle)
    for k in range(tuning.noise_levels if len(common) else 0):
        own = differences[:, level_of_middle == k]
        if own.size:
            sigma = SIGMA_PER_MAD * float(np.median(own)) / np.sqrt(2)
            noise[k] = max(noise[k], sigma)
    of_visits = [
        np.hypot(noise[level(frame)], np.float32(tuning.relative_noise) * frame)
        for frame in visits.blurred
    ]
    return np.stack(of_visits)


def most_supported(
    visits: Visits, noise: np.ndarray, compared: np.ndarray, tuning: VisitTuning
) -> np.ndarray:
    """The visit (H, W) that most of those `compared` (C,) agree with at each pixel, the
    nearest to them among equals.
    """
    size = visits.frames.shape[1:3]
    support = np.ones((len(compared), *size), np.int32)  # each agrees with itself
    spread = np.zeros((len(compared), *size), np.float32)
    for i, j in combinations(range(len(compared)), 2):
        distance = visit_distance(visits, noise, compared[i], compared[j], tuning)
        agreeing = distance < tuning.same_distance
        for k in (i, j):
            support[k] += agreeing
            spread[k] += np.where(agreeing, distance, 0)
    return compared[np.argmax(support - spread / (1 + spread), 0)]


def distances_from(
    visits: Visits, noise: np.ndarray, chosen: np.ndarray, compared: np.ndarray, tuning: VisitTuning
) -> np.ndarray:
    """Distances (V, H, W) of all visits from the visit `chosen` (H, W) at each pixel,
    one of those `compared` (C,).
    """
    distances = np.zeros((len(visits.frames), *chosen.shape), np.float32)
    for b in compared:
        there = chosen == b
        for a in range(len(distances) if there.any() else 0):
            if a != b:
                distance = visit_distance(visits, noise, min(a, b), max(a, b), tuning)
                distances[a][there] = distance[there]
    return distances


def weighted_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The mean (H, W, C) of `values` (V, H, W, C) over the visits with `weights`
    (V, H, W).
    """
    total = weights.sum(0)[..., None]
    return (values * weights[..., None]).sum(0) / np.maximum(total, 1e-9)


def without_movers(
    video: ArrayStack,
    clipped: ArrayStack,
    moving: np.ndarray,
    places: Sequence[int],
    count: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mean (N, H, W, 3) of the static pixels of the frames of each of `count`
    cameras, which pixels (N, H, W) are clipped in all of them, and where none is static
    (N, H, W); arguments as of `separate_movers`, with `moving` (T, H, W) bool known.
    """
    pictures, unrecorded, unknown = [], [], []
    for camera in range(count):
        own = np.flatnonzero(np.asarray(places) == camera)
        frames = np.stack([np.asarray(video[t], np.float32) for t in own])
        static = ~moving[own]
        hidden = ~static.any(0)
        static |= hidden
        recorded = static & ~np.stack([np.asarray(clipped[t], bool) for t in own])
        lost = ~recorded.any(0)
        pictures.append(weighted_mean(frames, np.where(lost, static, recorded)))
        unrecorded.append(lost)
        unknown.append(hidden)
    return np.stack(pictures), np.stack(unrecorded), np.stack(unknown)
