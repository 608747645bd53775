"""What the loop measures of a step: finite terms, the picture's error, frames that are
wrong.
"""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor

from hdr_nsff.fields.base import FrameError, Render
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.scene.scene import Frame
from hdr_nsff.tonemap.base import ToneMapper

ROTATION = 97  # steps after which the same frames are measured again, a prime


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
    rgb = render.rgb
    if rgb is None:
        which = batch.bracket, batch.camera_id, batch.frame
        shaded = tonemapper.shade(render.radiance, batch.camera, batch.camera_id, batch.pixels)
        rgb = tonemapper(shaded, *which, leaky=False)
    return float((rgb.clamp(0, 1) - batch.rgb)[batch.uniform].square().mean())


def spread_frames(count: int, num_frames: int, step: int) -> list[int]:
    """Positions of up to `count` of the frames, evenly spread; others every step."""
    offset = step % ROTATION / ROTATION
    places = [(i + offset) * num_frames / count for i in range(min(count, num_frames))]
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
