"""The prepared scene as a colored point cloud, from which fields are initialized: every
pixel at the z-depth of its prior, in the radiance it recorded, with a trust; and the
reduction of many points to one per cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from hdr_nsff.maths.losses import saturation_weight
from hdr_nsff.scene.scene import Frame

CELLS_PER_KIND = 2**57  # `assign_cells` numbers the cells of a kind below this
CELL_BITS = 19  # of a cell's index along one axis: three times that is 57
MAX_CELLS_ACROSS = 2.0**18  # along the longest side; leaves one bit of room
CELL_PRECISION = 1.01  # the cells' size is found to 1 %

MIN_RADIANCE = 1e-5  # of a point: keeps the logarithm of black finite
MAX_SIGMOID_RADIANCE = 0.999  # that a sigmoid is asked to start from at most
MIN_CONFIDENCE = 0.02  # added to the prior's: a point of confidence 0 still counts a little
# recorded values outside this range count as clipped (hand-chosen on rendered scenes)
UNCLIPPED = (0.01, 0.97)
CLIPPED_TRUST = 1e-3  # of a pixel with a clipped channel, where a good one has up to 1
MIN_BRIGHTNESS_TRUST = 0.05  # of a black pixel: its relative noise is largest


class ToRadiance(Protocol):
    """The inverse of a recording."""

    def __call__(self, rgb: Tensor, frame: int, pixels: Tensor | None = None, /) -> Tensor:
        """Radiance (P, 3) that training frame `frame` recorded as `rgb` (P, 3) at
        `pixels` (P, 2), by default all of its picture, row by row.
        """
        ...


@dataclass(frozen=True)
class PointCloud:
    """`P` colored points."""

    positions: Tensor  # (P, 3) scene units
    log_radiance: Tensor  # (P, 3)
    trust: Tensor  # (P,) > 0
    footprint: Tensor  # (P,) scene units that one pixel covers at the point

    def __len__(self) -> int:
        return len(self.trust)

    def select(self, chosen: Tensor) -> PointCloud:
        """The `chosen` (P,) bool points, in order."""
        return PointCloud(
            self.positions[chosen],
            self.log_radiance[chosen],
            self.trust[chosen],
            self.footprint[chosen],
        )


def unproject_frame(
    frame: Frame, position: int, chosen: Tensor, near: float, far: float, to_radiance: ToRadiance
) -> PointCloud:
    """The `chosen` (H * W,) bool pixels of a frame where its depth prior puts them.

    `position` is the frame's place in the list of training frames; depths are held
    between z-depths `near` and `far`.
    """
    disparity = prior_disparity(frame, near, far)[chosen]
    pixels = frame.camera.pixel_grid()[chosen]
    rays = frame.camera.rays(pixels)
    rgb = frame.image.reshape(-1, 3)[chosen]
    radiance = to_radiance(rgb, position, pixels)
    focal = frame.camera.K[0, 0]
    return PointCloud(
        positions=rays.origins + rays.directions / disparity[:, None],
        log_radiance=radiance.clamp_min(MIN_RADIANCE).log(),
        trust=point_trust(rgb, prior_confidence(frame)[chosen]),
        footprint=1 / (disparity * focal),
    )


def prior_disparity(frame: Frame, near: float, far: float) -> Tensor:
    """The depth prior's disparity (H * W,) of a frame that has one.

    It is held between z-depths `near` and `far`.
    """
    assert frame.disparity is not None
    return frame.disparity.reshape(-1).clamp(1 / far, 1 / near)


def prior_confidence(frame: Frame) -> Tensor:
    """The depth prior's confidence (H * W,) in [0, 1]; 1 where it has none."""
    if frame.disparity_confidence is None:
        return torch.ones(frame.image[..., 0].numel())
    return frame.disparity_confidence.reshape(-1)


def point_trust(rgb: Tensor, confidence: Tensor) -> Tensor:
    """Trust (P,) in points recorded as `rgb` (P, 3) at depths of `confidence` (P,)."""
    return (confidence + MIN_CONFIDENCE) * exposure_trust(rgb)


def exposure_trust(rgb: Tensor) -> Tensor:
    """Trust (P,) in the radiance of recorded values `rgb` (P, 3).

    It is next to none where a channel clips, and less in the darks.
    """
    low, high = UNCLIPPED
    clipped = ((rgb > high) | (rgb < low)).any(-1)
    brightness = rgb.mean(-1).clamp(MIN_BRIGHTNESS_TRUST, 1)
    unclipped_trust = saturation_weight(rgb).amin(-1) * brightness
    return torch.where(clipped, torch.tensor(CLIPPED_TRUST), unclipped_trust)


def concatenate(clouds: list[PointCloud]) -> PointCloud:
    """All points of several clouds, in order."""
    return PointCloud(
        torch.cat([c.positions for c in clouds]),
        torch.cat([c.log_radiance for c in clouds]),
        torch.cat([c.trust for c in clouds]),
        torch.cat([c.footprint for c in clouds]),
    )


def merge_by_cell(points: PointCloud, cell: Tensor) -> PointCloud:
    """One point per distinct value of `cell` (P,) integers, in the order of the values.

    It is the trust-weighted mean of the points in the cell, with their summed trust.
    """
    _, cell = torch.unique(cell, return_inverse=True)
    count = int(cell.max()) + 1 if len(cell) else 0
    weight = points.trust.double()
    total = torch.zeros(count, dtype=torch.float64).index_add_(0, cell, weight)

    def mean(values: Tensor) -> Tensor:
        columns = values.double().unsqueeze(-1).flatten(1)  # (P, C), C = 1 of plain numbers
        summed = torch.zeros(count, columns.shape[1], dtype=torch.float64)
        summed.index_add_(0, cell, columns * weight[:, None])
        means = summed / total[:, None]
        return means.to(values).reshape(count, *values.shape[1:])

    return PointCloud(
        mean(points.positions),
        mean(points.log_radiance),
        total.to(points.trust),
        mean(points.footprint),
    )


def assign_cells(coords: Tensor, kind: Tensor, limit: int) -> Tensor:
    """The cubic cell (P,) in which every point of `coords` (P, 3) lies.

    Cells are the finest of which at most `limit` are occupied (or one per kind). `kind`
    (P,) are integers from 0 to 62. A cell is numbered `kind * CELLS_PER_KIND` + a
    number below `CELLS_PER_KIND`, so that no two kinds share one.
    """
    if not len(coords):
        return kind
    inside = (coords - coords.amin(0)).double()
    inside = inside / inside.max().clamp_min(1e-30)

    def cells(cells_across: float) -> Tensor:
        x, y, z = (inside * cells_across).long().unbind(-1)
        return kind * CELLS_PER_KIND + (x * 2**CELL_BITS + y) * 2**CELL_BITS + z

    low, high = 0.5, MAX_CELLS_ACROSS  # one cell in all, and the finest; bisected
    while high / low > CELL_PRECISION:
        middle = (low * high) ** 0.5
        occupied = len(torch.unique(cells(middle)))
        if occupied <= limit:
            low = middle
        else:
            high = middle
    return cells(low)
