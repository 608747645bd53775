"""Gaussians at rest: what each is made of, as learned numbers."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdr_nsff.fields.knots import linear

BRIGHTEST = 16.0  # log radiance beyond this is held: exp stays finite


class Gaussians(nn.Module):
    """`count` Gaussians at rest, with `knots` log-radiance offsets in time of `channels` (3: colours, 1: brightness)."""

    def __init__(self, count: int, knots: int, channels: int, shiny: bool = False) -> None:
        super().__init__()
        self.means = nn.Parameter(torch.zeros(count, 3))  # scene units
        self.quaternions = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(count, 1))  # w x y z
        self.log_scales = nn.Parameter(torch.full((count, 3), -5.0))  # log of standard deviations in scene units
        self.logits = nn.Parameter(torch.full((count,), -10.0))  # of opacity
        self.log_radiance = nn.Parameter(torch.zeros(count, 3))
        self.offsets = nn.Parameter(torch.zeros(knots, count, channels))  # of log radiance, over the clip's time
        self.sheen = nn.Parameter(torch.zeros(count if shiny else 0, 3, 3))  # change of log radiance by direction of view (xyz)

    def __len__(self) -> int:
        return len(self.means)

    def radiance(self, share: float) -> Tensor:
        """Radiance (G, 3) at a share in [0, 1] of the clip's time."""
        log = self.log_radiance + linear(self.offsets, share * (len(self.offsets) - 1))
        return log.clamp_max(BRIGHTEST).exp()
