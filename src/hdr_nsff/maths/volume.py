"""Volume rendering: distances along a ray, weights from density, compositing. Shapes
are (N rays, S samples).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


def stratified_disparity(
    num_rays: int, num_samples: int, near: float, far: float, jitter: Tensor | None
) -> Tensor:
    """z-depths (N, S), evenly spaced in 1 / z from near to far; `jitter` (N, S) in [0,
    1) moves each within its bin (None: centers).
    """
    bins = torch.arange(num_samples).expand(num_rays, num_samples) + (
        0.5 if jitter is None else jitter
    )
    fraction = bins / num_samples
    return 1.0 / (1 / near + fraction * (1 / far - 1 / near))


def step_lengths(points: Tensor) -> Tensor:
    """Distances (N, S) between consecutive samples `points` (N, S, 3); the last one
    repeats.
    """
    steps = (points[:, 1:] - points[:, :-1]).norm(dim=-1)
    return torch.cat([steps, steps[:, -1:]], -1)


def transmittance(alpha: Tensor) -> Tensor:
    """Share of light that reaches each sample: exclusive cumulative product of 1 -
    alpha, (N, S).
    """
    through = torch.cumprod(1 - alpha, -1)
    return torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], -1)


@dataclass(frozen=True)
class Weights:
    """What each sample adds to its ray's pixel, for the static and the dynamic content."""

    static: Tensor  # (N, S)
    dynamic: Tensor  # (N, S)

    @property
    def opacity(self) -> Tensor:
        """Of each ray (N,), in [0, 1]: eq. 6-7 let two contents in one place add up to
        more than everything.
        """
        return (self.static + self.dynamic).sum(-1).clamp(max=1)


def blend(
    static_density: Tensor, dynamic_density: Tensor, share: Tensor, deltas: Tensor
) -> Weights:
    """Eq. 6-7: both densities in the same place, `share` (N, S) of the dynamic one.
    `a_dy = (1-exp(-s_t d)) b`, `a_st = (1-exp(-s d)) (1-b)`, `T =
    cumprod((1-a_dy)(1-a_st))`.
    """
    a_dy = -torch.expm1(-dynamic_density * deltas) * share
    a_st = -torch.expm1(-static_density * deltas) * (1 - share)
    t = transmittance(1 - (1 - a_dy) * (1 - a_st))
    return Weights(t * a_st, t * a_dy)


def add(static_density: Tensor, dynamic_density: Tensor, deltas: Tensor) -> Weights:
    """Densities that add up (`density = static + dynamic`, better than eq. 7 by half a
    decibel in PROTOTYPES).
    """
    total = static_density + dynamic_density
    alpha = -torch.expm1(-total * deltas)
    w = transmittance(alpha) * alpha
    dynamic = w * (dynamic_density / total.clamp_min(1e-12))
    return Weights(w - dynamic, dynamic)


def single(density: Tensor, deltas: Tensor) -> Tensor:
    """Weights (N, S) of one content alone."""
    alpha = -torch.expm1(-density * deltas)
    return transmittance(alpha) * alpha


def expected_depth(weights: Tensor, depths: Tensor, far: float) -> Tensor:
    """z-depth (N,) from the mean disparity: what no sample stops counts as `far`."""
    disparity = (weights / depths).sum(-1) + (1 - weights.sum(-1)).clamp_min(0) / far
    return 1.0 / disparity


def weighted_sum(weights: Tensor, values: Tensor) -> Tensor:
    """Sum over samples of `weights` (N, S) times `values` (N, S, C): (N, C)."""
    return torch.einsum("ns,nsc->nc", weights, values)
