"""The start of a tone mapper: the response that `prepare` estimated for the scene."""

from __future__ import annotations

import torch

from hdr_nsff.radiometry.response import Response
from hdr_nsff.tonemap.tonemapper import ToneMapper


def initialize(tonemapper: ToneMapper, response: Response) -> None:
    """Start curves, unknown exposures and white balance of `tonemapper` from `response`.

    A tone mapper `per_image` with `from_recordings` off stays at its published start:
    gamma 2.2 and gains of 1. What static points determined for a single camera is
    anchored at once: a field that is still coarse would only bend it.
    """
    kind = tonemapper.config.kind
    if kind == "per_image" and not tonemapper.config.from_recordings:
        return
    tonemapper.set_exposures(response.ev.tolist())
    if response.source != "static points":
        return
    x, y = torch.from_numpy(response.x), torch.from_numpy(response.y)
    if kind == "shared":
        for camera in range(tonemapper.num_cameras):
            tonemapper.set_curve(x, y[camera], camera)
        tonemapper.set_white_balance(torch.from_numpy(response.white_balance))
        if tonemapper.num_cameras == 1:  # more cameras: white balance is refined first
            tonemapper.anchor()
    elif kind in ("per_image", "mlp"):
        tonemapper.set_curve(x, y.mean(0))
