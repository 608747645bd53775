"""When the pixels of a training frame see the scene: row by row (a rolling shutter),
and for as long as the shutter is open (motion blur).

Within a frame everything moves in a straight line, as seen by the camera: its own
motion and that of the Gaussians together. A row is read `readout` frames after the
first one, at most; a Gaussian is drawn where it is when the row of its center is read.
Blur is the mean of several renders at times at which the shutter is open; radiance is
averaged, before the response. A field so trained is sharp, and at each of its times all
rows are of that time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hdr_nsff.geometry.cameras import Camera

MAX_RENDERS = 5  # of one blurred frame
BLUR_QUANTILE = 0.98  # of the Gaussians' motion; few move fast


@dataclass(frozen=True)
class Shutter:
    """The shutter of a clip."""

    readout: float = 0.0
    """From the first row to the last, in frames."""
    open: tuple[float, ...] = ()
    """Per bracket, in frames; empty: a moment."""

    def expose(
        self,
        draw: Callable[[Tensor], Sequence[Tensor]],
        camera: Camera,
        means: Tensor,
        motion: Tensor,
        bracket: int,
    ) -> list[Tensor]:
        """The mean of what is drawn of points that move from `means` (G, 3) by `motion`
        (G, 3) scene units a frame; `draw` gets them as they are at one time.
        """
        open_for = self.open[bracket] if self.open else 0.0
        rows = row_times(camera, means, self.readout)
        times = open_times(camera, means, motion, open_for)
        total: list[Tensor] = []
        for time in times:
            drawn = list(draw(means + (rows + time)[:, None] * motion))
            total = [a + b for a, b in zip(total, drawn, strict=True)] if total else drawn
        return [map_ / len(times) for map_ in total]


def shutter_for(readout_ms: float, share: float, fps: float, ev: list[float]) -> Shutter | None:
    """The shutter of a clip of `fps` frames a second, None where it changes nothing.

    It is open for a `share` of the frames' interval at the brightest of the exposures
    `ev` (log2), and for less at the others in proportion.
    """
    if not readout_ms and not share:
        return None
    brightest = max(ev)
    times = tuple(share * 2.0 ** (e - brightest) for e in ev) if share else ()
    return Shutter(readout_ms * 1e-3 * fps, times)


@torch.no_grad()
def apparent_motion(
    camera: Camera, neighbors: list[tuple[Camera, Tensor, float]], means: Tensor, time: float
) -> Tensor:
    """How `means` (G, 3) move as `camera` sees them at `time`, (G, 3) scene units
    a frame: the motion of the camera counts as theirs.

    `neighbors`: the camera at other times, with the points (G, 3) and the time, in
    frames, earlier ones first; with one of them the motion is one-sided.
    """
    seen = [
        (other.to_camera(points) @ camera.c2w[:, :3].T + camera.c2w[:, 3], at)
        for other, points, at in neighbors
    ]
    if len(seen) == 1:
        seen.append((means, time))
    (first, start), (last, end) = seen[0], seen[-1]
    return (last - first) / (end - start)


@torch.no_grad()
def row_times(camera: Camera, means: Tensor, readout: float) -> Tensor:
    """When the rows of `means` (G, 3) are read, (G,) frames after the middle row."""
    rows = camera.project(means)[0][:, 1] / camera.height
    return readout * (rows.clamp(0, 1) - 0.5)


@torch.no_grad()
def open_times(camera: Camera, means: Tensor, motion: Tensor, open_for: float) -> list[float]:
    """Times at which to render a frame, in frames from its middle: as many as pixels
    that the fastest of `means` (G, 3) cross at their `motion` (G, 3) while the shutter
    is open, at most `MAX_RENDERS`.
    """
    if not open_for:
        return [0.0]
    here, depth = camera.project(means)
    there = camera.project(means + open_for * motion)[0]
    pixels = (there - here).norm(dim=1)[depth > 0]
    blur = float(torch.quantile(pixels[:: 1 + len(pixels) // 10_000], BLUR_QUANTILE))
    count = min(max(math.ceil(blur), 1), MAX_RENDERS)
    return [open_for * ((k + 0.5) / count - 0.5) for k in range(count)]
