"""The settings of a field of 4D Gaussians, and how many Gaussians it has."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Le
from tyro.conf import arg

from hdr_nsff.core.settings import Advanced, Count, Number, Rate, Share, Weight

# default number of Gaussians, per pixel of a frame and at most (hand-chosen on rendered
# scenes, for minutes of training on a CPU)
STATIC_PER_PIXEL, MAX_STATIC = 0.55, 80_000
MOVING_PER_PIXEL, MAX_MOVING = 0.15, 20_000
# default number of time-local Gaussians, per pixel of their masks in all frames; at
# most, per frame by its pixels and in all (8 times as many are alive at a time), and in
# the clip (hand-chosen on real clips with people)
LOCAL_PER_PIXEL = 0.5
LOCAL_PER_FRAME_PIXEL, MAX_LOCAL_PER_FRAME = 0.03, 8_000
MAX_LOCAL = 400_000


@dataclass(frozen=True)
class SplatLosses:
    """Weights of the field's own terms; 0 turns one off."""

    opacity: Weight = 0.01
    """Mean opacity: what is not needed fades and is used elsewhere."""
    scale: Weight = 0.01
    """Mean scale, in units of the near depth."""
    trajectory: Weight = 30.0
    """Third differences of the shared motions, in units of the near depth."""
    brightness_drift: Weight = 0.01
    """Changes of static Gaussians' log radiance in time."""
    opacity_offsets: Weight = 1e-3
    """Changes of moving Gaussians' opacity from one knot to the next."""
    color_change: Weight = 0.01
    """Changes of moving Gaussians' log radiance from one knot to the next."""
    evenness: Weight = 1.0
    """Differences in velocity of neighboring time-local Gaussians."""
    rigidity: Weight = 2.0
    """Differences in how neighboring moving Gaussians mix the shared motions."""
    sh1: Weight = 0.01
    """Changes of log radiance with the direction of view."""


@dataclass(frozen=True)
class SplatConfig:
    """A field of 4D Gaussians."""

    type: Advanced[Literal["splat"]] = "splat"
    loss: Advanced[SplatLosses] = field(default_factory=SplatLosses)
    static: Annotated[int, Ge(1), Le(10**8)] | None = None
    """Static Gaussians; default: 0.55 for every pixel of a frame, at most 80,000."""
    moving: Annotated[int, Ge(0), Le(10**8)] | None = None
    """Moving Gaussians, for rigid movers; default: 0.15 for every pixel of a frame, or
    none.
    """
    local: Annotated[int, Ge(0), Le(10**8)] | None = None
    """Time-local Gaussians, for movers that are not rigid; default: one for every two
    of their pixels in all frames, at most 0.03 for every pixel of all frames, 8,000 a
    frame and 400,000.
    """
    bases: Count = 6
    """Shared rigid motions that the moving ones mix."""
    color_knots: Advanced[Count] = 7
    """Times at which a moving Gaussian has a color of its own."""
    brightness_knots: Advanced[Count] = 5
    """Times at which a static Gaussian has a brightness of its own (1: none)."""
    opacity_knots: Advanced[Count] = 13
    """Times at which a moving Gaussian has an opacity of its own, to appear and vanish.
    """
    view_dependence: bool = False
    """Let colors change with the direction of view, for shiny objects."""
    late_mixing: Advanced[bool] = True
    """Learn which share of a pixel's averaging comes after the recording, as in footage
    that was shrunk.
    """
    radiance: Advanced[Literal["exp", "sigmoid"]] = "exp"
    """Unbounded radiance, or one below 1."""
    readout: Annotated[float | None, Ge(0), Le(1000), arg(aliases=("--readout",))] = None
    """Milliseconds from a rolling shutter's first row to its last. Default: those
    of the scene, by `prepare --readout`, else 0.
    """
    shutter: Annotated[Share | Literal["auto"], arg(aliases=("--shutter",))] = 0.0
    """Motion blur: share of the time from frame to frame of the clip for which the
    longest exposure takes light; auto: as the exposure times say, where a list, EXIF or
    a GoPro has them.
    """
    relocate_every: Advanced[Number] = 200
    """Steps after which unseen Gaussians are moved to where the picture is wrong (0:
    never).
    """
    lr: Advanced[Rate] = 1.0
    """Multiplies all learning rates below."""
    position_lr: Advanced[Rate] = 2e-3
    """Learning rate of positions, per typical length of the scene (its near depth)."""
    pose_lr: Advanced[Rate] = 2e-3
    """Learning rate of the shared motions, their shifts per typical length."""
    color_lr: Advanced[Rate] = 2e-2
    """Learning rate of colors and of the mixtures of motions."""
    shape_lr: Advanced[Rate] = 2e-2
    """Learning rate of orientations and log scales."""
    opacity_lr: Advanced[Rate] = 5e-2
    """Learning rate of opacities."""
    late_mixing_lr: Advanced[Rate] = 5e-3
    """Learning rate of the share that is averaged late."""

    def counts(self, num_pixels: int, local_pixels: int, num_frames: int) -> tuple[int, int, int]:
        """How many static, moving and time-local Gaussians.

        For frames of `num_pixels`, and `local_pixels` of non-rigid movers in all
        `num_frames` of them.
        """
        static, moving, local = self.static, self.moving, self.local
        if static is None:
            static = min(round(STATIC_PER_PIXEL * num_pixels), MAX_STATIC)
        if moving is None:
            moving = min(round(MOVING_PER_PIXEL * num_pixels), MAX_MOVING)
        if local is None:
            per_frame = min(LOCAL_PER_FRAME_PIXEL * num_pixels, MAX_LOCAL_PER_FRAME)
            at_most = min(round(per_frame * num_frames), MAX_LOCAL)
            local = min(round(LOCAL_PER_PIXEL * local_pixels), at_most)
        return static, moving, local
