"""Volume rendering by quadrature (Max 1995; NeRF, Mildenhall et al. 2020, eq. 3):
samples along a ray, weights from density, compositing.

Shapes are (N rays, S samples). Densities are per unit of the step lengths `deltas`,
and both are >= 0. Two contents, static and dynamic, share a ray: `blend` is eq. 6-7 of
HDR-NSFF, `superpose` is NeRF-W, `add` is ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

OPAQUE_STEP = 1e10  # length of the last interval of a ray (NeRF, NSFF)


def stratified_disparity(
    num_rays: int, num_samples: int, near: float, far: float, jitter: Tensor | None
) -> Tensor:
    """z-depths (N, S) evenly spaced in disparity 1 / z, from `near` to `far`.

    `jitter` (N, S) in [0, 1) places each sample within its bin; None: at its center.
    """
    offset = 0.5 if jitter is None else jitter
    device = None if jitter is None else jitter.device
    bins = torch.arange(num_samples, device=device).expand(num_rays, num_samples) + offset
    fraction = bins / num_samples
    return 1.0 / (1 / near + fraction * (1 / far - 1 / near))


def step_lengths(points: Tensor, opaque_end: bool = False) -> Tensor:
    """Distances (N, S) from each sample of `points` (N, S, 3) to the next.

    The last one repeats the one before; with `opaque_end` it is 1e10, as published, so
    that any density in the last sample stops all light.
    """
    steps = (points[:, 1:] - points[:, :-1]).norm(dim=-1)
    last = torch.full_like(steps[:, -1:], OPAQUE_STEP) if opaque_end else steps[:, -1:]
    return torch.cat([steps, last], -1)


def alpha_from_density(density: Tensor, deltas: Tensor) -> Tensor:
    """Share of light (N, S) that a sample stops: `1 - exp(-density * delta)`."""
    return -torch.expm1(-density * deltas)


def transmittance(alpha: Tensor) -> Tensor:
    """Share of light (N, S) that reaches each sample, of `alpha` (N, S).

    It is the exclusive cumulative product of `1 - alpha`.
    """
    through = torch.cumprod(1 - alpha, -1)
    return torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], -1)


@dataclass(frozen=True)
class Weights:
    """What each sample adds to its ray's pixel, for static and for dynamic content."""

    static: Tensor  # (N, S)
    dynamic: Tensor  # (N, S)

    @property
    def opacity(self) -> Tensor:
        """Of each ray (N,), in [0, 1].

        The clamp is for `blend` and `superpose`, in which two contents in one place may
        add up to more than 1.
        """
        return (self.static + self.dynamic).sum(-1).clamp(max=1)


def blend(
    static_density: Tensor, dynamic_density: Tensor, share: Tensor, deltas: Tensor
) -> Weights:
    """HDR-NSFF's eq. 6-7: `share` (N, S) in [0, 1] of a sample is dynamic.

    `a_dy = (1 - exp(-s_t d)) b`, `a_st = (1 - exp(-s d)) (1 - b)`, and `T` is the
    product of `(1 - a_dy) (1 - a_st)` over the samples before.
    """
    alpha_dynamic = alpha_from_density(dynamic_density, deltas) * share
    alpha_static = alpha_from_density(static_density, deltas) * (1 - share)
    through = transmittance(1 - (1 - alpha_dynamic) * (1 - alpha_static))
    return Weights(through * alpha_static, through * alpha_dynamic)


def add(static_density: Tensor, dynamic_density: Tensor, deltas: Tensor) -> Weights:
    """Two media in one place: densities add up, and share the sample's weight.

    Each content has its density's share. Unlike eq. 7, neither content can blank the
    other: +0.5 dB in early experiments on rendered scenes.
    """
    total = static_density + dynamic_density
    weights = single(total, deltas)
    dynamic = weights * (dynamic_density / total.clamp_min(1e-12))
    return Weights(weights - dynamic, dynamic)


def superpose(static_density: Tensor, dynamic_density: Tensor, deltas: Tensor) -> Weights:
    """NeRF in the Wild (Martin-Brualla et al. 2021, eq. 4-5): each content has its own
    alpha, and both densities together attenuate what lies behind.

    The two alphas of a sample may add up to more than 1.
    """
    through = transmittance(alpha_from_density(static_density + dynamic_density, deltas))
    return Weights(
        through * alpha_from_density(static_density, deltas),
        through * alpha_from_density(dynamic_density, deltas),
    )


def single(density: Tensor, deltas: Tensor) -> Tensor:
    """Weights (N, S) of one content alone."""
    stopped = alpha_from_density(density, deltas)
    return transmittance(stopped) * stopped


def expected_depth(weights: Tensor, depths: Tensor, far: float) -> Tensor:
    """z-depth (N,) from the mean disparity over a ray.

    Light that no sample stops comes from `far`.
    """
    disparity = (weights / depths).sum(-1)
    passed = (1 - weights.sum(-1)).clamp_min(0)
    return 1.0 / (disparity + passed / far)


def weighted_sum(weights: Tensor, values: Tensor) -> Tensor:
    """Sum over samples of `weights` (N, S) times `values` (N, S, C): (N, C)."""
    return torch.einsum("ns,nsc->nc", weights, values)


def composite(weights: Weights, static: Tensor, dynamic: Tensor) -> Tensor:
    """Both contents' values (N, S, C), in their weights: (N, C)."""
    return weighted_sum(weights.static, static) + weighted_sum(weights.dynamic, dynamic)
