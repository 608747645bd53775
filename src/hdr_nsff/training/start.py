"""The start of a run, from `prepare`: the tone mapper, and brightness and surfaces of
the field.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from hdr_nsff.fields.build import AnyField, initialize_field
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapper, informative

SUBSAMPLING = 4  # pixels: spacing, along x and y, of those that the typical radiance is from
MIN_RADIANCE = 1e-6  # linear HDR, so that its logarithm is finite


def start_run(
    field: AnyField, tonemapper: ToneMapper, scene: Scene, from_priors: bool, with_flow: bool
) -> str | None:
    """Start an untrained tone mapper, and then the field as `start_field` does."""
    tonemapper.start(scene.response)
    tonemapper.start_vignetting(scene)
    return start_field(field, tonemapper, scene, from_priors, with_flow)


def start_field(
    field: AnyField, tonemapper: ToneMapper, scene: Scene, from_priors: bool, with_flow: bool
) -> str | None:
    """Start an untrained field at the typical radiance and, if `from_priors`, at the
    surfaces of the depth prior. A sentence about it, if any.

    An objective without flow (`with_flow`) starts without it too: scene flow is 0 then.
    """
    if not with_flow:
        still = [replace(f, flow={}, flow_valid={}) for f in scene.train]
        scene = replace(scene, train=still)

    def to_radiance(rgb: Tensor, frame: int, pixels: Tensor | None = None) -> Tensor:
        return recorded_radiance(tonemapper, scene, rgb, frame, pixels)

    typical = typical_log_radiance(tonemapper, scene)
    return initialize_field(field, scene, to_radiance, typical, from_priors)


@torch.no_grad()
def recorded_radiance(
    tonemapper: ToneMapper, scene: Scene, rgb: Tensor, frame: int, pixels: Tensor | None = None
) -> Tensor:
    """Radiance (N, 3) that training frame `frame` recorded as `rgb` (N, 3) at `pixels`
    (N, 2), by default all of its picture. What the lens kept back is given back.
    """
    f = scene.train[frame]
    radiance = tonemapper.inverse(rgb, f.bracket, f.camera_id, frame)
    share = tonemapper.shade(torch.ones_like(radiance), f.camera, f.camera_id, pixels)
    return radiance / share


@torch.no_grad()
def typical_log_radiance(tonemapper: ToneMapper, scene: Scene) -> float:
    """Median log radiance of what the frames recorded without clipping."""
    logs = []
    for i, f in enumerate(scene.train):
        step, size = SUBSAMPLING, f.image.shape[:2]
        rgb = f.image[::step, ::step].reshape(-1, 3)
        pixels = f.camera.pixel_grid().view(*size, 2)[::step, ::step].reshape(-1, 2)
        kept = informative(rgb)
        radiance = recorded_radiance(tonemapper, scene, rgb[kept], i, pixels[kept])
        logs.append(radiance.clamp_min(MIN_RADIANCE).log().flatten())
    values = torch.cat(logs)
    return float(values.median()) if len(values) else 0.0
