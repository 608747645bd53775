"""A rendered view as a page asks for it: a map in colors, or developed radiance."""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import colorize
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.develop import develop_view
from hdr_nsff.rendering.stills import Still
from hdr_nsff.training.run_folder import Run
from hdr_nsff.viewer import display
from hdr_nsff.viewer.server import FrameRequest


def served_picture(run: Run, request: FrameRequest, view: PathView, still: Still) -> np.ndarray:
    """What a request shows of a rendered view: rgb (H, W, 3) in [0, 1].

    InputError for scene flow where the field has none.
    """
    near, far = run.scene.near, run.scene.far
    match request.show:
        case "depth":
            disparity = 1 / np.clip(still.depth, near, far)
            return colorize(disparity, 1 / far, 1 / near)
        case "motion":
            return display.motion_color(still.motion)
        case "flow":
            if 1 not in still.flow:
                raise InputError("This field has no scene flow.")
            return display.flow_color(still.flow[1])
    return developed(run, request, view, still.radiance)


def developed(run: Run, request: FrameRequest, view: PathView, radiance: np.ndarray) -> np.ndarray:
    """Radiance (H, W, 3) of a view through the curve of a request."""
    camera_id = request.camera_id
    if not 0 <= camera_id < run.tonemapper.num_cameras:
        raise InputError(f"frame: camera {camera_id} is not known")
    if request.false_color:
        return display.false_color(exposed_light(run, request, radiance))
    if request.curve == "camera":
        rgb = develop_view(run, view, radiance, request.ev, camera_id, 1.0)
    else:
        rgb = display.develop(exposed_light(run, request, radiance), request.curve)
    return display.mark_clipping(rgb) if request.clipping else rgb


def exposed_light(run: Run, request: FrameRequest, radiance: np.ndarray) -> np.ndarray:
    """Exposed and balanced radiance (H, W, 3): for the learned camera as it balances,
    else so that gray is neutral.
    """
    if request.curve == "camera":
        gains = run.tonemapper.log_white_balance(request.camera_id).exp()
    else:
        gains = run.tonemapper.neutral(request.camera_id)
    return radiance * (gains.detach().cpu().numpy() * np.float32(2.0**request.ev))
