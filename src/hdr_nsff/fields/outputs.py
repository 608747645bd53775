"""What is read from a field besides whole renders: recordings, layers, Gaussians, and
some pixels of a render.

Every field can be recorded. Layers serve interpolation in
time, Gaussians the export; a field that has them offers a method of that name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from hdr_nsff.core.tensors import tree_map
from hdr_nsff.fields.base import RadianceField, Render
from hdr_nsff.fields.recording_field import LateMixingField, RecordingField
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import Recorder


@dataclass(frozen=True)
class Layers:
    """A view as L translucent layers, front to back.

    A layer holds one kind of content: a field with two branches interleaves them
    (static, dynamic, static, ...).
    """

    positions: Tensor  # (S, L, 3) scene units; S = height * width, row by row
    alpha: Tensor  # (S, L) in [0, 1]
    radiance: Tensor  # (S, L, 3) linear HDR
    # {+-1: (S, L, 3)} scene units to the next / previous training time, 0 where static
    scene_flow: dict[int, Tensor]
    motion: Tensor  # (S, L) in [0, 1]: share of dynamic content


@dataclass(frozen=True)
class GaussianCloud:
    """G Gaussians at one time."""

    means: Tensor  # (G, 3) scene units
    quaternions: Tensor  # (G, 4) w x y z of any length
    scales: Tensor  # (G, 3) standard deviations, scene units
    opacities: Tensor  # (G,) in [0, 1]
    radiance: Tensor  # (G, 3) linear HDR, >= 0
    motion: Tensor  # (G,) in [0, 1]: share of dynamic content


def record_pixels(
    field: RadianceField,
    camera: Camera,
    time: float,
    recorders: Sequence[Recorder],
    radiance: Tensor | None = None,
) -> list[Tensor]:
    """What each of the `recorders` records of all pixels, row by row: (S, 3) in [0, 1].

    `radiance` (S, 3) is what the field has rendered there, if it has. A pixel averages
    recorded values too, where the field says so.
    """
    if isinstance(field, RecordingField):
        return field.record(camera, time, recorders)
    if radiance is None:
        radiance = field.render(camera, time, scene_flow=False).radiance
    pictures = [record_light(recorder, camera, radiance) for recorder in recorders]
    if not isinstance(field, LateMixingField):
        return pictures
    late = field.recorded_late(camera, time, recorders)
    if not late:
        return pictures
    return [rgb.lerp(*other) for rgb, other in zip(pictures, late, strict=True)]


def record_light(recorder: Recorder, camera: Camera, radiance: Tensor) -> Tensor:
    """What is recorded (S, 3) of all pixels' `radiance` (S, 3), row by row."""
    if recorder.shade is not None:
        radiance = recorder.shade(radiance, camera, camera.pixel_grid())
    return recorder.rgb(radiance)


def select_pixels(render: Render, camera: Camera, pixels: Tensor) -> Render:
    """The render of a whole frame at `pixels` (S, 2) alone.

    The whole frame in order is returned as it is.
    """
    index = pixels[:, 1].long() * camera.width + pixels[:, 0].long()
    whole = len(index) == camera.width * camera.height
    if whole and bool((index.diff() == 1).all()):
        return render
    return tree_map(lambda values: values[index], render)
