"""Small scene files for tests of the viewer."""

from __future__ import annotations

from dataclasses import replace

import torch
from presets import random_field

from hdr_nsff.fields.splat.local_gaussians import LocalGaussians
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig, ToneMapper
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.viewer.field_scene import local_of, scene_of
from hdr_nsff.viewer.scene_file import GaussianGroup, SceneFile


def trained(scene: Scene, preset: str = "splat") -> tuple[Splat, ToneMapper]:
    """A field with content in every part of it, and a tone mapper."""
    field = random_field(preset, scene)
    assert isinstance(field, Splat)
    return field, tone_mapper_for(ToneMapConfig(), scene)


def scene_file(scene: Scene, preset: str = "splat") -> SceneFile:
    """The scene file of that field."""
    return scene_of(*trained(scene, preset), scene, "Toy", display_exposure=1.0)


def trained_local(scene: Scene, count: int = 60, seed: int = 4) -> tuple[Splat, ToneMapper]:
    """The same with time-local Gaussians in front of the cameras, and these alone."""
    field, tonemapper = trained(scene)
    local = LocalGaussians(count)
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: list[float], high: list[float]) -> torch.Tensor:
        span = torch.tensor(high) - torch.tensor(low)
        return torch.tensor(low) + span * torch.rand(count, len(low), generator=draw)

    with torch.no_grad():
        local.means.copy_(uniform([-1.5, -1, 2, 0], [1.5, 1, 4, 4]))
        local.velocities.copy_(uniform([-0.3] * 4, [0.3] * 4))
        local.quaternions.copy_(uniform([-1.0] * 4, [1.0] * 4))
        local.log_scales.copy_(uniform([-3, -3, -3, -0.5], [-1.5, -1.5, -1.5, 1.5]))
        local.colors.copy_(uniform([-2, -2, -2, 0], [2, 2, 2, 4]))
        for gaussians in (field.static, field.moving):
            gaussians.opacity_logits.fill_(-20.0)
        field.opacity_offsets.zero_()
    field.local = local
    return field, tonemapper


def local_gaussians(scene: Scene) -> GaussianGroup:
    """The time-local Gaussians of that field."""
    return local_of(trained_local(scene)[0].local)


def with_gap(scene: Scene) -> Scene:
    """The scene with nine frames missing after the time 2."""
    later = [replace(f, time=f.time + 9 * (f.time > 2)) for f in scene.train]
    return replace(scene, train=later)


def render(
    field: Splat, scene: Scene, frame: int, time: float, size: tuple[int, int]
) -> torch.Tensor:
    """What `render` sees with the camera of a frame at another size (H, W, 3)."""
    camera = scene.train[frame].camera.resized(*size)
    return field.render(camera, time, scene_flow=False).radiance.view(size[1], size[0], 3)
