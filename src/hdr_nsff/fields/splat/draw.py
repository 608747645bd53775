"""Gaussians of a time drawn as a camera sees them: colored by the direction of view,
rasterized, and composited over the background.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.outputs import GaussianCloud
from hdr_nsff.fields.splat.gaussians import scale_radiance, to_radiance
from hdr_nsff.fields.splat.late_mixing import Parts
from hdr_nsff.fields.splat.model import Model
from hdr_nsff.fields.splat.rasterize import Maps, rasterize
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import Recorder

MAX_VIEW_LOG_FACTOR = 2.0  # by which log radiance may change with the direction of view
MIN_ALPHA = 1e-3  # of a pixel: below, it has no depth of its own
MIN_DEPTH_SHARE = 1e-3  # of `near`: the least z-depth that a pixel gets


def draw(model: Model, camera: Camera, cloud: GaussianCloud, extra: list[Tensor]) -> Maps:
    """Rasterize radiance (3), motion (1) and `extra` features (G, ...)."""
    radiance = seen_radiance(model, camera, cloud)
    features = torch.cat([radiance, cloud.motion[:, None], *extra], 1)
    gaussians = cloud.means, cloud.quaternions, cloud.scales, cloud.opacities, features
    return rasterize(*gaussians, camera, model.nearest)


def seen_radiance(model: Model, camera: Camera, cloud: GaussianCloud) -> Tensor:
    """Radiance (G, 3) of the Gaussians in the direction of `camera`."""
    if not model.view_dependence:
        return cloud.radiance
    log_factor = view_log_factor(model, camera, cloud.means)
    return scale_radiance(cloud.radiance, log_factor, model.bounded)


def view_log_factor(model: Model, camera: Camera, means: Tensor) -> Tensor:
    """Change (G, 3) of log radiance with the direction in which `camera` sees.

    The directions are those to the `means` (G, 3): spherical harmonics of degree 1.
    """
    static, moving = model.static, model.moving
    directions = nn.functional.normalize(means - camera.c2w[:, 3], dim=-1)
    same_everywhere = means.new_zeros(len(means) - len(static) - len(moving), 3, 3)
    sh1 = torch.cat([static.sh1, moving.sh1, same_everywhere])
    change = (sh1 @ directions[..., None])[..., 0]
    return change.clamp(-MAX_VIEW_LOG_FACTOR, MAX_VIEW_LOG_FACTOR)


def composite(model: Model, maps: Maps) -> tuple[Render, Tensor]:
    """The render of drawn `maps` over the background, and extra features (S, E)."""
    alpha = maps.alpha.reshape(-1)
    features = maps.features.flatten(0, 1)
    drawn, motion, extra = features.split([3, 1, features.shape[-1] - 4], 1)
    background = to_radiance(model.background, model.bounded)
    # not a sum of two products: the result lies in memory like `drawn`
    radiance = torch.addcmul(drawn, (1 - alpha)[:, None], background)
    depth = maps.depth.reshape(-1) / alpha.clamp_min(MIN_ALPHA)
    depth = torch.where(alpha > MIN_ALPHA, depth, model.far)
    depth = depth.clamp_min(MIN_DEPTH_SHARE * model.unit)
    return Render(radiance, depth, alpha, motion[:, 0]), extra


def record_parts(
    model: Model, recorder: Recorder, camera: Camera, radiance: Tensor, means: Tensor
) -> Parts:
    """Gaussians of `radiance` (G, 3) at `means` (G, 3) and the background, recorded."""
    background = to_radiance(model.background, model.bounded)
    return Parts.of(recorder, camera, radiance, means, background)
