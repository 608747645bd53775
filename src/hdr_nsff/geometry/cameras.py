"""Cameras and rays in torch. OpenCV axes everywhere (+x right, +y down, +z forward);
pixels are (x, y) with centers at +0.5; depth is z-depth (distance along the optical
axis, scene units), never distance along the ray. `geometry/pinhole.py` is the numpy
twin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hdr_nsff.geometry.pinhole import MIN_DEPTH


@dataclass(frozen=True)
class Rays:
    """Rays whose directions advance one unit of z-depth.

    `origins + depth * directions` is the point at z-depth `depth`.
    """

    origins: Tensor  # (S, 3) scene units
    directions: Tensor  # (S, 3) scene units, per unit of z-depth


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion."""

    K: Tensor  # (3, 3) pixels
    c2w: Tensor  # (3, 4) OpenCV camera to world, scene units
    width: int
    height: int

    def rays(self, pixels: Tensor) -> Rays:
        """Rays through `pixels` (S, 2), xy with centers at +0.5."""
        x = (pixels[..., 0] - self.K[0, 2]) / self.K[0, 0]
        y = (pixels[..., 1] - self.K[1, 2]) / self.K[1, 1]
        local = torch.stack([x, y, torch.ones_like(x)], -1)
        return Rays(self.c2w[:, 3].expand_as(local), local @ self.c2w[:, :3].T)

    def to_camera(self, points: Tensor) -> Tensor:
        """World `points` (..., 3) in camera coordinates (..., 3)."""
        return (points - self.c2w[:, 3]) @ self.c2w[:, :3]

    def project(self, points: Tensor, min_depth: float = MIN_DEPTH) -> tuple[Tensor, Tensor]:
        """Pixels (..., 2) and z-depths (...) of world `points` (..., 3).

        Points behind the camera project through `min_depth`; test the returned depth
        before using their pixels.
        """
        local = self.to_camera(points)
        depth = local[..., 2]
        scale = 1.0 / depth.clamp_min(min_depth)
        x = local[..., 0] * scale * self.K[0, 0] + self.K[0, 2]
        y = local[..., 1] * scale * self.K[1, 1] + self.K[1, 2]
        return torch.stack([x, y], -1), depth

    def pixel_grid(self) -> Tensor:
        """Every pixel center, row by row: (height * width, 2)."""
        rows = torch.arange(self.height, device=self.K.device)
        columns = torch.arange(self.width, device=self.K.device)
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        return (torch.stack([x, y], -1).reshape(-1, 2) + 0.5).to(self.K)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with another number of pixels."""
        scale = torch.tensor([[width / self.width], [height / self.height], [1.0]]).to(self.K)
        return replace(self, K=self.K * scale, width=width, height=height)

    def moved(self, c2w: Tensor) -> Camera:
        """The same camera at another pose `c2w` (3, 4)."""
        return replace(self, c2w=c2w)
