"""Three ways to hold a learned response curve: ours, the paper's, and HDR-NeRF's."""

from __future__ import annotations

import torch
from torch import Tensor, nn

GAMMA = 2.2
WIDTH = 128  # of the hidden layer
SMALLEST = 1e-6  # exposure below which the logarithm is held
MIDDLE = 0.5  # the recorded value that is held, where the starting curve reaches it
# log exposures between which hidden units bend at the start; above the upper end, they
# stay gently on, so that a gradient is left
BENDS = (-12.0, -0.4)
FLOOR = 0.004  # recorded values closer to 0 and 1 than this are taken for it: they have no logit
RIDGE = 1e-6


class SharedResponse(nn.Module):
    """One monotone curve per camera and channel: cumulative positive steps that add up
    to 1, so g(0) = 0 and g(1) = 1.
    """

    def __init__(self, num_cameras: int, knots: Tensor, min_step: float) -> None:
        super().__init__()
        self.min_step = min_step
        self.register_buffer("knots", knots, persistent=False)
        self.logits = nn.Parameter(torch.zeros(num_cameras, 3, len(knots) - 1))
        self.set_values(knots.double() ** (1 / GAMMA))

    knots: Tensor

    def values(self, camera_id: int | slice) -> Tensor:
        """The curve at the knots: (3, K), or (cameras, 3, K) for a slice."""
        steps = torch.softmax(self.logits[camera_id], -1)
        steps = steps * (1 - self.min_step) + self.min_step / steps.shape[-1]
        inner = torch.cumsum(steps[..., :-1], -1)
        return torch.cat(
            [torch.zeros_like(inner[..., :1]), inner, torch.ones_like(inner[..., :1])], -1
        )

    def set_values(self, y: Tensor, camera_id: int | None = None) -> None:
        """Take on the values `y` (K,) or (3, K) at the knots; falling or flat pieces
        become the smallest step.
        """
        steps = y.double().diff(dim=-1).clamp_min(0)
        share = steps / steps.sum(-1, keepdim=True).clamp_min(1e-12)
        floor = self.min_step / steps.shape[-1]
        share = ((share - floor) / (1 - self.min_step)).clamp_min(floor * 1e-2)
        with torch.no_grad():
            self.logits[slice(None) if camera_id is None else camera_id] = share.log().to(
                self.logits
            )


class ImageResponse(nn.Module):
    """The paper's response: free points per image and channel, ends fixed, started at
    x^(1/2.2); nothing keeps it monotone.
    """

    def __init__(self, num_images: int, knots: Tensor) -> None:
        super().__init__()
        self.register_buffer("knots", knots, persistent=False)
        self.points = nn.Parameter((knots[1:-1] ** (1 / GAMMA)).expand(num_images, 3, -1).clone())

    knots: Tensor

    def values(self, image: int | slice | Tensor) -> Tensor:
        """The curve at the knots: (3, K), or (images, 3, K)."""
        inner = self.points[image]
        return torch.cat(
            [torch.zeros_like(inner[..., :1]), inner, torch.ones_like(inner[..., :1])], -1
        )

    def set_values(self, y: Tensor) -> None:
        """Take on the values `y` (K,) or (3, K) for every image."""
        with torch.no_grad():
            self.points.copy_(y[..., 1:-1].expand_as(self.points))


class NetworkResponse(nn.Module):
    """The response as a network (HDR-NeRF, Huang et al. 2022): `sigmoid(out . relu(w ln
    x + b))` per channel, one for all cameras.

    It is not monotone by construction and its ends are free; HDR-NeRF fixes the scale
    by holding one point of it, as `unit_point` does.
    """

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
        """Recorded values (N, 3) in (0, 1) of exposures (N, 3); what is not above 0
        counts as `SMALLEST`.
        """
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
        """Square distance from `MIDDLE` of what is recorded at the unit exposure:
        HDR-NeRF's unit exposure loss, which fixes the scale.
        """
        return (self.of_log(self.unit[None]) - MIDDLE).square().sum()

    @torch.no_grad()
    def set_values(self, y: Tensor) -> None:
        """Take on the curve `y` (K,) or (3, K) at the knots: the outer layer by least
        squares in the recorded value, to first order.
        """
        y = y.to(self.knots).expand(3, -1)
        self.unit.copy_(self.knots[(y >= MIDDLE).float().argmax(-1).clamp_min(1)].log())
        hidden = self.hidden(self.knots[1:, None].expand(-1, 3).log()).double()
        target = y[:, 1:].clamp(FLOOR, 1 - FLOOR).double()
        for c in range(3):
            slope = (target[c] * (1 - target[c]))[:, None]  # of the recorded value over its logit
            ones = torch.ones_like(hidden[:, c, :1])
            a = torch.cat([hidden[:, c], ones], -1) * slope
            ridge = RIDGE * torch.eye(WIDTH + 1, dtype=a.dtype, device=a.device)
            found = torch.linalg.solve(a.T @ a + ridge, a.T @ (target[c, :, None].logit() * slope))[
                :, 0
            ].to(self.out)
            self.out[c], self.level[c] = found[:-1], found[-1]
