"""Fields that take part in recording: two published baselines, whose camera acts on
samples (HDR-HexPlane) or inside the network (NeRF-W), and Gaussians, of which a pixel
may average recorded values.

They are handed a `Recorder` from outside. What any other field records follows from its
composited radiance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from torch import Tensor

from hdr_nsff.fields.base import RadianceField
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import Recorder


@runtime_checkable
class RecordingField(RadianceField, Protocol):
    """A field whose recordings do not follow from its composited radiance."""

    def record(self, camera: Camera, time: float, recorders: Sequence[Recorder]) -> list[Tensor]:
        """What each of the `recorders` records (S, 3) in [0, 1] of every pixel, row by
        row, without gradients; chunks itself.
        """
        ...


@runtime_checkable
class LateMixingField(RadianceField, Protocol):
    """A field of which a pixel may average recorded values, besides radiance."""

    def recorded_late(
        self, camera: Camera, time: float, recorders: Sequence[Recorder]
    ) -> list[tuple[Tensor, Tensor]]:
        """For each of the `recorders` the averages (S, 3) in [0, 1] of what it records,
        row by row, and their shares (S, 1) in the pixels, without gradients; nothing
        where all is averaged before.
        """
        ...
