"""The response as a network (HDR-NeRF, Huang et al. 2022): per channel one hidden layer from log exposure to recorded value.

It is not monotone by construction and its ends are free; HDR-NeRF fixes the scale by holding one point of it, and so does `unit_point`."""

from __future__ import annotations

import torch
from torch import Tensor, nn

WIDTH = 128  # of the hidden layer
SMALLEST = 1e-6  # exposure below which the logarithm is held
MIDDLE = 0.5  # the recorded value that is held, where the starting curve reaches it
BENDS = (
    -12.0,
    -0.4,
)  # log exposures between which the hidden units bend at the start: beyond, gently on, so that a gradient is left
FLOOR = 0.004  # recorded values closer to 0 and 1 than this are taken for it: they have no logit
RIDGE = 1e-6


class NetworkResponse(nn.Module):
    """`sigmoid(out . relu(w ln x + b))` per channel, one for all cameras."""

    knots: Tensor
    unit: Tensor

    def __init__(self, knots: Tensor, start: Tensor) -> None:
        """Starts as the curve `start` (K,) or (3, K) at `knots` (K,) in [0, 1]."""
        super().__init__()
        self.register_buffer("knots", knots, persistent=False)
        self.register_buffer("unit", torch.zeros(3))  # log exposure at which `MIDDLE` is recorded
        bends = torch.linspace(*BENDS, WIDTH)
        self.slope = nn.Parameter(torch.ones(3, WIDTH))
        self.shift = nn.Parameter(-bends.repeat(3, 1))
        self.out = nn.Parameter(torch.zeros(3, WIDTH))
        self.level = nn.Parameter(torch.zeros(3))
        self.set_values(start)

    def forward(self, exposure: Tensor) -> Tensor:
        """Recorded values (N, 3) in (0, 1) of exposures (N, 3); what is not above 0 counts as `SMALLEST`."""
        return self.of_log(exposure.clamp_min(SMALLEST).log())

    def of_log(self, log: Tensor) -> Tensor:
        """Recorded values (N, 3) of log exposures (N, 3)."""
        return ((self.hidden(log) * self.out).sum(-1) + self.level).sigmoid()

    def hidden(self, log: Tensor) -> Tensor:
        """The hidden layer (N, 3, WIDTH) at log exposures (N, 3)."""
        return (log[..., None] * self.slope + self.shift).relu()

    def values(self) -> Tensor:
        """The curve at the knots, (3, K)."""
        return self(self.knots[:, None].expand(-1, 3)).T

    def unit_point(self) -> Tensor:
        """Square distance from `MIDDLE` of what is recorded at the unit exposure: HDR-NeRF's unit exposure loss, which fixes the scale."""
        return (self.of_log(self.unit[None]) - MIDDLE).square().sum()

    @torch.no_grad()
    def set_values(self, y: Tensor) -> None:
        """Take on the curve `y` (K,) or (3, K) at the knots: the outer layer by least squares in the recorded value, to first order."""
        y = y.to(self.knots).expand(3, -1)
        self.unit.copy_(self.knots[(y >= MIDDLE).float().argmax(-1).clamp_min(1)].log())
        hidden = self.hidden(self.knots[1:, None].expand(-1, 3).log()).double()
        target = y[:, 1:].clamp(FLOOR, 1 - FLOOR).double()
        for c in range(3):
            slope = (target[c] * (1 - target[c]))[:, None]  # of the recorded value over its logit
            ones = torch.ones_like(hidden[:, c, :1])
            a = torch.cat([hidden[:, c], ones], -1) * slope
            ridge = RIDGE * torch.eye(WIDTH + 1, dtype=a.dtype, device=a.device)
            found = torch.linalg.solve(a.T @ a + ridge, a.T @ (target[c, :, None].logit() * slope))[:, 0].to(self.out)
            self.out[c], self.level[c] = found[:-1], found[-1]
