"""Flow by features of a network (paper section 3.4), which change little with exposure.

Features of all frames, fitted to the clip (`adapt`), are matched between two frames by
a cosine cost volume and a soft-argmax. Cells whose round trip fails are filled from
cells of similar color whose round trip holds, and dense inverse search refines the
result to sub-pixel flow. On rendered scenes with exact flow, this has a lower error
than dense inverse search alone wherever motion exceeds a few pixels, and the same
elsewhere. So it serves all pixels, not only moving ones as in the paper.

Cells are those of `Features`; flow is in pixels, x then y, as in `dense`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.core.tensors import CPU
from hdr_nsff.geometry.round_trip import follow, round_trip
from hdr_nsff.priors.flow.adapt import (
    AdaptTuning,
    Refiner,
    Track,
    TrainingClip,
    adapt_features,
    cell_colors,
    with_published_network,
)
from hdr_nsff.priors.flow.correlation import Search, feature_motion
from hdr_nsff.priors.flow.dense import (
    DENSE_FLOW_TUNING,
    DenseFlowTuning,
    dense_inverse_search,
    match_pairs,
    recorded_ranges,
)
from hdr_nsff.priors.flow.features import (
    FeatureName,
    Features,
    FeatureSource,
    FeatureTuning,
    check_xfeat,
    feature_source,
)
from hdr_nsff.priors.flow.joint_bilateral import joint_bilateral_mean
from hdr_nsff.radiometry.common_range import common_gray

DINOV2_STEPS = 300  # of fitting to a clip where no number is given; XFeat gained nothing by any

Pairs = Sequence[tuple[int, int]]


@dataclass(frozen=True)
class SemanticConfig:
    """Settings of `--flow semantic`."""

    features: FeatureName = "xfeat"
    """The network whose features are matched. xfeat: small, for any CPU; dinov2-large:
    the paper's.
    """
    layer: int | None = None
    """DINOv2 only: number of layers that run. Default: 15 of 24, or that share."""
    stride: int | None = None
    """DINOv2 only: pixels from token to token. Default: 7, half a patch."""
    steps: int | None = None
    """Steps of fitting the features to the clip; 0 leaves them as they are. Default: 0
    for XFeat, which did not gain by it, 300 for DINOv2.
    """
    refiner: Refiner = "small"
    """The network that is fitted. small: seconds on a CPU; published: the paper's, with
    its rate (it ran 10,000 steps).
    """
    seed: int = 0
    """Random seed of that fitting."""


@dataclass(frozen=True)
class SemanticTuning:
    """Tuning constants of flow by features, hand-chosen on rendered scenes."""

    reach: float = 1 / 6
    """Largest motion between frames, in x and in y, as a share of the longer side."""
    argmax_radius_cells: int = 1
    """Cells around the best one that the soft-argmax covers."""
    temperature: float = 0.05
    """Of the softmax of cosines."""
    max_round_trip_cells: float = 1.5
    """Round-trip error from which on a cell's motion is filled from others."""
    color_sigma: float = 0.05
    """Difference of rgb, in [0, 1], at which a cell's motion counts exp(-1/2)."""
    fill_radius_cells: int = 4
    """Distance from which an invalid cell is filled in one round."""
    pixel_radius_cells: int = 1
    """Distance from which a pixel gets its motion."""
    min_track_points: int = 100
    """Pairs of equal exposure with fewer valid pixels teach nothing."""
    features: FeatureTuning = field(default_factory=FeatureTuning)
    adapt: AdaptTuning = field(default_factory=AdaptTuning)

    def search(self, features: Features, video: ArrayStack) -> Search:
        """The search for `features` in frames of the size of `video` (T, H, W, 3)."""
        reach = self.reach * max(video.shape[1:3]) / features.stride
        return Search(reach, self.argmax_radius_cells, self.temperature)


SEMANTIC_TUNING = SemanticTuning()


def check_semantic(config: SemanticConfig) -> None:
    """InputError for settings that are out of range for every network."""
    least = {"layer": 1, "stride": 1, "steps": 0, "seed": 0}
    for name, lowest in least.items():
        value = getattr(config, name)
        if value is not None and value < lowest:
            raise InputError(f"--semantic.{name} {value}: must be {lowest} or more")
    if config.features == "xfeat":
        check_xfeat(config.layer, config.stride)


def semantic_flow(
    config: SemanticConfig,
    weights: Path | None,
    neighbors: Pairs,
    equal: Pairs,
    tuning: SemanticTuning = SEMANTIC_TUNING,
    dense: DenseFlowTuning = DENSE_FLOW_TUNING,
    device: torch.device = CPU,
) -> SemanticFlow:
    """The flow prior of these settings.

    `weights` are of the features, None for where weights are kept; pairs as in
    `SemanticFlow`. Features are computed, fitted and searched for on `device`.
    InputError for settings out of range.
    """
    check_semantic(config)
    steps = config.steps
    if steps is None:
        steps = 0 if config.features == "xfeat" else DINOV2_STEPS
    if config.refiner == "published":
        tuning = replace(tuning, adapt=with_published_network(tuning.adapt))
    source = feature_source(
        config.features, weights, config.layer, config.stride, tuning.features, device
    )
    return SemanticFlow(source, neighbors, equal, steps, config.seed, tuning, dense)


class SemanticFlow:
    """`FlowPrior` by features.

    The first call computes the features of the whole clip and fits them to it; later
    calls reuse them.
    """

    def __init__(
        self,
        source: FeatureSource,
        neighbors: Pairs = (),
        equal: Pairs = (),
        steps: int = 0,
        seed: int = 0,
        tuning: SemanticTuning = SEMANTIC_TUNING,
        dense: DenseFlowTuning = DENSE_FLOW_TUNING,
    ) -> None:
        """Features are fitted to `neighbors` and `equal`, and stay without `steps`.

        `neighbors` are pairs of consecutive frames, `equal` pairs of consecutive frames
        of equal exposure. Without neighbors the features stay as they are, too.
        """
        self.source = source
        self.neighbors = list(neighbors)
        self.equal = list(equal)
        self.steps = steps
        self.seed = seed
        self.tuning = tuning
        self.dense = dense
        self.features: Features | None = None

    def __call__(
        self, video: ArrayStack, clipped: ArrayStack, pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow (P, H, W, 2) px and valid (P, H, W) of `pairs` (P, 2).

        `video` (T, H, W, 3) is the whole clip.
        """
        if self.features is None:
            self.features = self.fit_features(video, clipped)
        return match_features(self.features, video, clipped, pairs, self.tuning, self.dense)

    def fit_features(self, video: ArrayStack, clipped: ArrayStack) -> Features:
        """The clip's features, fitted to it."""
        features = self.source(video)
        if self.steps == 0 or not self.neighbors:
            return features
        tracks = equal_exposure_tracks(
            features, video, clipped, self.equal, self.tuning, self.dense
        )
        search = self.tuning.search(features, video)
        clip = TrainingClip(features, video, tracks, self.neighbors, search, self.tuning.adapt)
        maps = adapt_features(clip, self.steps, self.seed)
        return Features(maps, features.stride, features.origin)


def match_features(
    features: Features,
    video: ArrayStack,
    clipped: ArrayStack,
    pairs: np.ndarray,
    tuning: SemanticTuning = SEMANTIC_TUNING,
    dense: DenseFlowTuning = DENSE_FLOW_TUNING,
    report: str | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) px and valid (P, H, W) of `pairs` (P, 2).

    Coarse flow by `features` is refined by dense inverse search.
    """
    ranges = recorded_ranges(video, clipped, pairs)

    def match(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        a, b = common_gray(video, ranges, i, j)
        forward, backward = coarse_flow(features, video, i, j, tuning)
        forward = dense_inverse_search(a, b, forward, dense)
        backward = dense_inverse_search(b, a, backward, dense)
        return forward, backward

    return match_pairs(match, clipped, pairs, report)


def coarse_flow(
    features: Features,
    video: ArrayStack,
    i: int,
    j: int,
    tuning: SemanticTuning = SEMANTIC_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px from frame `i` to `j`, and back, by features alone.

    Cells that fail the round trip are filled from others.
    """
    search = tuning.search(features, video)
    maps = features.maps
    with torch.no_grad():
        forward = feature_motion(maps[i], maps[j], search).cpu().numpy()
        backward = feature_motion(maps[j], maps[i], search).cpu().numpy()
        cell_rgb = cell_colors(video[[i, j]], features, 1).permute(0, 2, 3, 1).numpy()

    def to_pixels(
        motion: np.ndarray, reverse: np.ndarray, cell_rgb: np.ndarray, frame: np.ndarray
    ) -> np.ndarray:
        valid = round_trip(motion, reverse) < tuning.max_round_trip_cells
        filled = fill_cells(motion, valid, cell_rgb, tuning)
        upsampled = upsample_motion(filled, cell_rgb, frame, features, tuning)
        return upsampled * np.float32(features.stride)

    return (
        to_pixels(forward, backward, cell_rgb[0], video[i]),
        to_pixels(backward, forward, cell_rgb[1], video[j]),
    )


def fill_cells(
    motion: np.ndarray,
    valid: np.ndarray,
    rgb: np.ndarray,
    tuning: SemanticTuning = SEMANTIC_TUNING,
) -> np.ndarray:
    """Motion (h, w, 2) of cells, where not `valid` (h, w) filled from valid ones.

    Valid cells nearby of similar `rgb` (h, w, 3) count, and cells are filled round by
    round. If no cell is valid, the motion is unchanged.
    """
    h, w = valid.shape
    x = np.arange(w, dtype=np.float32)
    y = np.arange(h, dtype=np.float32)
    positions = np.stack(np.meshgrid(x, y), -1)
    radius = tuning.fill_radius_cells
    while valid.any() and not valid.all():
        mean, weight = joint_bilateral_mean(
            motion, valid, rgb, positions, rgb, radius, tuning.color_sigma
        )
        reached = ~valid & (weight > 0)
        motion = np.where(reached[..., None], mean, motion)
        valid = valid | reached
    return motion


def upsample_motion(
    motion: np.ndarray,
    cell_rgb: np.ndarray,
    rgb: np.ndarray,
    features: Features,
    tuning: SemanticTuning = SEMANTIC_TUNING,
) -> np.ndarray:
    """Motion (H, W, 2) of the pixels of `rgb` (H, W, 3), in cells.

    Each pixel averages the `motion` (h, w, 2) of the cells around it of similar color.
    """
    height, width = rgb.shape[:2]
    x = (np.arange(width, dtype=np.float32) + 0.5 - features.origin) / features.stride
    y = (np.arange(height, dtype=np.float32) + 0.5 - features.origin) / features.stride
    positions = np.stack(np.meshgrid(x, y), -1)
    everywhere = np.ones(motion.shape[:2], bool)
    mean, _ = joint_bilateral_mean(
        motion,
        everywhere,
        cell_rgb,
        positions,
        rgb,
        tuning.pixel_radius_cells,
        tuning.color_sigma,
    )
    return mean


def equal_exposure_tracks(
    features: Features,
    video: ArrayStack,
    clipped: ArrayStack,
    equal: Pairs,
    tuning: SemanticTuning = SEMANTIC_TUNING,
    dense: DenseFlowTuning = DENSE_FLOW_TUNING,
) -> list[Track]:
    """Points followed both ways between frames of equal exposure.

    They are followed over the pairs `equal`, and over two such pairs in a row.
    """
    pairs = [pair for i, j in equal for pair in ((i, j), (j, i))]
    if not pairs:
        return []
    flow, valid = match_features(
        features, video, clipped, np.array(pairs), tuning, dense, "points of equal exposure"
    )
    links = {pair: (f, v) for pair, f, v in zip(pairs, flow, valid, strict=True)}
    for i, j in pairs:
        for middle, k in pairs:
            if middle == j and k != i:
                links[i, k] = chain(*links[i, j], *links[j, k])

    tracks = []
    for frames, (link_flow, link_valid) in links.items():
        y, x = np.nonzero(link_valid)
        if len(x) < tuning.min_track_points:
            continue
        start = np.stack([x, y], -1) + 0.5 - features.origin
        end = start + link_flow[link_valid]
        tracks.append(
            Track(
                frames,
                torch.from_numpy(start / features.stride).float(),
                torch.from_numpy(end / features.stride).float(),
            )
        )
    return tracks


def chain(
    first: np.ndarray, first_valid: np.ndarray, second: np.ndarray, second_valid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Two flows (H, W, 2) px one after the other, and where both are valid (H, W)."""
    still_valid = follow(second_valid.astype(np.float32), first, fill=0.0) > 0.99
    return first + follow(second, first), first_valid & still_valid
