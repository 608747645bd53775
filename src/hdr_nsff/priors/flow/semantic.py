"""Flow by what things look like to a network (paper section 3.4), which changes little
with the exposure.

Features of all frames, fitted to the clip (`adapt`), are matched between two frames by
cosine cost volume and soft-argmax; cells whose round trip fails are filled from
believed ones of like color, and dense inverse search goes on from there to sub-pixel
flow. Measured on rendered scenes with exact flow, this beats matching from nothing
wherever things move by more than a few pixels and is as good elsewhere, so it is asked
everywhere and not on moving pixels alone, as the paper has to with its noisy
background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.round_trip import follow, round_trip
from hdr_nsff.priors.flow.adapt import AdaptWeights, Lesson, Matching, Track, adapt, colors
from hdr_nsff.priors.flow.correlation import motion
from hdr_nsff.priors.flow.dense import checked, dense_inverse_search
from hdr_nsff.priors.flow.features import FeatureName, Features, Source, feature_source
from hdr_nsff.radiometry.common_range import common_gray, recorded_range

REACH = 1 / 6  # of the longer side: how far things may move from frame to frame
LOST = 1.5  # cells by which a round trip may miss
ALIKE = 0.05  # difference of rgb at which a neighbor's motion counts exp(-1/2)
FILL_RADIUS, PIXEL_RADIUS = (
    4,
    1,
)  # cells around from which a cell is filled, and a pixel gets its motion
ENOUGH = 100  # believed pixels, below which a pair of equal exposure teaches nothing

Pairs = Sequence[tuple[int, int]]


@dataclass(frozen=True)
class SemanticConfig:
    """Settings of `--flow semantic`."""

    features: FeatureName = "xfeat"
    """The network whose features are matched. xfeat: small, for any CPU; dinov2-large:
    the paper's.
    """
    layer: int | None = None
    """Of DINOv2: after how many layers features are taken. Default 15 of 24, and that
    share of fewer.
    """
    stride: int | None = None
    """Of DINOv2: pixels from token to token. Default 7, half a patch."""
    steps: int | None = None
    """Steps of fitting the features to the clip; 0 takes them as they are. Default: 0
    for XFeat, which fitting made no better, 300 for DINOv2.
    """
    seed: int = 0
    """Randomness of that fitting."""


def semantic_flow(
    config: SemanticConfig, weights: Path | None, neighbors: Pairs, equal: Pairs
) -> SemanticFlow:
    """The flow prior of these settings; `weights` of the features, None for wherever
    they are found; pairs as of `SemanticFlow`.
    """
    steps = (0 if config.features == "xfeat" else 300) if config.steps is None else config.steps
    if steps < 0:
        raise InputError(f"--semantic.steps {steps}: must be 0 or more")
    source = feature_source(config.features, weights, config.layer, config.stride)
    return SemanticFlow(source, neighbors, equal, steps, config.seed)


class SemanticFlow:
    """`FlowPrior` by features. It looks at the clip once, when the first pairs are
    asked for: features, and their fitting to it.
    """

    def __init__(
        self,
        source: Source,
        neighbors: Pairs = (),
        equal: Pairs = (),
        steps: int = 0,
        seed: int = 0,
    ) -> None:
        """What the features are fitted to: `neighbors`, pairs of frames one after the
        other, and `equal`, pairs of consecutive frames of equal exposure. No `steps`,
        or no neighbors, leaves the features as they are.
        """
        self.source, self.neighbors, self.equal = source, list(neighbors), list(equal)
        self.steps, self.seed = steps, seed
        self.features: Features | None = None

    def __call__(
        self, video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow (P, H, W, 2) px and valid (P, H, W) of `pairs` (P, 2); `video` (T, H, W,
        3) is that of the whole clip.
        """
        if self.features is None:
            self.features = self.fitted(video, clipped)
        return matched(self.features, video, clipped, pairs)

    def fitted(self, video: np.ndarray, clipped: np.ndarray) -> Features:
        """The clip's features, fitted to it."""
        found = self.source(video)
        if self.steps == 0 or not self.neighbors:
            return found
        tracks = equal_tracks(found, video, clipped, self.equal)
        lesson = Lesson(found, video, tracks, self.neighbors, how(found, video))
        return Features(
            adapt(lesson, self.steps, self.seed, AdaptWeights()), found.stride, found.origin
        )


def how(features: Features, video: np.ndarray) -> Matching:
    """How far matches are looked for in frames of this size."""
    return Matching(reach=REACH * max(video.shape[1:3]) / features.stride)


def matched(
    features: Features,
    video: np.ndarray,
    clipped: np.ndarray,
    pairs: np.ndarray,
    report: str | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) px and valid (P, H, W) of `pairs` (P, 2): coarse by `features`,
    fine by what the pictures show.
    """
    ranges = {
        int(k): recorded_range(video[k], clipped[k]) for k in np.unique(np.asarray(pairs, np.int64))
    }

    def both_ways(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        a, b = common_gray(video, ranges, i, j)
        there, back = coarse(features, video, i, j)
        return dense_inverse_search(a, b, there), dense_inverse_search(b, a, back)

    return checked(both_ways, clipped, pairs, report)


def coarse(features: Features, video: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px from frame `i` to `j`, and back, by features alone: what fails
    its round trip is taken from around.
    """
    m, maps = how(features, video), features.maps
    with torch.no_grad():
        there = motion(maps[i], maps[j], m.reach, m.radius, m.temperature).numpy()
        back = motion(maps[j], maps[i], m.reach, m.radius, m.temperature).numpy()
        shown = colors(video[[i, j]], features, 1).permute(0, 2, 3, 1).numpy()
    flows = []
    for one, other, k, cell_rgb in ((there, back, i, shown[0]), (back, there, j, shown[1])):
        sure = round_trip(one, other) < LOST
        flows.append(
            to_pixels(fill(one, sure, cell_rgb), cell_rgb, video[k], features)
            * np.float32(features.stride)
        )
    return flows[0], flows[1]


def fill(values: np.ndarray, sure: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Motion (h, w, 2) of cells, where not `sure` (h, w) that of sure cells nearby of
    like `rgb` (h, w, 3); as it was if none is sure.
    """
    at = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in sure.shape[::-1])), -1)
    while sure.any() and not sure.all():
        guess, weight = spread(values, sure, rgb, at, rgb, FILL_RADIUS)
        reached = ~sure & (weight > 0)
        values, sure = np.where(reached[..., None], guess, values), sure | reached
    return values


def to_pixels(
    values: np.ndarray, cell_rgb: np.ndarray, rgb: np.ndarray, features: Features
) -> np.ndarray:
    """Motion (h, w, 2) of cells as that of the pixels of `rgb` (H, W, 3): each takes
    after the cells around it that look like it.
    """
    h, w = rgb.shape[:2]
    x, y = (
        (np.arange(n, dtype=np.float32) + 0.5 - features.origin) / features.stride for n in (w, h)
    )
    return spread(
        values,
        np.ones(values.shape[:2], bool),
        cell_rgb,
        np.stack(np.meshgrid(x, y), -1),
        rgb,
        PIXEL_RADIUS,
    )[0]


def spread(
    values: np.ndarray,
    sure: np.ndarray,
    cell_rgb: np.ndarray,
    at: np.ndarray,
    rgb: np.ndarray,
    radius: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The mean of `values` (h, w, C) of `sure` (h, w) cells around the positions `at`
    (H, W, 2), in cells, and its total weight (H, W).

    A cell counts by its distance, at most about `radius` cells, and by the likeness of
    its `cell_rgb` (h, w, 3) to `rgb` (H, W, 3). Only sure cells enter, so nothing
    beyond an edge is mixed in, whatever is there; 0 where there is none.
    """
    h, w = sure.shape
    nearest = np.rint(at).astype(int)
    total, weights = (
        np.zeros((*at.shape[:2], values.shape[-1]), np.float32),
        np.zeros(at.shape[:2], np.float32),
    )
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            x, y = nearest[..., 0] + dx, nearest[..., 1] + dy
            inside = (x >= 0) & (y >= 0) & (x < w) & (y < h)
            x, y = x.clip(0, w - 1), y.clip(0, h - 1)
            distance = ((np.stack([x, y], -1) - at) ** 2).sum(-1) / (radius / 2) ** 2
            unlike = ((cell_rgb[y, x] - rgb) ** 2).sum(-1) / ALIKE**2
            weight = np.where(
                inside & sure[y, x], np.exp(-0.5 * (distance + np.minimum(unlike, 20))), 0
            ).astype(np.float32)
            total += np.where(weight[..., None] > 0, weight[..., None] * values[y, x], 0)
            weights += weight
    return total / np.maximum(weights, 1e-12)[..., None], weights


def equal_tracks(
    features: Features, video: np.ndarray, clipped: np.ndarray, equal: Pairs
) -> list[Track]:
    """Points followed over one and over two cycles, both ways, between frames of equal
    exposure.
    """
    both = [p for i, j in equal for p in ((i, j), (j, i))]
    if not both:
        return []
    found, valid = matched(features, video, clipped, np.array(both), "points of equal exposure")
    steps = {pair: (f, v) for pair, f, v in zip(both, found, valid, strict=True)}
    for i, j in both:
        for j_, k in both:
            if j == j_ and k != i:
                (first, ok), (second, ok2) = steps[i, j], steps[j, k]
                after = follow(ok2.astype(np.float32), first, fill=0.0) > 0.99
                steps[i, k] = (first + follow(second, first), ok & after)
    tracks = []
    for frames, (flow, ok) in steps.items():
        y, x = np.nonzero(ok)
        start = np.stack([x, y], -1) + 0.5 - features.origin
        if len(start) >= ENOUGH:
            ends = [
                torch.from_numpy(p / features.stride).float() for p in (start, start + flow[ok])
            ]
            tracks.append(Track(frames, ends[0], ends[1]))
    return tracks
