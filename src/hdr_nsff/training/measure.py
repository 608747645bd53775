"""What the loop measures of a step: finite terms, the picture's error, frames that are
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from hdr_nsff.fields.base import FrameError, Render
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.scene.scene import Frame
from hdr_nsff.tonemap.base import ToneMapper

LOG_EVERY = 25  # steps from one line of the log to the next
ROTATION = 97  # steps after which the same frames are measured again, a prime


class Monitor:
    """Reads the terms of the steps for the log, and notices those that are not finite.

    To read a number of a GPU, the host waits for it. There, terms are read every
    `LOG_EVERY` steps and where a line of the log is due; on the CPU, at every step.
    """

    def __init__(self, tonemapper: ToneMapper, device: torch.device) -> None:
        self.tonemapper = tonemapper
        self.read_every = 1 if device.type == "cpu" else LOG_EVERY  # steps
        self.latest: dict[str, Tensor] = {}  # the last batch's terms

    def measure(
        self, step: int, terms: dict[str, Tensor], render: Render, batch: PixelBatch
    ) -> dict[str, float]:
        """The terms of a batch as numbers, none where this step is not read.

        `mse`, the picture's mean square error, is added where a line of the log is due.
        """
        self.latest = {name: value.detach() for name, value in terms.items()}
        log_due = (step + 1) % LOG_EVERY == 0
        if not log_due and step % self.read_every != 0:
            return {}
        values = self.read()
        check_finite(values, step, batch, render.radiance)
        if log_due:
            values["mse"] = squared_error(render, batch, self.tonemapper)
        return values

    def read(self) -> dict[str, float]:
        """The last batch's terms as numbers; the host waits once for all of them."""
        if not self.latest:
            return {}
        values = torch.stack(list(self.latest.values())).tolist()
        return dict(zip(self.latest, values, strict=True))

    def check_latest(self, step: int) -> None:
        """FloatingPointError where a term of the last batch is NaN or infinite."""
        wrong = [name for name, value in self.read().items() if not math.isfinite(value)]
        if wrong:
            raise FloatingPointError(f"step {step}: {', '.join(wrong)} not finite")


def averaged(measured: Sequence[dict[str, float]]) -> dict[str, float]:
    """What was `measured` of a step's batches, averaged, and `psnr` in place of `mse`.

    A term that a batch lacks counts as 0 there.
    """
    means: dict[str, float] = {}
    for values in measured:
        for name, value in values.items():
            means[name] = means.get(name, 0.0) + value / len(measured)
    if "mse" in means:
        means["psnr"] = -10 * math.log10(max(means.pop("mse"), 1e-10))
    return means


def check_finite(values: dict[str, float], step: int, batch: PixelBatch, radiance: Tensor) -> None:
    """FloatingPointError with step, term and ray where a term is NaN or infinite."""
    bad = [name for name, value in values.items() if not math.isfinite(value)]
    if not bad:
        return
    rays = (~torch.isfinite(radiance).all(-1)).nonzero()[:, 0]
    where = f"frame {batch.frame}, all radiance finite"
    if len(rays):
        where = f"pixel {batch.pixels[rays[0]].tolist()} of frame {batch.frame}"
    raise FloatingPointError(f"step {step}: the terms {bad} are not finite; {where}")


@torch.no_grad()
def squared_error(render: Render, batch: PixelBatch, tonemapper: ToneMapper) -> float:
    """Mean square difference of rendered and recorded rgb at uniformly drawn pixels."""
    rgb = tonemapper.record_render(render, batch, leaky=False)
    return float((rgb.clamp(0, 1) - batch.rgb)[batch.uniform].square().mean())


def spread_frames(count: int, num_frames: int, step: int) -> list[int]:
    """Positions of up to `count` of the frames, evenly spread; others every step."""
    count = min(count, num_frames)
    offset = step % ROTATION / ROTATION
    places = [(i + offset) * num_frames / count for i in range(count)]
    return sorted({int(place) % num_frames for place in places})


def frame_error(tonemapper: ToneMapper, frame: Frame, position: int) -> FrameError:
    """How wrong pictures of a training frame at `position` are."""
    return FrameError(frame.camera, frame.time, partial(rgb_error, tonemapper, frame, position))


@torch.no_grad()
def rgb_error(tonemapper: ToneMapper, frame: Frame, position: int, radiance: Tensor) -> Tensor:
    """Mean absolute difference (S,) of a training frame's rgb and that of `radiance`.

    `radiance` (S, 3) is recorded as the frame's camera would have recorded it.
    """
    shaded = tonemapper.shade(radiance, frame.camera, frame.camera_id)
    rgb = tonemapper(shaded, frame.bracket, frame.camera_id, position, leaky=False)
    return (rgb - frame.image.flatten(0, 1)).abs().mean(-1)
