"""The one place that knows which radiance fields there are."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, assert_never

import torch
from pydantic import Discriminator

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.fields.baselines.hexplane import HexPlane, HexPlaneConfig
from hdr_nsff.fields.baselines.nerf_wt import NerfWT, NerfWTConfig
from hdr_nsff.fields.nsff.initialize_grid import initialize_grid
from hdr_nsff.fields.nsff.nsff import NSFF, NSFFConfig
from hdr_nsff.fields.point_cloud import ToRadiance
from hdr_nsff.fields.space import build_space
from hdr_nsff.fields.splat import cuda_backends
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.initialize_gaussians import initialize_gaussians
from hdr_nsff.fields.splat.initialize_local import count_local_pixels, limit_rigid_movers
from hdr_nsff.fields.splat.shutter import Shutter, Timing, shutter_for
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.scene import Scene

FieldConfig = Annotated[
    NSFFConfig | NerfWTConfig | HexPlaneConfig | SplatConfig, Discriminator("type")
]
AnyField = NSFF | NerfWT | HexPlane | Splat


def device_for(config: FieldConfig, name: str) -> torch.device:
    """The device of a `--device` flag for this field. Gaussians use CUDA only where
    a rasterizer has drawn one there: `auto` takes the CPU instead and says so, `cuda`
    is an InputError.
    """
    device = pick_device(name)
    if device.type != "cuda" or not isinstance(config, SplatConfig):
        return device
    reason = cuda_backends.fault(str(device))
    if reason is None:
        return device
    if name == "auto":
        say(f"--device auto: using the CPU although there is a CUDA device: {reason}")
        return torch.device("cpu")
    raise InputError(f"--device {name}: {reason}, or use --device cpu")


def check_scene(config: FieldConfig, scene: Scene) -> None:
    """InputError where a field needs to know more of a scene than this one says."""
    if isinstance(config, SplatConfig):
        scene_shutter(config, scene)


def build_field(config: FieldConfig, scene: Scene) -> AnyField:
    """An untrained field for a scene."""
    m, near, far = scene.manifest, scene.near, scene.far
    if isinstance(config, SplatConfig):
        local_pixels = count_local_pixels(limit_rigid_movers(scene, config.bases))
        if config.moving is None and not any(mover.rigid for mover in scene.movers):
            config = replace(config, moving=0)  # there is nothing for them to draw
        shutter = scene_shutter(config, scene)
        num_pixels = m.width * m.height
        return Splat(config, scene.times, near, far, num_pixels, local_pixels, shutter)
    space = build_space([f.camera for f in scene.train], near, far)
    match config:
        case NSFFConfig():
            field: NSFF | NerfWT = NSFF(config, space, scene.times, near, far, m.width, m.height)
        case NerfWTConfig():
            reference = tuple(
                i for i, f in enumerate(scene.train) if f.bracket == m.reference_bracket
            )
            everyone = tuple(range(len(scene.train)))
            size = (m.width, m.height)
            field = NerfWT(
                config, space, scene.times, near, far, size, len(everyone), reference or everyone
            )
        case HexPlaneConfig():
            return HexPlane(config, space, scene.times, near, far)
        case _:
            assert_never(config)
    field.allow_motion(scene.train)
    return field


def scene_shutter(config: SplatConfig, scene: Scene) -> Shutter | None:
    """The shutter of a scene's clip; InputError as of `shutter_for`."""
    readout = scene.manifest.readout if config.readout is None else config.readout
    return shutter_for(readout, config.shutter, timing_of(scene))


def timing_of(scene: Scene) -> Timing:
    """When the training frames of a scene were taken, and for how long."""
    m = scene.manifest
    seconds = {entry.index: entry.exposure_time for entry in m.frames}
    return Timing(
        interval=m.frame_interval,
        stride=m.stride,
        frame_seconds=m.frame_seconds,
        exposure_times=tuple(seconds.get(f.index) for f in scene.train),
        exposures=tuple(float(scene.response.ev[f.bracket]) + f.drift for f in scene.train),
    )


def initialize_field(
    field: AnyField, scene: Scene, to_radiance: ToRadiance, typical: float, from_priors: bool
) -> str | None:
    """Start an untrained field at the `typical` log radiance and, if `from_priors`, at
    the surfaces of the depth prior, in the colors that `to_radiance(rgb (P, 3), i)`
    recovers from training frame i. A sentence about it, if any.
    """
    match field:
        case NSFF() | NerfWT():
            field.bias.fill_(typical)
            in_scene_units = scene.manifest.depth_kind == "scene"
            usable = from_priors and in_scene_units
            initialized = usable and initialize_grid(field, scene.train, to_radiance)
            return "field: initialized from the depth prior" if initialized else None
        case HexPlane():
            field.bias.fill_(typical)
            return None
        case Splat():
            return "field: " + initialize_gaussians(field, scene, to_radiance, typical, from_priors)
        case _:
            assert_never(field)
