"""Features at (x, y, z, t) from six planes (HexPlane, Cao & Johnson 2023): three of
space and three of space and time, bilinear, multiplied in the pairs xy·zt, xz·yt, yz·xt
that make up all four axes; the three products stand side by side.

Coordinates are in [0, 1]. Planes are kept at their finest size from the start; while
`cells` is less, only the first `cells` rows and columns of space are in use, so that
growing changes values in place and a checkpoint always fits.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

AXES = (
    (0, 1, 2),
    (0, 2, 1),
    (1, 2, 0),
)  # the plane's two axes of space, and the one that goes with time


class Planes(nn.Module):
    """`components` numbers per plane; `finest` cells a side of space, `slices` of time."""

    cells: Tensor

    def __init__(self, components: int, coarsest: int, finest: int, slices: int) -> None:
        super().__init__()
        self.space = nn.Parameter(
            0.1 * torch.randn(3, components, finest, finest)
        )  # (pair, C, second axis, first axis)
        self.time = nn.Parameter(
            torch.ones(3, components, slices, finest)
        )  # (pair, C, time, third axis): at rest at the start
        self.register_buffer("cells", torch.tensor(coarsest))

    @property
    def used(self) -> tuple[Tensor, Tensor]:
        """What is in use of the planes of space (3, C, R, R) and of time (3, C, slices,
        R).
        """
        r = int(self.cells)
        return self.space[:, :, :r, :r], self.time[..., :r]

    def forward(self, coords: Tensor, share: float) -> Tensor:
        """Features (N, 3 C) at `coords` (N, 3) and a share in [0, 1] of the clip's
        time.
        """
        space, time = self.used
        scaled = 2 * coords - 1
        flat = torch.stack([scaled[:, [a, b]] for a, b, _ in AXES])[:, None]  # (3, 1, N, 2)
        moment = torch.full_like(scaled[:, :1], 2 * share - 1)
        rest = torch.stack([torch.cat([scaled[:, [c]], moment], -1) for _, _, c in AXES])[:, None]
        product = sample(space, flat) * sample(time, rest)  # (3, C, 1, N)
        return product.flatten(0, 2).T

    @torch.no_grad()
    def grow(self, cells: int) -> None:
        """Use `cells` a side from now on, started from the coarser ones by
        interpolation.
        """
        space, time = self.used
        fine = nn.functional.interpolate(space, (cells, cells), mode="bilinear", align_corners=True)
        rest = nn.functional.interpolate(
            time, (time.shape[2], cells), mode="bilinear", align_corners=True
        )
        self.space[:, :, :cells, :cells] = fine
        self.time[..., :cells] = rest
        self.cells.fill_(cells)

    def total_variation(self) -> Tensor:
        """Mean square difference of neighbors along both axes of every plane."""
        return sum_of_squares(*self.used)


def sample(planes: Tensor, places: Tensor) -> Tensor:
    """Bilinear values of `planes` (P, C, H, W) at `places` (P, 1, N, 2) in [-1, 1],
    corners on grid points; outside the nearest edge.
    """
    return nn.functional.grid_sample(
        planes, places, mode="bilinear", padding_mode="border", align_corners=True
    )


def sum_of_squares(space: Tensor, time: Tensor) -> Tensor:
    """The mean square of first differences along each of the last two axes, summed over
    axes and kinds of planes.
    """
    return torch.stack(
        [p.diff(dim=d).square().mean() for p in (space, time) for d in (-2, -1) if p.shape[d] > 1]
    ).sum()
