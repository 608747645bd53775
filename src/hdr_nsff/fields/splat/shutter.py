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
from typing import Literal

import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.cameras import Camera

MAX_RENDERS = 5  # of one blurred frame
BLUR_QUANTILE = 0.98  # of the Gaussians' motion; few move fast


@dataclass(frozen=True)
class Shutter:
    """The shutter of a clip."""

    readout: float = 0.0
    """From the first row to the last, in frames."""
    open: tuple[float, ...] = ()
    """Per training frame, in frames; empty: a moment."""

    def expose(
        self,
        draw: Callable[[Tensor], Sequence[Tensor]],
        camera: Camera,
        means: Tensor,
        motion: Tensor,
        frame: int,
    ) -> list[Tensor]:
        """The mean of what training frame `frame` shows of points that move from
        `means` (G, 3) by `motion` (G, 3) scene units a frame; `draw` gets them as they
        are at one time.
        """
        open_for = self.open[frame] if self.open else 0.0
        rows = row_times(camera, means, self.readout)
        times = open_times(camera, means, motion, open_for)
        total: list[Tensor] = []
        for time in times:
            drawn = list(draw(means + (rows + time)[:, None] * motion))
            total = [a + b for a, b in zip(total, drawn, strict=True)] if total else drawn
        return [map_ / len(times) for map_ in total]


Share = float | Literal["auto"]


@dataclass(frozen=True)
class Timing:
    """What a scene knows of when its T training frames were taken. A frame of the scene
    is one of those used, every `stride`th of the footage.
    """

    interval: float  # seconds from one frame to the next, of those used
    stride: int
    frame_seconds: float | None  # the same of the footage, where a clock shows it
    exposure_times: tuple[float | None, ...]  # (T,) seconds, None where unknown
    exposures: tuple[float, ...]  # (T,) log2, to any reference


def shutter_for(readout_ms: float, share: Share, timing: Timing) -> Shutter | None:
    """The shutter of a clip, None where it changes nothing.

    It is open for a `share` of the time from frame to frame of the footage where it is
    open longest. Other frames follow in proportion to their exposure times, or, where
    these are not known for all frames, to their exposures. "auto": for the exposure
    times; InputError where they or the time from frame to frame are unknown.
    """
    if not readout_ms and not share:
        return None
    shares: tuple[float, ...] = ()
    if share == "auto":
        shares = known_shares(timing)
    elif share:
        shares = tuple(share * time for time in relative_times(timing))
    open_for = tuple(own / timing.stride for own in shares)
    return Shutter(readout_ms * 1e-3 / timing.interval, open_for)


def known_shares(timing: Timing) -> tuple[float, ...]:
    """For which share of the time from frame to frame each frame was exposed."""
    known = [seconds for seconds in timing.exposure_times if seconds is not None]
    advice = "give a share of the time from frame to frame, such as 0.5"
    if len(known) < len(timing.exposure_times):
        raise InputError(f"--shutter auto: the scene has no exposure times of all frames; {advice}")
    if timing.frame_seconds is None:
        raise InputError(
            "--shutter auto: nothing shows the time from frame to frame, neither a video nor "
            f"`timestamp_ns`; {advice}"
        )
    if max(known) > timing.frame_seconds:
        raise InputError(
            f"--shutter auto: a frame was exposed for {max(known):.4g} s, which is longer than the "
            f"{timing.frame_seconds:.4g} s from frame to frame; {advice}"
        )
    return tuple(seconds / timing.frame_seconds for seconds in known)


def relative_times(timing: Timing) -> list[float]:
    """Exposure times (T,) relative to the longest; by exposures where unknown."""
    known = [seconds for seconds in timing.exposure_times if seconds is not None]
    if len(known) < len(timing.exposure_times):
        known = [2.0**ev for ev in timing.exposures]
    return [seconds / max(known) for seconds in known]


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
