"""Gaussians at rest: what each is made of, as learned numbers.

Colors are kept as a log radiance, unbounded; or, of a bounded field, as the logarithm
of the odds `E / (1 - E)` of a radiance E below 1, whose sigmoid E is. Offsets in time
and by direction of view add to either.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hdr_nsff.fields.base import HIGHEST
from hdr_nsff.fields.knots import interpolate_linear

BRIGHTEST = 16.0  # log radiance beyond this is held: exp stays finite


def to_radiance(stored: Tensor, bounded: bool) -> Tensor:
    """Linear HDR radiance >= 0 of the numbers that Gaussians keep; `bounded`: below 1."""
    return stored.sigmoid() if bounded else stored.clamp_max(BRIGHTEST).exp()


def from_log_radiance(log: Tensor, bounded: bool) -> Tensor:
    """The numbers of which `to_radiance` makes the exponential of `log`, as near as it
    can.
    """
    if not bounded:
        return log
    log = log.clamp_max(math.log(HIGHEST))
    return log - torch.log1p(-log.exp())


def brightened(radiance: Tensor, log_factor: Tensor, bounded: bool) -> Tensor:
    """`to_radiance` of the stored numbers plus `log_factor`, for those that give
    `radiance`.
    """
    factor = log_factor.exp()
    return radiance * factor / (1 - radiance + radiance * factor) if bounded else radiance * factor


class Gaussians(nn.Module):
    """`count` Gaussians at rest, with `knots` log-radiance offsets in time of
    `channels` (3: colors, 1: brightness).
    """

    def __init__(
        self, count: int, knots: int, channels: int, shiny: bool = False, bounded: bool = False
    ) -> None:
        super().__init__()
        self.bounded = bounded
        self.means = nn.Parameter(torch.zeros(count, 3))  # scene units
        self.quaternions = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(count, 1))  # w x y z
        self.log_scales = nn.Parameter(
            torch.full((count, 3), -5.0)
        )  # log of standard deviations in scene units
        self.logits = nn.Parameter(torch.full((count,), -10.0))  # of opacity
        self.log_radiance = nn.Parameter(torch.zeros(count, 3))  # or log odds
        self.offsets = nn.Parameter(
            torch.zeros(knots, count, channels)
        )  # of log radiance, over the clip's time
        self.sh1 = nn.Parameter(
            torch.zeros(count if shiny else 0, 3, 3)
        )  # change of log radiance by direction of view (xyz)

    def __len__(self) -> int:
        return len(self.means)

    def radiance(self, share: float) -> Tensor:
        """Radiance (G, 3) at a share in [0, 1] of the clip's time."""
        log = self.log_radiance + interpolate_linear(self.offsets, share * (len(self.offsets) - 1))
        return to_radiance(log, self.bounded)
