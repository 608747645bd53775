"""Features at (x, y, z, t) from six planes (HexPlane, Cao and Johnson 2023).

Three planes of space and three of space and time are read bilinearly and multiplied in
the pairs xy·zt, xz·yt, yz·xt, each of which spans all four axes. The three products
stand side by side.

Coordinates are in [0, 1]. Planes are kept at their finest size from the start; while
`cells` is less, only the first `cells` rows and columns of space are in use, so that
growing changes values in place and a checkpoint always fits.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

# of each pair: the space plane's two axes, and the axis that goes with time
AXES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
START_SCALE = 0.1  # standard deviation of the space planes at the start


class Planes(nn.Module):
    """Six planes of `components` numbers (C) at every cell.

    Space has `finest` cells a side, of which `coarsest` are in use at the start; time
    has `slices`.
    """

    cells: Tensor

    def __init__(self, components: int, coarsest: int, finest: int, slices: int) -> None:
        super().__init__()
        space = START_SCALE * torch.randn(3, components, finest, finest)
        self.space = nn.Parameter(space)  # (pair, C, second axis, first axis)
        at_rest = torch.ones(3, components, slices, finest)
        self.time = nn.Parameter(at_rest)  # (pair, C, time, third axis)
        self.register_buffer("cells", torch.tensor(coarsest))

    @property
    def used(self) -> tuple[Tensor, Tensor]:
        """The parts in use, of space (3, C, R, R) and of time (3, C, slices, R)."""
        size = int(self.cells)
        return self.space[:, :, :size, :size], self.time[..., :size]

    def forward(self, coords: Tensor, share: float) -> Tensor:
        """Features (N, 3 C) at `coords` (N, 3) and a share in [0, 1] of the clip."""
        space, time = self.used
        scaled = 2 * coords - 1
        moment = torch.full_like(scaled[:, :1], 2 * share - 1)
        in_space = [scaled[:, [a, b]] for a, b, _ in AXES]
        in_time = [torch.cat([scaled[:, [c]], moment], -1) for _, _, c in AXES]
        space_values = sample_bilinear(space, torch.stack(in_space)[:, None])
        time_values = sample_bilinear(time, torch.stack(in_time)[:, None])
        product = space_values * time_values  # (3, C, 1, N)
        return product.flatten(0, 2).T

    @torch.no_grad()
    def grow(self, cells: int) -> None:
        """Use `cells` a side from now on, interpolated from the coarser ones."""
        space, time = self.used
        slices = time.shape[2]
        finer_space = resize(space, cells, cells)
        finer_time = resize(time, slices, cells)
        self.space[:, :, :cells, :cells] = finer_space
        self.time[..., :cells] = finer_time
        self.cells.fill_(cells)

    def total_variation(self) -> Tensor:
        """Mean square difference of neighbors, summed over axes and kinds of planes."""
        terms = []
        for planes in self.used:
            for axis in (-2, -1):
                if planes.shape[axis] > 1:
                    terms.append(planes.diff(dim=axis).square().mean())
        return torch.stack(terms).sum()


def sample_bilinear(planes: Tensor, places: Tensor) -> Tensor:
    """Values (P, C, 1, N) of `planes` (P, C, H, W) at `places` (P, 1, N, 2).

    Places are in [-1, 1], corners on grid points; outside, the nearest edge counts.
    """
    return nn.functional.grid_sample(
        planes, places, mode="bilinear", padding_mode="border", align_corners=True
    )


def resize(planes: Tensor, height: int, width: int) -> Tensor:
    """`planes` (P, C, H, W) resized bilinearly, corners on grid points."""
    return nn.functional.interpolate(planes, (height, width), mode="bilinear", align_corners=True)
