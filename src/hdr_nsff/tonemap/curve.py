"""Response curves as values at knots on [0, 1]: interpolation, inversion, the ends of
eq. 11.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from hdr_nsff.fields.splat.cuda_backends import kernels_on
from hdr_nsff.scene.batch import Sensor
from hdr_nsff.tonemap.kernel import Respond
from hdr_nsff.tonemap.photograph_cuda import photograph

NUM_KNOTS = 256
GAMMA = 2.2


def knot_positions(spacing: Literal["gamma", "even"], num: int = NUM_KNOTS) -> Tensor:
    """Knots (num,) on [0, 1], ends included: evenly in x^(1/2.2) or evenly in x."""
    u = torch.linspace(0, 1, num, dtype=torch.float64)
    return (u**GAMMA if spacing == "gamma" else u).float()


def piecewise_linear(x: Tensor, values: Tensor, knots: Tensor, power: float) -> Tensor:
    """g(x) (N, 3) by linear interpolation of `values` (3, K) at `knots` (K,), which lie
    evenly in x^power; x (N, 3) is clamped to [0, 1].

    Differentiable in x (zero outside [0, 1]) and in `values`. The bin comes in closed
    form. Where rounding puts x just outside its bin, the line is extended, which
    changes the result by rounding only.
    """
    inside = x.clamp(0, 1)
    last = len(knots) - 2
    place = inside.detach() if power == 1 else inside.detach().pow(power)
    bins = (place * (last + 1)).to(torch.int64).clamp_(0, last)  # (N, 3); NaN stays NaN
    share = (inside - knots[bins]) * (1 / (knots[1:] - knots[:-1]))[bins]
    columns = values.T
    left = columns.gather(0, bins)
    return left + (columns.gather(0, bins + 1) - left) * share


def leaky_ends(x: Tensor, y: Tensor, leak: float) -> Tensor:
    """Eq. 11 as printed: a leak where x leaves [0, 1], `y` = g(x) between.

    The leak is `leak * x` below 0 and `-leak / sqrt(x) + leak + 1` above 1; the result
    is continuous at both ends.
    """
    above = 1 + leak - leak * torch.rsqrt(x.clamp_min(1.0))
    return torch.where(x > 1, above, torch.where(x < 0, leak * x, y))


def record(
    radiance: Tensor,
    gain: Tensor,
    values: Tensor,
    knots: Tensor,
    bins: Tensor,
    power: float,
    leak: float | None,
) -> Tensor:
    """g(gain * radiance) (N, 3) for radiance (N, 3), gain (3,) and a curve (3, K).

    `leak` is that of eq. 11, None clamps. One fused kernel does it where there is one.
    """
    inputs = (radiance, gain, values)
    if all(t.device.type == "cpu" and t.dtype == torch.float32 for t in inputs):
        return Respond.apply(radiance, gain, values, knots, bins, leak)
    if radiance.dtype == torch.float32 and kernels_on(radiance.device):
        return photograph(radiance, Sensor.without_lens(gain, values, knots, leak))
    x = radiance * gain
    y = piecewise_linear(x, values, knots, power)
    return y if leak is None else leaky_ends(x, y, leak)


def invert(rgb: Tensor, values: Tensor, knots: Tensor) -> Tensor:
    """x (N, 3) at which a curve (3, K), made monotone, reaches `rgb` (N, 3)."""
    values = values.cummax(-1).values.contiguous()
    y = rgb.clamp(0, 1).T.contiguous()  # (3, N)
    right = torch.searchsorted(values, y).clamp(1, len(knots) - 1)
    y0, y1 = values.gather(1, right - 1), values.gather(1, right)
    share = (y - y0) / (y1 - y0).clamp_min(1e-12)
    return torch.lerp(knots[right - 1], knots[right], share).T


def resample(x: Tensor, y: Tensor, knots: Tensor) -> Tensor:
    """A curve y (3, M) over x (M,) in [0, 1], resampled onto the knots (3, K) and made
    monotone.
    """
    assert y.shape == (3, len(x)), (x.shape, y.shape)
    right = torch.searchsorted(x.contiguous(), knots.to(x)).clamp(1, len(x) - 1)
    share = ((knots.to(x) - x[right - 1]) / (x[right] - x[right - 1])).clamp(0, 1)
    return torch.lerp(y[:, right - 1], y[:, right], share).cummax(-1).values


def smoothness(curves: Tensor) -> Tensor:
    """Eq. 15: squared second differences of curves (..., K) over their knots.

    They are summed over points and averaged over curves. On even knots this is the
    paper's term divided by the number of images and channels. On gamma knots it is
    curvature over x^(1/2.2): zero for gamma 2.2, and the darks are held as firmly as
    the lights (evenly in x, the first of 255 cells would hide 20 knots).
    """
    return curves.diff(n=2, dim=-1).square().sum(-1).mean()
