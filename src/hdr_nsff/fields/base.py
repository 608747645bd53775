"""What every radiance field answers: what does this camera see, at this time, at these
pixels, in linear HDR radiance. Everything that training asks of a field stands here.

Fields know nothing of exposure, white balance or response curves: tone mapping happens
outside. `S` is the number of pixels asked for. A field is given pixels, not rays: an
NSFF casts rays through them, a splat field rasterizes the frame and reads them off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from torch import Tensor

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch


@dataclass(frozen=True)
class Warp:
    """The same pixels rendered through the content of a neighboring frame (eq. 2-3)."""

    offset: int  # which neighbor: -1, +1, and -2, +2 for the two-step chain
    flow: Tensor  # (S, 2) px: where the content goes in the neighbor's camera, minus here
    confidence: Tensor  # (S,) in [0, 1]: 1 - rendered disocclusion
    radiance: Tensor | None  # (S, 3) linear HDR, None where the field warps no radiance


@dataclass(frozen=True)
class Render:
    """What a field saw at S pixels."""

    radiance: Tensor  # (S, 3) linear HDR, >= 0
    depth: Tensor  # (S,) z-depth, scene units
    opacity: Tensor  # (S,) in [0, 1]
    motion: Tensor  # (S,) in [0, 1]: share of dynamic content
    # {+-1: (S, 3)} scene units to the next / previous training time
    scene_flow: dict[int, Tensor] = field(default_factory=dict)
    warps: tuple[Warp, ...] = ()  # while training
    dynamic_radiance: Tensor | None = None  # (S, 3) the dynamic branch alone, in training
    dynamic_depth: Tensor | None = None  # (S,) z-depth of the dynamic branch, in training
    rgb: Tensor | None = None  # (S, 3) already recorded, of a field that composites rgb
    # (S, 3) averages of recorded values, and their shares (S, 1) in what the pixels
    # record, in training
    late: Tensor | None = None
    late_share: Tensor | None = None


@dataclass(frozen=True)
class FrameError:
    """How wrong a picture of one training frame is."""

    camera: Camera
    time: float  # in frames
    # radiance (S, 3) of its picture to (S,) mean absolute difference of recorded values
    error: Callable[[Tensor], Tensor]


@runtime_checkable
class RadianceField(Protocol):
    """A dynamic scene in linear HDR radiance: a `torch.nn.Module` with these methods.
    Nothing registers: `build_field` chooses by type.
    """

    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        """Render all pixels, row by row, or the given `pixels` (S, 2); no gradients.

        `time` is in frames and may be fractional. It is faster without `scene_flow`.
        """
        ...

    def __call__(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A training render with warps, and the field's own terms by name."""
        ...

    def loss_weights(self) -> dict[str, float]:
        """Weights of all terms that only this field makes possible, by name."""
        ...

    def param_groups(self) -> list[ParamGroup]:
        """Parameters with their learning rates."""
        ...

    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> bool:
        """Housekeeping between optimizer steps (culling grids, relocation).

        `frame_errors(n)` measures how wrong the pictures of n training frames are; None
        late in a run, when nothing is to be rearranged any more. Returns whether
        parameters were rearranged by what was measured, which may differ between
        processes: the first one's are then everyone's.
        """
        ...

    def shared_maxima(self) -> list[Tensor]:
        """Buffers of which several processes must all hold the maximum."""
        ...
