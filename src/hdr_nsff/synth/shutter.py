"""What a shutter lets a path-traced frame see: rows one after another, and the mean of
the moments at which it is open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.synth.pathtracer import Tracer
from hdr_nsff.synth.scenes.base import SynthScene, Views
from hdr_nsff.synth.views import TracedView

BANDS = 12  # groups of rows that are traced at one time
MOMENTS = 8  # traced while the shutter is open, with a share of the paths each


@dataclass(frozen=True)
class Exposure:
    """The shutter of one frame, in frames of time."""

    readout: float  # from the first row to the last
    open: float


def exposures(
    readout_ms: float, share: float, evs: list[float], fps: float
) -> list[Exposure] | None:
    """Per bracket of exposures `evs` (log2) of a clip of `fps` frames a second; None
    where every frame is a moment. The shutter is open for a `share` of a frame's time
    at the brightest.
    """
    if not readout_ms and not share:
        return None
    readout = readout_ms * 1e-3 * fps
    return [Exposure(readout, share * 2.0 ** (ev - max(evs))) for ev in evs]


def trace_exposure(
    tracer: Tracer,
    scene: SynthScene,
    view: TracedView,
    K: np.ndarray,
    size: tuple[int, int],
    views: Views,
    exposure: Exposure,
) -> np.ndarray:
    """Linear radiance (H, W, 3), averaged over what the shutter lets each row see. The
    cameras of a rig stand still meanwhile.
    """
    height = size[1]
    bands = BANDS if exposure.readout else 1
    moments = MOMENTS if exposure.open else 1
    spp = max(1, round(view.spp / moments))
    picture = np.zeros((height, size[0], 3), np.float32)
    for band in range(bands):
        rows = round(band * height / bands), round((band + 1) * height / bands)
        row_time = exposure.readout * ((band + 0.5) / bands - 0.5)
        for moment in range(moments):
            time = view.time + row_time + exposure.open * ((moment + 0.5) / moments - 0.5)
            pose = view.c2w if views == "rig" else scene.pose(views, time)
            seed = view.seed + moment * 100_003
            traced = tracer.radiance(time, K, pose, size, spp, seed, rows)
            picture[slice(*rows)] += traced / moments
    return picture
