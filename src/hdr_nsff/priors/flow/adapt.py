"""Features fitted to one clip: a small residual network, trained for a minute on
nothing but the clip.

What it learns from: points followed between frames of equal exposure, where ordinary
flow can be believed; that a match across exposures leads back to where it came from;
that best buddies (each other's nearest) stay ahead of all others; and that features
stay near what they were. The paper's tracker learns from flow across exposures instead,
which is what it is to replace.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hdr_nsff.core.progress import say, track
from hdr_nsff.priors.flow.correlation import cells, costs, locate, sample
from hdr_nsff.priors.flow.features import Features

DETAIL = 4  # by how many colors across a cell is shown to the network
HIDDEN = 32
POINTS = 128  # per term and step
RATE = 1e-3
DOUBTFUL = 2.0  # cells: round trips that miss by more teach nothing
HUBER = 0.5  # cells: errors count as squares below


@dataclass(frozen=True)
class Matching:
    """How a feature is looked for."""

    reach: float  # cells, in x and in y
    radius: float = 1.0  # cells around the best one that its position is the mean of
    temperature: float = 0.05  # of the softmax of cosines


@dataclass(frozen=True)
class AdaptWeights:
    """What each term counts."""

    trajectory: float = 3.0
    cycle: float = 1.0
    buddies: float = 0.05
    near: float = 0.3


class Track(NamedTuple):
    """Points followed from one frame to another of equal exposure, in cells."""

    frames: tuple[int, int]
    start: Tensor  # (N, 2)
    end: Tensor  # (N, 2)


class Residual(nn.Module):
    """Features plus a correction that starts at zero, seen from the features and from
    colors finer than them.
    """

    def __init__(self, channels: int, size: float) -> None:
        """`channels` C of the features, `size` their mean length, which is the unit of
        the correction.
        """
        super().__init__()
        self.size = size
        self.inner = nn.Conv2d(
            channels + 3 * DETAIL**2, HIDDEN, 3, padding=1, padding_mode="replicate"
        )
        self.middle = nn.Conv2d(HIDDEN, HIDDEN, 3, padding=1, padding_mode="replicate")
        self.outer = nn.Conv2d(HIDDEN, channels, 1)
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.outer.bias)  # type: ignore[arg-type]

    def forward(self, maps: Tensor, detail: Tensor) -> Tensor:
        """Corrected features (B, C, h, w) from `maps` (B, C, h, w) and `detail` (B, 3 *
        DETAIL^2, h, w).
        """
        x = functional.gelu(self.inner(torch.cat([maps / self.size, detail - 0.5], 1)))
        return maps + self.size * self.outer(functional.gelu(self.middle(x)))


def colors(video: np.ndarray, features: Features, across: int) -> Tensor:
    """What `video` (T, H, W, 3) shows in each cell, in `across` x `across` samples: (T,
    3 * across^2, h, w).
    """
    h, w = features.maps.shape[-2:]
    step = features.stride / across
    first = features.origin - 0.5 - (across - 1) / 2 * step  # as a pixel index
    x, y = ((first + step * np.arange(n * across)).astype(np.float32) for n in (w, h))
    smooth = [cv2.GaussianBlur(frame, (0, 0), max(step / 2, 0.3)) for frame in video]
    x, y = np.broadcast_to(x, (len(y), len(x))), np.broadcast_to(y[:, None], (len(y), len(x)))
    seen = np.stack(
        [
            cv2.remap(frame, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for frame in smooth
        ]
    )
    return functional.pixel_unshuffle(torch.from_numpy(seen).permute(0, 3, 1, 2), across)


def trajectory_term(found: Tensor, end: Tensor) -> Tensor:
    """How far each point was `found` (N, 2) from its `end` (N, 2), cells: (N,), without
    gradient where it is another place altogether.
    """
    error = functional.huber_loss(found, end, reduction="none", delta=HUBER).sum(-1)
    return error * ((found - end).detach().norm(dim=-1) < DOUBTFUL)


def cycle_term(start: Tensor, back: Tensor) -> Tensor:
    """How far each point lands from its `start` (N, 2) when it comes `back` (N, 2):
    (N,), 0 where it plainly lost its way.
    """
    return trajectory_term(back, start)


def best_buddies(a: Tensor, b: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Cells (N,), (N,) of `a` and `b` (C, h, w) that are each other's nearest in
    feature, within `reach` cells.
    """
    place = cells(*a.shape[-2:]).to(a)
    cost = costs(a.flatten(1).T, b)
    cost = cost.masked_fill(((place[None] - place[:, None]).abs() > reach).any(-1), -9.0)
    there, back = cost.argmax(1), cost.argmax(0)
    mutual = (back[there] == torch.arange(len(there), device=a.device)).nonzero()[:, 0]
    return mutual, there[mutual]


def buddies_term(queries: Tensor, target: Tensor, buddy: Tensor, temperature: float) -> Tensor:
    """Cross-entropy (N,) of finding each of `queries` (N, C) at its `buddy` (N,) among
    the cells of `target` (C, h, w).

    The cells around a buddy do not compete with it: driving them off would round motion
    to whole cells.
    """
    place = cells(*target.shape[-2:]).to(target)
    gap = (place - place[buddy][:, None]).abs().amax(-1)  # (N, cells)
    cost = (costs(queries, target) / temperature).masked_fill((gap > 0) & (gap < 2), -torch.inf)
    return functional.cross_entropy(cost, buddy, reduction="none")


def near_term(refined: Tensor, original: Tensor) -> Tensor:
    """How far features (B, C, h, w) went from where they were, in angle and in length:
    (B, h, w).
    """
    angle = 1 - functional.cosine_similarity(refined, original, dim=1)
    return angle + (refined.norm(dim=1) / original.norm(dim=1).clamp_min(1e-6) - 1) ** 2


class Lesson:
    """A clip to learn from: its features and colors, tracks, and the pairs of
    neighbors.
    """

    def __init__(
        self,
        features: Features,
        video: np.ndarray,
        tracks: list[Track],
        neighbors: list[tuple[int, int]],
        matching: Matching,
    ) -> None:
        """`video` (T, H, W, 3) exposure-equalized; `neighbors`: pairs of frames one
        after the other, whatever their exposures.
        """
        self.maps, self.detail = features.maps, colors(video, features, DETAIL)
        self.tracks, self.neighbors, self.matching = tracks, neighbors, matching
        frames = sorted(
            {t for pair in neighbors for t in pair}
        )  # to learn from; the others may be held out
        self.size = float(features.maps[frames].norm(dim=1).mean())
        self.buddies = {
            (i, j): best_buddies(self.maps[i], self.maps[j], matching.reach) for i, j in neighbors
        }

    def terms(self, network: Residual, rng: np.random.Generator) -> dict[str, Tensor]:
        """The terms of one step, each a mean, over one pair of neighbors and one track."""
        i, j = self.neighbors[rng.integers(len(self.neighbors))]
        refined, original = self.refine(network, [i, j]), self.maps[[i, j]]
        m = self.matching
        h, w = self.maps.shape[-2:]
        start = torch.from_numpy(
            rng.random((POINTS, 2)) * [w - 1, h - 1]
        ).float()  # between cells, so that snapping to them costs
        there = locate(
            sample(refined[0], start), start, refined[1], m.reach, m.radius, m.temperature
        )
        back = locate(
            sample(refined[1], there), there, refined[0], m.reach, m.radius, m.temperature
        )
        from_, to = self.buddies[i, j]
        some = torch.from_numpy(rng.integers(len(from_), size=POINTS))
        contrast = buddies_term(
            refined[0].flatten(1).T[from_[some]], refined[1], to[some], m.temperature
        )
        terms = {
            "cycle": cycle_term(start, back),
            "buddies": contrast,
            "near": near_term(refined, original),
        }
        if self.tracks:
            terms["trajectory"] = self.followed(
                network, self.tracks[rng.integers(len(self.tracks))], rng
            )
        return {name: term.mean() for name, term in terms.items()}

    def followed(self, network: Residual, track: Track, rng: np.random.Generator) -> Tensor:
        """The trajectory term (N,) of some points of a track: among the cells within
        reach of where they end.
        """
        a, b = self.refine(network, list(track.frames))
        some = torch.from_numpy(rng.integers(len(track.start), size=POINTS))
        m, end = self.matching, track.end[some]
        return trajectory_term(
            locate(sample(a, track.start[some]), end, b, m.reach, m.radius, m.temperature), end
        )

    def refine(self, network: Residual, frames: list[int]) -> Tensor:
        """The corrected features of some frames."""
        return network(self.maps[frames], self.detail[frames])


def adapt(lesson: Lesson, steps: int, seed: int, weights: AdaptWeights) -> Tensor:
    """Train on a clip: its features (T, C, h, w) as they are then.

    `steps` of Adam from `seed`; the original features get no gradient. Says how many
    steps a second were done.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Residual(lesson.maps.shape[1], lesson.size)
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(network.parameters(), RATE)
    begun = time.monotonic()
    for step in track(range(steps), "features of this clip"):
        for group in optimizer.param_groups:
            group["lr"] = RATE * (1 - step / steps)
        terms = lesson.terms(network, rng)
        loss = torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    say(f"features of this clip: {steps} steps, {steps / (time.monotonic() - begun):.1f} a second")
    with torch.no_grad():
        return torch.cat([lesson.refine(network, [t]) for t in range(len(lesson.maps))])
