"""Radiance fields behind one interface (`base.RadianceField`); `build_field` is the one place that knows which there are."""

from __future__ import annotations

from hdr_nsff.fields.nsff import NSFF, NSFFConfig
from hdr_nsff.fields.space import build_space
from hdr_nsff.scene import Scene

FieldConfig = NSFFConfig


def build_field(config: FieldConfig, scene: Scene) -> NSFF:
    """An untrained field for a scene."""
    cameras = [f.camera for f in scene.train]
    m = scene.manifest
    space = build_space(cameras, scene.near, scene.far)
    field = NSFF(config, space, scene.times, scene.near, scene.far, m.width, m.height)
    field.allow_motion(scene.train)
    return field
