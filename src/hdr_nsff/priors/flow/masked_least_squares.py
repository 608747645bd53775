"""Flow of what moves, mended where it blurs into what is behind.

Patches and smoothness reach over a mover's outline, so flow within a few pixels of it
is partly that of the background: on small pictures a mover's whole motion comes out
some percents too small, and what moves too little seems to be too far away. Once masks
are known, the motion of a mover is told by its own pixels alone: Lucas & Kanade's least
squares ("An iterative image registration technique", 1981) in windows that end where
the mask ends, robust, blind to brightness, and the correction is smooth.
"""

from __future__ import annotations

import cv2
import numpy as np

from hdr_nsff.geometry.round_trip import follow

BLUR = 0.4  # pixels: standard deviation of what takes off the noise
WINDOW = 2.0  # pixels: standard deviation of the windows
SMOOTH = 3.0  # pixels: of what the correction is averaged over
ROUNDS = 6
# of the range: differences of color from which on pixels count less (Geman & McClure)
OUTLIER = 0.06
# added to the windows' mean square gradients: where nothing shows, nothing is corrected
FLAT = 1e-4
STEP = 0.5  # pixels a round at most
MOST = 1.5  # pixels in all: what would go further is left as it was


def mended(here: np.ndarray, there: np.ndarray, flow: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """`flow` (H, W, 2) px from a picture `here` to another `there`, both rgb (H, W, 3)
    in [0, 1] at one exposure, corrected where `here` is `moving` (H, W) bool.
    """
    if not moving.any():
        return flow
    here, there = (
        cv2.GaussianBlur(picture.astype(np.float32), (0, 0), BLUR) for picture in (here, there)
    )
    own = moving.astype(np.float32)[..., None]
    change = np.zeros(flow.shape, np.float32)
    for _ in range(ROUNDS):
        step = np.clip(towards(here, there, flow + change, own), -STEP, STEP)
        change = own * averaged((change + step) * own, own, SMOOTH)
    return np.where(np.linalg.norm(change, axis=-1, keepdims=True) < MOST, flow + change, flow)


def towards(here: np.ndarray, there: np.ndarray, flow: np.ndarray, own: np.ndarray) -> np.ndarray:
    """The step (H, W, 2) px of the flow that makes windows of `own` pixels (H, W, 1)
    look alike, whatever their brightness.
    """
    x, y = (
        follow(cv2.Sobel(there, cv2.CV_32F, *order, ksize=3, scale=1 / 8), flow)
        for order in ((1, 0), (0, 1))
    )
    error = follow(there, flow, interpolation=cv2.INTER_CUBIC) - here
    error -= averaged(error * own, own, WINDOW)
    inside = follow(np.ones(flow.shape[:2], np.float32), flow, fill=0.0) > 0.99
    weight = own * inside[..., None] / (1 + (error / OUTLIER) ** 2)
    products = np.stack(
        [(weight * p).sum(-1) for p in (x * x, x * y, y * y, x * error, y * error)], -1
    )
    xx, xy, yy, xe, ye = np.moveaxis(averaged(products, own, WINDOW), -1, 0)
    xx, yy = xx + FLAT, yy + FLAT
    return np.stack([xy * ye - yy * xe, xy * xe - xx * ye], -1) / (xx * yy - xy**2)[..., None]


def averaged(values: np.ndarray, own: np.ndarray, sigma: float) -> np.ndarray:
    """The mean of `values` (H, W, C), 0 where not `own` (H, W, 1), over the own pixels
    around.
    """
    weight = np.maximum(cv2.GaussianBlur(own, (0, 0), sigma), 1e-6)
    channels = [
        cv2.GaussianBlur(np.ascontiguousarray(v), (0, 0), sigma) for v in np.moveaxis(values, -1, 0)
    ]
    return np.stack(channels, -1) / weight[..., None]
