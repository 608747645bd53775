"""Where a field lives: an invertible map from the world onto the unit cube, in which
the field is sampled and stored.

`FrustumSpace` is normalized device coordinates generalized to any bounds: (x / z, y /
z, 1 / z) in a reference camera, so that cells are pixel-sized at every distance.
`ContractedSpace` maps all of space into a ball (mip-NeRF 360, Barron et al. 2022, eq.
10), for cameras that look in all directions.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdr_nsff.geometry.cameras import Camera

MARGIN = 0.02  # of the frustum's extent, left free on every side (hand-chosen)
# of `near`: a frustum is used where everything the cameras see lies farther than this
# in front of their average pose (hand-chosen)
MIN_FRUSTUM_DEPTH = 0.2
MAX_DEPTH_BEYOND_FAR = 2.0  # times `far`: where the frustum's margin ends at the latest
CORE_MARGIN = 2.0  # times `near`: the uncontracted ball reaches this far past the cameras
MIN_DEPTH = 1e-6  # scene units; keeps 1 / z finite
MIN_NORM = 1e-9  # keeps a direction finite at the center


class FrustumSpace(nn.Module):
    """The union of the cameras' frusta as seen from their average pose.

    Coordinates are x / z, y / z and 1 / z in that pose, scaled to [0, 1].
    """

    w2c: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, w2c: Tensor, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("w2c", w2c)  # (3, 4) world to reference camera
        self.register_buffer("low", low)  # (3,) bounds of (x / z, y / z, 1 / z)
        self.register_buffer("high", high)  # (3,)

    def encode(self, points: Tensor) -> Tensor:
        """World points (..., 3) to cube coordinates (..., 3)."""
        local = points @ self.w2c[:, :3].T + self.w2c[:, 3]
        disparity = 1.0 / local[..., 2:].clamp_min(MIN_DEPTH)
        projected = torch.cat([local[..., :2] * disparity, disparity], -1)
        return (projected - self.low) / (self.high - self.low)

    def decode(self, coords: Tensor) -> Tensor:
        """Cube coordinates (..., 3) to world points (..., 3)."""
        projected = coords * (self.high - self.low) + self.low
        depth = 1.0 / projected[..., 2:].clamp_min(MIN_DEPTH)
        local = torch.cat([projected[..., :2] * depth, depth], -1)
        return (local - self.w2c[:, 3]) @ self.w2c[:, :3]


class ContractedSpace(nn.Module):
    """All of space, contracted into a ball and scaled to [0, 1].

    It is linear within `radius` of `center`; everything beyond lies within twice that.
    """

    center: Tensor
    radius: Tensor

    def __init__(self, center: Tensor, radius: Tensor) -> None:
        super().__init__()
        self.register_buffer("center", center)  # (3,) scene units
        self.register_buffer("radius", radius)  # () scene units

    def encode(self, points: Tensor) -> Tensor:
        """World points (..., 3) to cube coordinates (..., 3)."""
        x = (points - self.center) / self.radius
        norm = x.norm(dim=-1, keepdim=True).clamp_min(MIN_NORM)
        contracted = torch.where(norm <= 1, x, (2 - 1 / norm) * (x / norm))
        return contracted / 4 + 0.5

    def decode(self, coords: Tensor) -> Tensor:
        """Cube coordinates (..., 3) to world points (..., 3)."""
        x = (coords - 0.5) * 4
        norm = x.norm(dim=-1, keepdim=True).clamp_min(MIN_NORM)
        expanded = torch.where(norm <= 1, x, x / norm / (2 - norm).clamp_min(1e-3))
        return expanded * self.radius + self.center


Space = FrustumSpace | ContractedSpace


def mean_pose(cameras: list[Camera]) -> Tensor:
    """The cameras' average pose (3, 4), camera to world.

    It has the mean center, and the mean viewing and down directions made orthogonal.
    """
    poses = torch.stack([c.c2w for c in cameras]).double()
    mean_down = poses[:, :, 1].mean(0)
    forward = torch.nn.functional.normalize(poses[:, :, 2].mean(0), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(mean_down, forward), dim=0)
    down = torch.linalg.cross(forward, right)
    center = poses[:, :, 3].mean(0)
    return torch.stack([right, down, forward, center], -1).float()


def frustum_corners(cameras: list[Camera], near: float, far: float) -> Tensor:
    """The eight corners of every camera's frustum from `near` to `far`: (T * 8, 3)."""
    corners = []
    for c in cameras:
        pixels = torch.tensor([[0.0, 0.0], [c.width, 0.0], [0.0, c.height], [c.width, c.height]])
        rays = c.rays(pixels.to(c.K))
        corners += [rays.origins + depth * rays.directions for depth in (near, far)]
    return torch.cat(corners)


def build_space(cameras: list[Camera], near: float, far: float) -> Space:
    """A `FrustumSpace` where all cameras look one way, else a `ContractedSpace`.

    One way means that all frusta lie well in front of the average camera. `near` and
    `far` are z-depths in scene units.
    """
    pose = mean_pose(cameras)
    corners = frustum_corners(cameras, near, far)
    local = (corners - pose[:, 3]) @ pose[:, :3]
    if local[:, 2].min() > MIN_FRUSTUM_DEPTH * near:
        return bound_frustum(pose, local, far)
    centers = torch.stack([c.c2w[:, 3] for c in cameras])
    center = centers.mean(0)
    farthest_camera = (centers - center).norm(dim=-1).max()
    return ContractedSpace(center, farthest_camera + near * CORE_MARGIN)


def bound_frustum(pose: Tensor, local: Tensor, far: float) -> FrustumSpace:
    """The frustum of a camera at `pose` (3, 4) around points, with a margin.

    The points `local` (P, 3) are in that camera's coordinates.
    """
    disparity = 1.0 / local[:, 2:]
    projected = torch.cat([local[:, :2] * disparity, disparity], -1)
    low, high = projected.amin(0), projected.amax(0)
    margin = MARGIN * (high - low)
    least_disparity = (1 / MAX_DEPTH_BEYOND_FAR) / far
    low_disparity = (low[2:] - margin[2:]).clamp_min(least_disparity)
    low = torch.cat([(low - margin)[:2], low_disparity])
    rotation = pose[:, :3].T
    w2c = torch.cat([rotation, -(rotation @ pose[:, 3:])], -1)
    return FrustumSpace(w2c, low, high + margin)
