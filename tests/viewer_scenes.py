"""Small scene files for tests of the viewer."""

from __future__ import annotations

import numpy as np
import torch
from presets import random_field

from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig, ToneMapper
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.viewer.field_scene import local_group, scene_of
from hdr_nsff.viewer.scene_file import GaussianGroup, SceneFile


def trained(scene: Scene, preset: str = "splat") -> tuple[Splat, ToneMapper]:
    """A field with content in every part of it, and a tone mapper."""
    field = random_field(preset, scene)
    assert isinstance(field, Splat)
    return field, tone_mapper_for(ToneMapConfig(), scene)


def scene_file(scene: Scene, preset: str = "splat") -> SceneFile:
    """The scene file of that field."""
    return scene_of(*trained(scene, preset), scene, "Toy", display_exposure=1.0)


def local_gaussians(count: int = 60, seed: int = 4) -> GaussianGroup:
    """Time-local Gaussians in front of the toy scene's cameras."""
    draw = np.random.default_rng(seed)
    return local_group(
        means=draw.uniform([-1.5, -1, 2], [1.5, 1, 4], (count, 3)),
        velocities=draw.normal(0, 0.2, (count, 3)),
        quaternions=draw.normal(size=(count, 4)),
        log_scales=draw.uniform(-3, -1.5, (count, 3)),
        opacity_logits=draw.uniform(0, 4, count),
        log_radiance=draw.normal(0, 1.5, (count, 3)),
        centers=draw.uniform(0, 4, count),
        log_durations=draw.uniform(-0.5, 1.5, count),
    )


def render(
    field: Splat, scene: Scene, frame: int, time: float, size: tuple[int, int]
) -> torch.Tensor:
    """What `render` sees with the camera of a frame at another size (H, W, 3)."""
    camera = scene.train[frame].camera.resized(*size)
    return field.render(camera, time, scene_flow=False).radiance.view(size[1], size[0], 3)
