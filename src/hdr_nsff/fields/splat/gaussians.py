"""Gaussians at rest: what each is made of, as learned numbers.

Colors are stored as a log radiance, unbounded; or, in a bounded field, as the log odds
`log(E / (1 - E))` of a radiance E below 1, of which E is the sigmoid. Offsets in time
and by direction of view are added to either.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hdr_nsff.fields.knots import interpolate_linear
from hdr_nsff.fields.point_cloud import MAX_SIGMOID_RADIANCE

MAX_LOG_RADIANCE = 16.0  # of a Gaussian: keeps its exponential and sums of it finite
# an untrained Gaussian is tiny and invisible
START_LOG_SCALE, START_LOGIT = -5.0, -10.0


def to_radiance(stored: Tensor, bounded: bool) -> Tensor:
    """Linear HDR radiance of stored numbers, >= 0; below 1 if `bounded`."""
    if bounded:
        return stored.sigmoid()
    return stored.clamp_max(MAX_LOG_RADIANCE).exp()


def from_log_radiance(log: Tensor, bounded: bool) -> Tensor:
    """Stored numbers of which `to_radiance` makes the exponential of `log`, clamped."""
    if not bounded:
        return log
    log = log.clamp_max(math.log(MAX_SIGMOID_RADIANCE))
    return log - torch.log1p(-log.exp())


def scale_radiance(radiance: Tensor, log_factor: Tensor, bounded: bool) -> Tensor:
    """`to_radiance` of stored numbers plus `log_factor`, given their `radiance`.

    For a bounded field that is odds times the factor f: `E f / (1 - E + E f)`.
    """
    factor = log_factor.exp()
    if not bounded:
        return radiance * factor
    return radiance * factor / (1 - radiance + radiance * factor)


def mean_square(values: Tensor) -> Tensor:
    """Mean of the squares; 0 of no values."""
    return values.square().sum() / max(values.numel(), 1)


class Gaussians(nn.Module):
    """`count` Gaussians at rest, whose color may change in time and with the view.

    `knots` is the number of log-radiance offsets in time, of `channels` each (3:
    colors, 1: brightness).
    """

    def __init__(
        self,
        count: int,
        knots: int,
        channels: int,
        view_dependence: bool = False,
        bounded: bool = False,
    ) -> None:
        super().__init__()
        self.bounded = bounded
        unturned = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
        self.means = nn.Parameter(torch.zeros(count, 3))  # scene units
        self.quaternions = nn.Parameter(unturned)  # w x y z, of any length
        # log of standard deviations in scene units
        self.log_scales = nn.Parameter(torch.full((count, 3), START_LOG_SCALE))
        self.opacity_logits = nn.Parameter(torch.full((count,), START_LOGIT))  # of opacity
        self.log_radiance = nn.Parameter(torch.zeros(count, 3))  # or log odds
        # of log radiance, spread over the clip's time
        self.log_radiance_offsets = nn.Parameter(torch.zeros(knots, count, channels))
        # change of log radiance (rgb) per unit of view direction (xyz)
        self.sh1 = nn.Parameter(torch.zeros(count if view_dependence else 0, 3, 3))

    def __len__(self) -> int:
        return len(self.means)

    @torch.no_grad()
    def copy(self, source: Tensor, target: Tensor) -> None:
        """Make the Gaussians `target` (N,) like `source` (N,)."""
        parameters = [self.means, self.quaternions, self.log_scales]
        parameters += [self.log_radiance, self.opacity_logits]
        if len(self.sh1):
            parameters.append(self.sh1)
        for parameter in parameters:
            parameter[target] = parameter[source]
        self.log_radiance_offsets[:, target] = self.log_radiance_offsets[:, source]

    def radiance(self, share: float) -> Tensor:
        """Radiance (G, 3) at a share in [0, 1] of the clip's time."""
        offset = interpolate_linear(
            self.log_radiance_offsets, share * (len(self.log_radiance_offsets) - 1)
        )
        return to_radiance(self.log_radiance + offset, self.bounded)
