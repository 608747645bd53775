"""Samples along rays, what a branch holds there, and pictures made chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.space import Space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume

CHUNK = 8192  # pixels rendered at once


@dataclass(frozen=True)
class March:
    """Samples along rays, all of them."""

    depths: Tensor  # (N, S) z-depth
    points: Tensor  # (N, S, 3) scene units
    coords: Tensor  # (N, S, 3) cube
    deltas: Tensor  # (N, S) cube
    directions: Tensor  # (N, 3) unit view directions


@dataclass(frozen=True)
class Content:
    """What one branch holds at the samples of some rays."""

    density: Tensor  # (N, S)
    radiance: Tensor  # (N, S, 3)
    blend: Tensor  # (N, S)


def march(
    space: Space,
    camera: Camera,
    pixels: Tensor,
    num_samples: int,
    near: float,
    far: float,
    generator: torch.Generator | None,
) -> March:
    """Samples along the rays of `pixels` (N, 2), evenly in disparity from `near` to
    `far`; jittered where a generator is given.
    """
    rays = camera.rays(pixels)
    n = len(pixels)
    jitter = None if generator is None else torch.rand(n, num_samples, generator=generator)
    depths = volume.stratified_disparity(n, num_samples, near, far, jitter).to(pixels)
    points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]  # (N, S, 3)
    coords = space.encode(points)
    return March(
        depths,
        points,
        coords,
        volume.step_lengths(coords),
        nn.functional.normalize(rays.directions, dim=-1),
    )


def in_chunks(
    field: nn.Module, camera: Camera, pixels: Tensor | None, part: Callable[[Tensor], Render]
) -> Render:
    """What `part` renders of `pixels` (S, 2), or of every pixel row by row, a few
    thousand at once; the field is out of training meanwhile.
    """
    pixels = camera.pixel_grid() if pixels is None else pixels
    was_training = field.training
    field.eval()
    parts = [part(chunk) for chunk in pixels.split(CHUNK)]
    field.train(was_training)
    radiance, depth, opacity, motion = (
        torch.cat(maps)
        for maps in zip(*((p.radiance, p.depth, p.opacity, p.motion) for p in parts), strict=True)
    )
    flows = {o: torch.cat([p.scene_flow[o] for p in parts]) for o in parts[0].scene_flow}
    rgb = [p.rgb for p in parts if p.rgb is not None]
    return Render(radiance, depth, opacity, motion, flows, rgb=torch.cat(rgb) if rgb else None)
