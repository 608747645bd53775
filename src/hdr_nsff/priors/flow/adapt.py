"""Features fitted to one clip: a small residual network, trained for a minute on the
clip alone.

Four losses: points followed between frames of equal exposure, where ordinary flow is
valid; matches across exposures that return to their start; best buddies (each other's
nearest neighbor) that stay ahead of all other cells; and closeness to the original
features. The losses follow DINO-Tracker (Tumanyan et al., ECCV 2024), which the paper
trains on flow across exposures: the very flow that this is to replace, so points of
equal exposure take its place.

Positions and motions are in cells, as in `correlation`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hdr_nsff.core.progress import say, track
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.priors.flow.correlation import (
    EXCLUDED,
    Search,
    cell_positions,
    cosines,
    locate,
    sample_features,
)
from hdr_nsff.priors.flow.features import Features, join_maps

Refiner = Literal["small", "published"]


@dataclass(frozen=True)
class AdaptTuning:
    """Tuning constants of the fit to a clip, hand-chosen on rendered scenes."""

    refiner: Refiner = "small"
    """The network that is fitted: see `ResidualNetwork` and `PublishedNetwork`."""
    colors_per_cell: int = 4
    """The network sees this many by this many colors of each cell."""
    hidden_channels: int = 32
    """Channels of the network's hidden layers."""
    points_per_step: int = 128
    """Points per loss and step."""
    learning_rate: float = 1e-3
    """Of Adam at the first step; it falls linearly to zero."""
    max_error_cells: float = 2.0
    """Points that miss by more are taken as lost and have no gradient."""
    huber_cells: float = 0.5
    """Errors below this count as squares, above it by their size."""
    trajectory_weight: float = 3.0
    """Weight of points followed between frames of equal exposure."""
    cycle_weight: float = 1.0
    """Weight of round trips across exposures."""
    buddies_weight: float = 0.05
    """Weight of best buddies."""
    closeness_weight: float = 0.3
    """Weight of closeness to the original features."""

    def weights(self) -> dict[str, float]:
        """The weights of the losses, by name."""
        return {
            "trajectory": self.trajectory_weight,
            "cycle": self.cycle_weight,
            "buddies": self.buddies_weight,
            "closeness": self.closeness_weight,
        }


ADAPT_TUNING = AdaptTuning()
PUBLISHED_CHANNELS = (3, 64, 128, 256)  # before those of the features
PUBLISHED_KERNEL = 5


def with_published_network(tuning: AdaptTuning) -> AdaptTuning:
    """The tuning with DINO-Tracker's network and rate. Its three halvings lead from
    8 x 8 colors to a cell.
    """
    return replace(tuning, refiner="published", colors_per_cell=8, learning_rate=0.01)


class Track(NamedTuple):
    """Points followed from one frame to another of equal exposure, in cells."""

    frames: tuple[int, int]
    start: Tensor  # (N, 2)
    end: Tensor  # (N, 2)


class ResidualNetwork(nn.Module):
    """Features plus a correction that starts at zero.

    The correction is predicted from the features and from colors on a finer grid.
    """

    def __init__(
        self, channels: int, feature_norm: float, tuning: AdaptTuning = ADAPT_TUNING
    ) -> None:
        """For features of `channels` whose mean length is `feature_norm`."""
        super().__init__()
        self.feature_norm = feature_norm
        hidden = tuning.hidden_channels
        inputs = channels + 3 * tuning.colors_per_cell**2
        self.inner = nn.Conv2d(inputs, hidden, 3, padding=1, padding_mode="replicate")
        self.middle = nn.Conv2d(hidden, hidden, 3, padding=1, padding_mode="replicate")
        self.outer = nn.Conv2d(hidden, channels, 1)
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.outer.bias)  # type: ignore[arg-type]

    def forward(self, maps: Tensor, colors: Tensor) -> Tensor:
        """Corrected features (B, C, h, w) from `maps` (B, C, h, w) and `colors`.

        `colors` are those of `cell_colors`, (B, 3 * colors_per_cell^2, h, w).
        """
        inputs = torch.cat([maps / self.feature_norm, colors - 0.5], 1)
        x = functional.gelu(self.inner(inputs))
        x = functional.gelu(self.middle(x))
        return maps + self.feature_norm * self.outer(x)


class PublishedNetwork(nn.Module):
    """DINO-Tracker's correction (Tumanyan et al. 2024): four convolutions of the
    colors alone, halved by blur-pooling (Zhang 2019) after each but the last, which
    starts at zero. With 1024 features it has 7.6 million weights.
    """

    blur: Tensor

    def __init__(self, channels: int, feature_norm: float, tuning: AdaptTuning) -> None:
        """For features of `channels` whose mean length is `feature_norm`."""
        super().__init__()
        self.feature_norm = feature_norm
        self.colors_per_cell = tuning.colors_per_cell
        sizes = (*PUBLISHED_CHANNELS, channels)
        self.layers = nn.ModuleList(
            nn.Conv2d(a, b, PUBLISHED_KERNEL, padding="same", padding_mode="replicate")
            for a, b in pairwise(sizes)
        )
        for parameter in self.layers[-1].parameters():
            nn.init.zeros_(parameter)
        binomial = torch.tensor([1.0, 3.0, 3.0, 1.0]) / 8
        self.register_buffer("blur", torch.outer(binomial, binomial)[None, None])

    def forward(self, maps: Tensor, colors: Tensor) -> Tensor:
        """As `ResidualNetwork`, for colors of 8 x 8 to a cell."""
        x = functional.pixel_shuffle(colors - 0.5, self.colors_per_cell)
        for layer in list(self.layers)[:-1]:
            x = self.halve(functional.relu(layer(x)))
        return maps + self.feature_norm * self.layers[-1](x)

    def halve(self, x: Tensor) -> Tensor:
        """Maps (B, C, 2h, 2w) blurred and subsampled to (B, C, h, w)."""
        channels = x.shape[1]
        padded = functional.pad(x, (1, 1, 1, 1), mode="replicate")
        kernel = self.blur.expand(channels, -1, -1, -1)
        return functional.conv2d(padded, kernel, stride=2, groups=channels)


def build_refiner(channels: int, feature_norm: float, tuning: AdaptTuning) -> RefinerNetwork:
    """The network of the settings, which starts as the identity."""
    if tuning.refiner == "published":
        return PublishedNetwork(channels, feature_norm, tuning)
    return ResidualNetwork(channels, feature_norm, tuning)


def cell_colors(video: ArrayStack, features: Features, per_side: int) -> Tensor:
    """Colors (T, 3 * per_side^2, h, w) of the cells of `features`.

    They are read from `video` (T, H, W, 3) on a grid of `per_side` x `per_side` samples
    in each cell.
    """
    h, w = features.maps.shape[-2:]
    step = features.stride / per_side
    first = features.origin - 0.5 - (per_side - 1) / 2 * step  # as a pixel index
    x = (first + step * np.arange(w * per_side)).astype(np.float32)
    y = (first + step * np.arange(h * per_side)).astype(np.float32)
    x, y = np.meshgrid(x, y)
    sampled = []
    for frame in video:
        blurred = cv2.GaussianBlur(frame, (0, 0), max(step / 2, 0.3))
        sampled.append(cv2.remap(blurred, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    colors = torch.from_numpy(np.stack(sampled)).permute(0, 3, 1, 2)
    return functional.pixel_unshuffle(colors, per_side)


def trajectory_loss(found: Tensor, end: Tensor, tuning: AdaptTuning = ADAPT_TUNING) -> Tensor:
    """Huber loss (N,) of the distance from points `found` (N, 2) to `end` (N, 2).

    It is zero, without gradient, for points that are lost.
    """
    loss = functional.huber_loss(found, end, reduction="none", delta=tuning.huber_cells).sum(-1)
    return loss * ((found - end).detach().norm(dim=-1) < tuning.max_error_cells)


def cycle_loss(start: Tensor, back: Tensor, tuning: AdaptTuning = ADAPT_TUNING) -> Tensor:
    """Huber loss (N,) of the distance from `back` (N, 2) to `start` (N, 2).

    `back` is where a round trip brings the points; the loss of lost points is zero.
    """
    return trajectory_loss(back, start, tuning)


def best_buddies(a: Tensor, b: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Cells (N,), (N,) of `a` and `b` (C, h, w) that are mutual nearest neighbors.

    Nearest in feature, within `reach` cells.
    """
    positions = cell_positions(*a.shape[-2:]).to(a)
    beyond = ((positions[None] - positions[:, None]).abs() > reach).any(-1)
    similarity = cosines(a.flatten(1).T, b).masked_fill(beyond, EXCLUDED)
    nearest_in_b = similarity.argmax(1)
    nearest_in_a = similarity.argmax(0)
    cells = torch.arange(len(positions), device=a.device)
    mutual = (nearest_in_a[nearest_in_b] == cells).nonzero()[:, 0]
    return mutual, nearest_in_b[mutual]


def buddies_loss(queries: Tensor, target: Tensor, buddy: Tensor, temperature: float) -> Tensor:
    """Cross-entropy (N,) of finding each of `queries` (N, C) at its `buddy` (N,).

    It competes with the other cells of `target` (C, h, w), except those next to the
    buddy: driving them away would round motion to whole cells.
    """
    positions = cell_positions(*target.shape[-2:]).to(target)
    distance = (positions - positions[buddy][:, None]).abs().amax(-1)  # (N, cells)
    adjacent = (distance > 0) & (distance < 2)
    logits = (cosines(queries, target) / temperature).masked_fill(adjacent, -torch.inf)
    return functional.cross_entropy(logits, buddy, reduction="none")


def closeness_loss(refined: Tensor, original: Tensor) -> Tensor:
    """Distance (B, h, w) of features (B, C, h, w) from the original ones.

    One minus the cosine, plus the squared relative change of length.
    """
    angle = 1 - functional.cosine_similarity(refined, original, dim=1)
    length_ratio = refined.norm(dim=1) / original.norm(dim=1).clamp_min(1e-6)
    return angle + (length_ratio - 1) ** 2


RefinerNetwork = ResidualNetwork | PublishedNetwork


class TrainingClip:
    """Training data of one clip: features, colors, tracks and best buddies."""

    def __init__(
        self,
        features: Features,
        video: ArrayStack,
        tracks: list[Track],
        neighbors: list[tuple[int, int]],
        search: Search,
        tuning: AdaptTuning = ADAPT_TUNING,
    ) -> None:
        """`video` (T, H, W, 3) is exposure-equalized.

        `neighbors` are pairs of consecutive frames of any exposures; frames in no pair
        are not learned from.
        """
        self.maps = features.maps
        self.device = features.maps.device
        self.colors = cell_colors(video, features, tuning.colors_per_cell).to(self.device)
        self.tracks = [
            Track(t.frames, t.start.to(self.device), t.end.to(self.device)) for t in tracks
        ]
        self.neighbors = neighbors
        self.search = search
        self.tuning = tuning
        frames = sorted({t for pair in neighbors for t in pair})
        self.feature_norm = float(features.maps[frames].norm(dim=1).mean())
        self.buddies = {
            (i, j): best_buddies(self.maps[i], self.maps[j], search.reach) for i, j in neighbors
        }

    def losses(self, network: RefinerNetwork, rng: np.random.Generator) -> dict[str, Tensor]:
        """The mean losses of one step, over one pair of neighbors and one track."""
        i, j = self.neighbors[rng.integers(len(self.neighbors))]
        original = self.maps[[i, j]]
        refined = self.refine(network, [i, j])
        losses = {
            "cycle": self.cycle(refined, rng),
            "buddies": self.contrast(refined, *self.buddies[i, j], rng),
            "closeness": closeness_loss(refined, original),
        }
        if self.tracks:
            track = self.tracks[rng.integers(len(self.tracks))]
            losses["trajectory"] = self.trajectory(network, track, rng)
        return {name: loss.mean() for name, loss in losses.items()}

    def cycle(self, refined: Tensor, rng: np.random.Generator) -> Tensor:
        """The cycle loss (N,) of random points between two frames (2, C, h, w)."""
        h, w = refined.shape[-2:]
        # between cells, so that snapping to cells costs
        drawn = rng.random((self.tuning.points_per_step, 2)) * [w - 1, h - 1]
        start = torch.from_numpy(drawn).float().to(self.device)
        there = locate(sample_features(refined[0], start), start, refined[1], self.search)
        back = locate(sample_features(refined[1], there), there, refined[0], self.search)
        return cycle_loss(start, back, self.tuning)

    def contrast(
        self, refined: Tensor, cells: Tensor, buddies: Tensor, rng: np.random.Generator
    ) -> Tensor:
        """The loss (N,) of some `cells` (B,) of one frame at their `buddies` (B,).

        `refined` (2, C, h, w) are the features of both frames.
        """
        chosen = self.draw(len(cells), rng)
        queries = refined[0].flatten(1).T[cells[chosen]]
        return buddies_loss(queries, refined[1], buddies[chosen], self.search.temperature)

    def trajectory(self, network: RefinerNetwork, track: Track, rng: np.random.Generator) -> Tensor:
        """The trajectory loss (N,) of some points of a track.

        Each is searched within reach of its true end.
        """
        a, b = self.refine(network, list(track.frames))
        chosen = self.draw(len(track.start), rng)
        end = track.end[chosen]
        found = locate(sample_features(a, track.start[chosen]), end, b, self.search)
        return trajectory_loss(found, end, self.tuning)

    def draw(self, count: int, rng: np.random.Generator) -> Tensor:
        """Random numbers below `count`, one for each point of a step."""
        drawn = rng.integers(count, size=self.tuning.points_per_step)
        return torch.from_numpy(drawn).to(self.device)

    def refine(self, network: RefinerNetwork, frames: list[int]) -> Tensor:
        """The corrected features of some frames."""
        return network(self.maps[frames], self.colors[frames])


def adapt_features(clip: TrainingClip, steps: int, seed: int) -> Tensor:
    """The features (T, C, h, w) of a clip after `steps` of Adam from `seed`.

    The original features get no gradient. The number of steps per second is reported.
    """
    tuning = clip.tuning
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = build_refiner(clip.maps.shape[1], clip.feature_norm, tuning)
    network.to(clip.device)
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(network.parameters(), tuning.learning_rate)
    weights = tuning.weights()
    begin = time.monotonic()
    for step in track(range(steps), "features of this clip"):
        for group in optimizer.param_groups:
            group["lr"] = tuning.learning_rate * (1 - step / steps)
        losses = clip.losses(network, rng)
        total = torch.stack([weights[name] * loss for name, loss in losses.items()]).sum()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    steps_per_second = steps / (time.monotonic() - begin)
    say(f"features of this clip: {steps} steps, {steps_per_second:.1f} per second")
    with torch.no_grad():
        count = len(clip.maps)
        return join_maps((clip.refine(network, [t]) for t in range(count)), count)
