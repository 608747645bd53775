"""Where a field lives: an invertible map from the world onto the unit cube in which it
is sampled and stored.

`FrustumSpace` is NDC generalized to any bounds: (x / z, y / z, 1 / z) in a reference
camera, so that cells are pixel-sized at every distance. `ContractedSpace` squeezes all
of space into a ball (mip-NeRF 360, eq. 10) for cameras that look every way.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdr_nsff.geometry.cameras import Camera

MARGIN = 0.02  # of the cube, left free on every side


class FrustumSpace(nn.Module):
    """The union of the cameras' frusta, seen from their average pose: x / z, y / z and
    1 / z scaled to [0, 1].
    """

    w2c: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, w2c: Tensor, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("w2c", w2c)  # (3, 4) world to reference camera
        self.register_buffer("low", low)  # (3,) of (x / z, y / z, 1 / z)
        self.register_buffer("high", high)

    def encode(self, points: Tensor) -> Tensor:
        """World points (..., 3) to cube coordinates (..., 3)."""
        local = points @ self.w2c[:, :3].T + self.w2c[:, 3]
        disparity = 1.0 / local[..., 2:].clamp_min(1e-6)
        return (torch.cat([local[..., :2] * disparity, disparity], -1) - self.low) / (
            self.high - self.low
        )

    def decode(self, coords: Tensor) -> Tensor:
        """Cube coordinates (..., 3) to world points (..., 3)."""
        scaled = coords * (self.high - self.low) + self.low
        depth = 1.0 / scaled[..., 2:].clamp_min(1e-6)
        local = torch.cat([scaled[..., :2] * depth, depth], -1)
        return (local - self.w2c[:, 3]) @ self.w2c[:, :3]


class ContractedSpace(nn.Module):
    """All of space: linear within `radius` of `center`, squeezed beyond, scaled to [0,
    1].
    """

    center: Tensor
    radius: Tensor

    def __init__(self, center: Tensor, radius: Tensor) -> None:
        super().__init__()
        self.register_buffer("center", center)
        self.register_buffer("radius", radius)

    def encode(self, points: Tensor) -> Tensor:
        """World points (..., 3) to cube coordinates (..., 3)."""
        x = (points - self.center) / self.radius
        norm = x.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        squeezed = torch.where(norm <= 1, x, (2 - 1 / norm) * (x / norm))
        return squeezed / 4 + 0.5

    def decode(self, coords: Tensor) -> Tensor:
        """Cube coordinates (..., 3) to world points (..., 3)."""
        x = (coords - 0.5) * 4
        norm = x.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        full = torch.where(norm <= 1, x, x / norm / (2 - norm).clamp_min(1e-3))
        return full * self.radius + self.center


Space = FrustumSpace | ContractedSpace


def mean_pose(cameras: list[Camera]) -> Tensor:
    """The cameras' average pose (3, 4), camera to world: mean center, mean viewing and
    down directions made orthogonal.
    """
    poses = torch.stack([c.c2w for c in cameras]).double()
    forward = torch.nn.functional.normalize(poses[:, :, 2].mean(0), dim=0)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(poses[:, :, 1].mean(0), forward), dim=0
    )
    return torch.stack(
        [right, torch.linalg.cross(forward, right), forward, poses[:, :, 3].mean(0)], -1
    ).float()


def frustum_corners(cameras: list[Camera], near: float, far: float) -> Tensor:
    """The eight corners of every camera's viewing frustum between z-depths `near` and
    `far`: (T * 8, 3).
    """
    corners = []
    for c in cameras:
        pixels = torch.tensor([[0.0, 0.0], [c.width, 0.0], [0.0, c.height], [c.width, c.height]])
        rays = c.rays(pixels.to(c.K))
        corners += [rays.origins + depth * rays.directions for depth in (near, far)]
    return torch.cat(corners)


def build_space(cameras: list[Camera], near: float, far: float) -> Space:
    """`FrustumSpace` where all frusta lie well in front of the average camera, else
    `ContractedSpace`.
    """
    pose = mean_pose(cameras)
    corners = frustum_corners(cameras, near, far)
    local = (corners - pose[:, 3]) @ pose[:, :3]
    if local[:, 2].min() > 0.2 * near:
        disparity = 1.0 / local[:, 2:]
        bounds = torch.cat([local[:, :2] * disparity, disparity], -1)
        low, high = bounds.amin(0), bounds.amax(0)
        margin = MARGIN * (high - low)
        low = torch.cat([(low - margin)[:2], (low[2:] - margin[2:]).clamp_min(0.5 / far)])
        w2c = torch.cat([pose[:, :3].T, -(pose[:, :3].T @ pose[:, 3:])], -1)
        return FrustumSpace(w2c, low, high + margin)
    centers = torch.stack([c.c2w[:, 3] for c in cameras])
    center = centers.mean(0)
    return ContractedSpace(center, (centers - center).norm(dim=-1).max() + near * 2)
