"""Vignetting, learned: the share of light that a lens passes to each pixel.

    1 + v1 r^2 + v2 r^4 + v3 r^6

per camera, with r the tangent of the angle to the axis, 1 at the corner of a frame: the
even polynomial of Goldman and Chen 2005. It multiplies radiance before the response.
Only points that a clip shows at several distances from the axis determine it: a camera
at rest cannot tell a dark corner of the lens from a dark corner of the scene, and has
none here.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Frame, Scene

# standard deviation of r^2 over the frames that see a point, averaged over points:
# below it a clip determines no vignetting (hand-chosen: real pans have 0.04 to 0.09,
# cameras that hardly move 0.00 to 0.02)
MIN_SPREAD = 0.05
GRID = 7  # points along each side of a frame that are followed
MIN_TRANSMISSION = 0.05  # no lens in use passes less to a corner


class Vignetting(nn.Module):
    """The vignetting of every camera; none at the start."""

    corners: Tensor  # (C,) squared tangent of the angle to the axis at a corner

    def __init__(self, corners: tuple[float, ...]) -> None:
        super().__init__()
        self.register_buffer("corners", torch.tensor(corners), persistent=False)
        self.coefficients = nn.Parameter(torch.zeros(len(corners), 3))

    def forward(self, camera: Camera, pixels: Tensor, camera_id: int) -> Tensor:
        """The share of light (N, 1) at `pixels` (N, 2) of a `camera`."""
        r2 = squared_tangent(camera, pixels)[:, None] / self.corners[camera_id]
        v1, v2, v3 = self.coefficients[camera_id]
        return (1 + r2 * (v1 + r2 * (v2 + r2 * v3))).clamp_min(MIN_TRANSMISSION)

    def shade(self, radiance: Tensor, camera: Camera, pixels: Tensor, camera_id: int) -> Tensor:
        """What of `radiance` (N, 3) a camera's lens passes to `pixels` (N, 2)."""
        return radiance * self(camera, pixels, camera_id)

    def size(self) -> Tensor:
        """Mean square of the coefficients: how far from none."""
        return self.coefficients.square().mean()


def squared_tangent(camera: Camera, pixels: Tensor) -> Tensor:
    """Squared tangent (N,) of the angle between `pixels` (N, 2) and the axis."""
    x = (pixels[:, 0] - camera.K[0, 2]) / camera.K[0, 0]
    y = (pixels[:, 1] - camera.K[1, 2]) / camera.K[1, 1]
    return x.square() + y.square()


def vignetting_corners(scene: Scene, num_cameras: int) -> tuple[float, ...]:
    """The squared tangent at a frame's corner of every camera; empty where the clip
    does not determine vignetting.
    """
    corners = []
    depth = 2 / (1 / scene.near + 1 / scene.far)
    for camera_id in range(num_cameras):
        frames = [f for f in scene.train if f.camera_id == camera_id]
        if not frames or radial_spread(frames, depth) < MIN_SPREAD:
            return ()
        corners.append(corner(frames[0].camera))
    return tuple(corners)


def corner(camera: Camera) -> float:
    """The squared tangent of the angle between a corner of the picture and the axis."""
    ends = torch.tensor([[0.0, 0.0], [camera.width, camera.height]])
    return float(squared_tangent(camera, ends).max())


def radial_spread(frames: list[Frame], depth: float) -> float:
    """How far points at z-depth `depth` move along the radius of the picture: the mean
    over points of the standard deviation of r^2 over the frames that see them.
    """
    middle = frames[len(frames) // 2].camera
    x, y = (torch.linspace(0, side, GRID) for side in (middle.width, middle.height))
    pixels = torch.cartesian_prod(x, y)
    rays = middle.rays(pixels)
    points = rays.origins + depth * rays.directions
    spread = []
    for f in frames:
        seen, z = f.camera.project(points)
        size = torch.tensor([f.camera.width, f.camera.height])
        visible = ((seen >= 0) & (seen <= size)).all(-1) & (z > 0)
        r2 = squared_tangent(f.camera, seen) / corner(f.camera)
        spread.append(torch.where(visible, r2, torch.nan))
    radii = torch.stack(spread)  # (frames, points)
    count = (~radii.isnan()).sum(0)
    mean = radii.nansum(0) / count
    variance = (radii - mean).square().nansum(0) / count
    return float(variance.sqrt()[count > 0].mean())
