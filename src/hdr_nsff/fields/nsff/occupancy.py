"""Where it is worth asking the field: a coarse grid of the largest rendered weight seen
in each cell (PROTOTYPES: culling by rendered weight, dilated, with a little
exploration, keeps 37 % of the samples).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Occupancy(nn.Module):
    """`slices` grids (one for static content, one per training time for dynamic
    content) over the unit cube.
    """

    weight: Tensor
    mask: Tensor
    allowed: Tensor

    def __init__(self, resolution: tuple[int, int, int], slices: int = 1) -> None:
        super().__init__()
        self.resolution = resolution
        x, y, z = resolution
        self.register_buffer("weight", torch.zeros(slices, z, y, x))
        self.register_buffer(
            "mask", torch.ones(slices, z, y, x, dtype=torch.bool)
        )  # cells that are asked
        self.register_buffer(
            "allowed", torch.ones(slices, z, y, x, dtype=torch.bool)
        )  # cells that may ever hold something

    def cells(self, coords: Tensor, knot: float = 0.0) -> Tensor:
        """Flat cell index (M,) of `coords` (M, 3) in [0, 1] at the nearest slice."""
        x, y, z = self.resolution
        top = torch.tensor([x, y, z], device=coords.device)
        i = torch.minimum((coords.detach().clamp(0, 1) * top).long(), top - 1)
        return ((round(knot) * z + i[:, 2]) * y + i[:, 1]) * x + i[:, 0]

    def centers(self) -> Tensor:
        """Cube coordinates of one slice's cell centers, in storage order: (Z * Y * X,
        3).
        """
        x, y, z = self.resolution
        axes = [(torch.arange(n) + 0.5) / n for n in (z, y, x)]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        return grid.flip(-1).to(self.weight)

    def asks(
        self, coords: Tensor, knot: float, explore: float, generator: torch.Generator | None
    ) -> Tensor:
        """Which of `coords` (M, 3) to evaluate: (M,) bool. A share `explore` of the
        others (where allowed) comes along.
        """
        cells = self.cells(coords, knot)
        keep = self.mask.view(-1)[cells]
        if explore and generator is not None:
            lucky = torch.rand(len(coords), generator=generator).to(coords.device) < explore
            keep = keep | (lucky & self.allowed.view(-1)[cells])
        return keep

    @torch.no_grad()
    def observe(self, coords: Tensor, weights: Tensor, knot: float = 0.0) -> None:
        """Remember rendered `weights` (M,) at `coords` (M, 3)."""
        self.weight.view(-1).scatter_reduce_(0, self.cells(coords, knot), weights.detach(), "amax")

    @torch.no_grad()
    def refresh(self, threshold: float, decay: float) -> None:
        """Ask only cells within one cell of a remembered weight above `threshold`;
        memories fade by `decay`.
        """
        near = nn.functional.max_pool3d(self.weight[:, None], 3, stride=1, padding=1)[:, 0]
        self.mask.copy_((near > threshold) & self.allowed)
        self.weight.mul_(decay)
