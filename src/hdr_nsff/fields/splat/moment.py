"""What kernels make of a training moment: the Gaussians as the rasterizer takes them,
and the field's own terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from hdr_nsff.fields.kernels.moment import NUMBERS
from hdr_nsff.fields.knots import cubic_weights, linear_position
from hdr_nsff.fields.splat.local_gaussians import least_duration
from hdr_nsff.fields.splat.model import Model
from hdr_nsff.fields.splat.terms import COLOR_OFFSET_SHARE, MIN_OPACITY
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.pinhole import MIN_DEPTH

TERM_NAMES = (
    "opacity",
    "scale",
    "trajectory",
    "brightness_drift",
    "opacity_offsets",
    "color_change",
    "rigidity",
    "evenness",
)
MAX_FLOW = 2.0  # picture widths: keeps the flow of Gaussians near the camera finite
EVERY_STEP = 6  # of the terms: rigidity and evenness take turns with flow


@dataclass(frozen=True)
class Moment:
    """When and from where Gaussians are seen, and the frame that their flow goes to."""

    knot: float
    time: float  # in frames
    share: float  # of the clip, in [0, 1]
    camera: Camera
    # knot, time and camera of the neighbor; without one there is no flow
    neighbor: tuple[float, float, Camera] | None
    rigidity: bool  # whether rigidity and evenness are due

    def numbers(self, model: Model) -> tuple[float, ...]:
        """What the kernels take of the time, in the order of `kernels/moment.py`."""
        t, share = model.trajectories, self.share
        knot, time, _ = self.neighbor or (self.knot, self.time, None)
        static, moving = model.static, model.moving
        tables = static.log_radiance_offsets, moving.log_radiance_offsets, model.opacity_offsets
        places = [linear_position(len(v), share * (len(v) - 1)) for v in tables]
        numbers = (
            *knot_weights(t.times, self.knot),
            *knot_weights(t.times, knot),
            self.time,
            time,
            *(number for place in places for number in place),
            model.unit,
            MIN_DEPTH,
            MAX_FLOW * self.camera.width,
            float(static.bounded),
            float(self.rigidity),
            MIN_OPACITY,
            *t.window(self.knot),
            COLOR_OFFSET_SHARE,
            least_duration(model.times),
            *t.window_differences(self.knot),
        )
        numbers += (0.0,) * (NUMBERS - len(numbers))  # near the ends there are fewer
        assert len(numbers) == NUMBERS, len(numbers)
        return numbers


def knot_weights(times: Sequence[float], knot: float) -> list[float]:
    """The first of four rows that a knot is interpolated from, and their weights."""
    first, weights = cubic_weights(times, knot)
    return [first, *weights, *[0.0] * (4 - len(weights))]


@dataclass(frozen=True)
class Cloud:
    """The Gaussians of a moment, as `rasterize` takes them."""

    means: Tensor  # (G, 3) scene units
    quaternions: Tensor  # (G, 4)
    scales: Tensor  # (G, 3)
    opacities: Tensor  # (G,)
    features: Tensor  # (G, 4 or 6): radiance, motion, flow in pixels to the neighbor
    terms: dict[str, Tensor]  # the field's own, by the names of their weights


def split_parameters(
    learned: list[Tensor],
) -> tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor]]:
    """`Model.parameters` of static and moving Gaussians, of the shared motions, and of
    time-local ones.
    """
    return learned[:6], learned[6:14], learned[14:16], learned[16:]
