"""Rendered radiance as pictures in [0, 1].

Pictures are developed at an EV by a learned camera, or, with no EV asked for,
tone-mapped for a display with one exposure for the whole shot (never per frame: that
would flicker).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from hdr_nsff.core.tensors import to_device
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.maths import color
from hdr_nsff.rendering.stills import device_of, render_still
from hdr_nsff.training.run_folder import Run

PROBE_SCALE = 0.25  # size of the pictures that set the display exposure (hand-chosen: it is fast)


def develop(
    run: Run, radiance: np.ndarray, ev: float | None, camera_id: int, exposure: float
) -> np.ndarray:
    """Radiance (..., 3) as an rgb picture in [0, 1].

    Recorded by a learned camera at `ev`, or (None) tone-mapped for a display
    at `exposure`.
    """
    if ev is None:
        neutral = run.tonemapper.neutral(camera_id).cpu().numpy()
        return color.display(radiance * neutral, exposure)
    values = torch.from_numpy(radiance).to(device_of(run))
    return run.tonemapper.develop(values, ev, camera_id).cpu().numpy()


def develop_view(
    run: Run,
    view: PathView,
    radiance: np.ndarray,
    ev: float | None,
    camera_id: int,
    exposure: float,
) -> np.ndarray:
    """The same for a view of which the run rendered `radiance` (H, W, 3).

    Fields that record before they composite are rendered again.
    """
    if ev is None:
        return develop(run, radiance, ev, camera_id, exposure)
    flat = torch.from_numpy(radiance.reshape(-1, 3)).to(device_of(run))
    camera = to_device(view.camera, device_of(run))
    recorder = run.tonemapper.recorder_at(ev, camera_id)
    picture = record_pixels(run.field, camera, view.time, [recorder], flat)[0]
    return picture.cpu().numpy().reshape(radiance.shape)


def display_exposure(run: Run, views: Sequence[PathView]) -> float:
    """One display exposure for a whole shot.

    It is that of small pictures of its first, middle and last view.
    """
    probes = [views[i] for i in sorted({0, len(views) // 2, len(views) - 1})]
    radiance = []
    for probe in probes:
        still = render_still(run, probe.resized(PROBE_SCALE), "direct", motion=False)
        radiance.append(still.radiance.reshape(-1, 3))
    return color.auto_exposure(np.concatenate(radiance))
