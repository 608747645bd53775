"""Samples along rays, what a branch answers there, and pictures rendered in chunks.

Shapes are (N rays, S samples). Cube coordinates are those of `space.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, nn

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.space import Space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume

T = TypeVar("T")

CHUNK = 8192  # pixels rendered at once, which bounds memory
MAX_LOG_RADIANCE = 14.0  # of a sample: keeps its exponential and sums of it finite


@dataclass(frozen=True)
class RaySamples:
    """Samples along rays, all of them."""

    depths: Tensor  # (N, S) z-depth, scene units
    points: Tensor  # (N, S, 3) scene units
    coords: Tensor  # (N, S, 3) cube
    deltas: Tensor  # (N, S) cube length of the step to the next sample
    directions: Tensor  # (N, 3) unit view directions


@dataclass(frozen=True)
class BranchOutput:
    """What one branch answers at the samples of some rays."""

    density: Tensor  # (N, S) per cube length, >= 0
    radiance: Tensor  # (N, S, 3) linear HDR, >= 0
    blend: Tensor  # (N, S) v of eq. 5, of the static branch alone, where eq. 6-7 blend


def sample_rays(
    space: Space,
    camera: Camera,
    pixels: Tensor,
    num_samples: int,
    near: float,
    far: float,
    generator: torch.Generator | None,
    opaque_end: bool = False,
) -> RaySamples:
    """Samples along the rays of `pixels` (N, 2), evenly in disparity, near to far.

    `near` and `far` are z-depths in scene units. With a generator, samples are jittered
    within their bins. `opaque_end`: see `volume.step_lengths`.
    """
    rays = camera.rays(pixels)
    num_rays = len(pixels)
    jitter = None
    if generator is not None:
        shape, where = (num_rays, num_samples), generator.device
        jitter = torch.rand(shape, generator=generator, device=where)
    depths = volume.stratified_disparity(num_rays, num_samples, near, far, jitter).to(pixels)
    points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]  # (N, S, 3)
    coords = space.encode(points)
    return RaySamples(
        depths=depths,
        points=points,
        coords=coords,
        deltas=volume.step_lengths(coords, opaque_end),
        directions=nn.functional.normalize(rays.directions, dim=-1),
    )


def ray_of(index: Tensor, num_samples: int) -> Tensor:
    """The ray (M,) of each sample, of its position `index` (M,) among N * S samples."""
    return torch.div(index, num_samples, rounding_mode="floor")


def sum_per_ray(values: Tensor, ray: Tensor, num_rays: int) -> Tensor:
    """The sum of `values` (M, C) over the samples of each `ray` (M,): (num_rays, C)."""
    return values.new_zeros(num_rays, values.shape[1]).index_add(0, ray, values)


def map_chunks(
    field: nn.Module, camera: Camera, pixels: Tensor | None, function: Callable[[Tensor], T]
) -> list[T]:
    """`function` of `pixels` (S, 2), or of every pixel row by row, chunk by chunk.

    The field is in evaluation mode meanwhile.
    """
    pixels = camera.pixel_grid() if pixels is None else pixels
    was_training = field.training
    field.eval()
    parts = [function(chunk) for chunk in pixels.split(CHUNK)]
    field.train(was_training)
    return parts


def render_in_chunks(
    field: nn.Module, camera: Camera, pixels: Tensor | None, function: Callable[[Tensor], Render]
) -> Render:
    """The render that `function` makes of `pixels` (S, 2), or of every pixel.

    It is called with a few thousand pixels at once; warps are not joined.
    """
    parts = map_chunks(field, camera, pixels, function)
    rgb = [p.rgb for p in parts if p.rgb is not None]
    return Render(
        radiance=torch.cat([p.radiance for p in parts]),
        depth=torch.cat([p.depth for p in parts]),
        opacity=torch.cat([p.opacity for p in parts]),
        motion=torch.cat([p.motion for p in parts]),
        scene_flow={o: torch.cat([p.scene_flow[o] for p in parts]) for o in parts[0].scene_flow},
        rgb=torch.cat(rgb) if rgb else None,
    )
