"""What `prepare` knows of the scene as colored points: every pixel at the z-depth of
its prior, in the radiance it recorded, with a trust; and how a multitude of them is
thinned to one per cell. Where fields start from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hdr_nsff.maths.losses import saturation_weight
from hdr_nsff.scene.scene import Frame

CELLS = 2**57  # that `cells_for` tells apart

ToRadiance = Callable[
    [Tensor, int], Tensor
]  # recorded rgb (P, 3) of training frame i -> radiance (P, 3)


@dataclass(frozen=True)
class Points:
    """`P` colored points."""

    positions: Tensor  # (P, 3) scene units
    log_radiance: Tensor  # (P, 3)
    trust: Tensor  # (P,) > 0
    footprint: Tensor  # (P,) scene units that one pixel covered

    def __len__(self) -> int:
        return len(self.trust)


def lift(
    f: Frame, position: int, chosen: Tensor, near: float, far: float, to_radiance: ToRadiance
) -> Points:
    """The `chosen` (H * W,) bool pixels of the frame at `position` of the training
    frames, where its depth prior puts them.
    """
    assert f.disparity is not None
    disparity = f.disparity.reshape(-1)[chosen].clamp(1 / far, 1 / near)
    rays = f.camera.rays(f.camera.pixel_grid()[chosen])
    rgb = f.image.reshape(-1, 3)[chosen]
    confidence = (
        torch.ones_like(disparity)
        if f.disparity_confidence is None
        else f.disparity_confidence.reshape(-1)[chosen]
    )
    return Points(
        rays.origins + rays.directions / disparity[:, None],
        to_radiance(rgb, position).clamp_min(1e-5).log(),
        (confidence + 0.02) * exposure_trust(rgb),
        1 / (disparity * f.camera.K[0, 0]),
    )


def exposure_trust(rgb: Tensor) -> Tensor:
    """How much a recorded value (P, 3) says about radiance: next to nothing where a
    channel clips, less in the darks: (P,).
    """
    clipped = ((rgb > 0.97) | (rgb < 0.01)).any(-1)
    return torch.where(
        clipped, torch.tensor(1e-3), saturation_weight(rgb).amin(-1) * rgb.mean(-1).clamp(0.05, 1)
    )


def joined(parts: list[Points]) -> Points:
    """All points of several lists."""
    columns = zip(
        *((p.positions, p.log_radiance, p.trust, p.footprint) for p in parts), strict=True
    )
    return Points(*(torch.cat(c) for c in columns))


def thinned(points: Points, cell: Tensor) -> Points:
    """One point per distinct value of `cell` (P,) integers: the trust-weighted mean of
    those in it, in the order of the values.
    """
    _, cell = torch.unique(cell, return_inverse=True)
    count = int(cell.max()) + 1 if len(cell) else 0
    weight = points.trust.double()
    total = torch.zeros(count, dtype=torch.float64).index_add_(0, cell, weight)

    def mean(values: Tensor) -> Tensor:
        wide = values.double().unsqueeze(-1).flatten(1) * weight[:, None]
        summed = torch.zeros(count, wide.shape[1], dtype=torch.float64).index_add_(0, cell, wide)
        return (summed / total[:, None]).to(values).reshape(count, *values.shape[1:])

    return Points(
        mean(points.positions),
        mean(points.log_radiance),
        total.to(points.trust),
        mean(points.footprint),
    )


def thinned_to(points: Points, coords: Tensor, limit: int) -> Points:
    """Thinned in cubic cells of `coords` (P, 3), as fine as leaves at most `limit`
    points.
    """
    return thinned(points, cells_for(coords, torch.zeros(len(points), dtype=torch.long), limit))


def cells_for(coords: Tensor, kind: Tensor, limit: int) -> Tensor:
    """Which cubic cell of `coords` (P, 3) every point lies in, (P,): `kind` (P,;
    integers from 0 to 62) * `CELLS` + a number below `CELLS`, so that kinds share none.
    As fine as leaves at most `limit` cells, or one per kind.
    """
    if not len(coords):
        return kind
    inside = (coords - coords.amin(0)).double()
    inside = inside / inside.max().clamp_min(1e-30)

    def cells(fineness: float) -> Tensor:
        x, y, z = (inside * fineness).long().unbind(-1)
        return kind * CELLS + (x * 2**19 + y) * 2**19 + z

    low, high = 0.5, 2.0**18  # cells along the longest side
    while high / low > 1.01:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if len(torch.unique(cells(middle))) <= limit else (low, middle)
    return cells(low)
