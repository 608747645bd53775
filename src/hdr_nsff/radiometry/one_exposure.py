"""Recorded frames brought to one exposure through the response, for optical flow."""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.stack import ArrayStack, map_stack
from hdr_nsff.radiometry.response import Response


def at_one_exposure(
    video: ArrayStack,
    brackets: np.ndarray,
    cameras: np.ndarray,
    response: Response,
    drift: np.ndarray | None = None,
) -> ArrayStack:
    """`video` (T, H, W, 3) recorded in [0, 1] at one brightness, in [0, 1].

    Every pixel becomes the mean of what it would be in all brackets (T,) that its
    camera (T,) used, which keeps contrast wherever any of them has some. `drift` (T,):
    stops by which frames differ from their brackets.
    """
    drift = np.zeros(len(video)) if drift is None else drift
    value = np.linspace(0, 1, 1025)  # recorded values that are tabulated

    def one_frame(frame: np.ndarray, t: int) -> np.ndarray:
        own, camera = brackets[t], cameras[t]
        used = np.unique(brackets[cameras == camera])
        result = np.empty(frame.shape, np.float32)
        for c in range(3):
            y = response.y[camera, c]
            exposure = np.interp(value, y, response.x)
            gains = [2.0 ** (response.ev[b] - response.ev[own] - drift[t]) for b in used]
            images = [np.interp(exposure * gain, response.x, y) for gain in gains]
            result[..., c] = np.interp(frame[..., c], value, np.mean(images, axis=0))
        return result

    return map_stack(one_frame, video)
