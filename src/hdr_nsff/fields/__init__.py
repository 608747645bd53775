"""Radiance fields behind one interface (`base.RadianceField`); here is the one place that knows which there are."""

from __future__ import annotations

from typing import assert_never

from hdr_nsff.fields.nsff import NSFF, NSFFConfig
from hdr_nsff.fields.painting import paint
from hdr_nsff.fields.seeding import seed
from hdr_nsff.fields.space import build_space
from hdr_nsff.fields.splat import Splat, SplatConfig
from hdr_nsff.fields.surface import ToRadiance
from hdr_nsff.scene import Scene

FieldConfig = NSFFConfig | SplatConfig


def build_field(config: FieldConfig, scene: Scene) -> NSFF | Splat:
    """An untrained field for a scene."""
    match config:
        case NSFFConfig():
            m = scene.manifest
            space = build_space([f.camera for f in scene.train], scene.near, scene.far)
            field = NSFF(config, space, scene.times, scene.near, scene.far, m.width, m.height)
            field.allow_motion(scene.train)
            return field
        case SplatConfig():
            return Splat(config, scene.times, scene.near, scene.far, scene.manifest.width * scene.manifest.height)
        case _:
            assert_never(config)


def start_field(field: NSFF | Splat, scene: Scene, to_radiance: ToRadiance, typical: float, from_priors: bool) -> str | None:
    """Give an untrained field what the scene tells before training: `typical` log radiance and, if `from_priors`, the surfaces of
    the depth prior in the colours that `to_radiance(rgb (P, 3), i)` recovers from training frame i. A sentence about it, if any."""
    match field:
        case NSFF():
            field.bias.fill_(typical)
            painted = from_priors and paint(field, scene.train, to_radiance)
            return "field: painted from the depth prior" if painted else None
        case Splat():
            return "field: " + seed(field, scene, to_radiance, typical, from_priors)
        case _:
            assert_never(field)
