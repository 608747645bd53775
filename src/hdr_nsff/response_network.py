"""The response as a network (HDR-NeRF, Huang et al. 2022): per channel one hidden layer from log exposure to recorded value.

It is not monotone by construction and its ends are free; HDR-NeRF fixes the scale by holding one point of it, and so does `unit_point`."""

from __future__ import annotations

import torch
from torch import Tensor, nn

WIDTH = 128  # of the hidden layer
SMALLEST = 1e-6  # exposure below which the logarithm is held
MIDDLE = 0.5  # the recorded value that is held, where the starting curve reaches it
FIT_STEPS = 600


class NetworkResponse(nn.Module):
    """`sigmoid(out . relu(w ln x + b))` per channel, one for all cameras."""

    knots: Tensor
    unit: Tensor

    def __init__(self, knots: Tensor, start: Tensor) -> None:
        """Starts as the curve `start` (K,) or (3, K) at `knots` (K,) in [0, 1]."""
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.register_buffer("knots", knots, persistent=False)
        self.register_buffer("unit", torch.zeros(3))  # log exposure at which `MIDDLE` is recorded
        self.slope = nn.Parameter(torch.randn(3, WIDTH, generator=generator) * 0.5)
        self.shift = nn.Parameter(torch.randn(3, WIDTH, generator=generator))
        self.out = nn.Parameter(torch.randn(3, WIDTH, generator=generator) / WIDTH**0.5)
        self.level = nn.Parameter(torch.zeros(3))
        self.set_values(start)

    def forward(self, exposure: Tensor) -> Tensor:
        """Recorded values (N, 3) in (0, 1) of exposures (N, 3); what is not above 0 counts as `SMALLEST`."""
        return self.of_log(exposure.clamp_min(SMALLEST).log())

    def of_log(self, log: Tensor) -> Tensor:
        """Recorded values (N, 3) of log exposures (N, 3)."""
        hidden = (log[..., None] * self.slope + self.shift).relu()  # (N, 3, WIDTH)
        return ((hidden * self.out).sum(-1) + self.level).sigmoid()

    def values(self) -> Tensor:
        """The curve at the knots, (3, K)."""
        return self(self.knots[:, None].expand(-1, 3)).T

    def unit_point(self) -> Tensor:
        """Square distance from `MIDDLE` of what is recorded at the unit exposure: HDR-NeRF's unit exposure loss, which fixes the scale."""
        return (self.of_log(self.unit[None]) - MIDDLE).square().sum()

    def set_values(self, y: Tensor) -> None:
        """Take on the curve `y` (K,) or (3, K) at the knots, by least squares in the recorded value."""
        y = y.detach().to(self.knots).expand(3, -1)
        x, target = self.knots[1:, None].expand(-1, 3), y[:, 1:].T
        at = (y >= MIDDLE).float().argmax(-1).clamp_min(1)
        self.unit.copy_(self.knots[at].log())
        with torch.enable_grad():
            optimiser = torch.optim.Adam(self.parameters(), lr=1e-2)
            for step in range(FIT_STEPS):
                optimiser.param_groups[0]["lr"] = 1e-2 * 0.02 ** (step / FIT_STEPS)
                loss = (self(x) - target).square().mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
        self.zero_grad(set_to_none=True)
