"""Flow of movers, corrected near their outlines with the mover's own pixels alone.

Patches and smoothness reach across a mover's outline, so flow within a few pixels of it
is partly that of the background: on small frames a mover's whole motion comes out some
percent too small, and an object that moves too little seems too far away. Once masks
are known, Lucas & Kanade's least squares ("An iterative image registration technique",
1981) run in windows that end at the mask, robust, and blind to brightness; the
correction is smooth. Flow is in pixels, x then y, as in `dense`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from hdr_nsff.geometry.round_trip import follow

CUT_AT_SIGMAS = 4.0  # OpenCV's Gaussians of floats end there


@dataclass(frozen=True)
class MaskedLeastSquaresTuning:
    """Tuning constants of the correction, hand-chosen on rendered scenes."""

    blur_px: float = 0.4
    """Standard deviation of the blur that reduces noise."""
    window_px: float = 2.0
    """Standard deviation of the Gaussian windows."""
    smoothing_px: float = 3.0
    """Standard deviation of the Gaussian that the correction is averaged with."""
    iterations: int = 6
    """Gauss-Newton steps."""
    outlier_rgb: float = 0.06
    """Difference of color, in [0, 1], at which a pixel counts half (Cauchy weight)."""
    flat_gradient: float = 1e-4
    """Added to the windows' mean squared gradients (per squared pixel): a window
    without texture is not corrected.
    """
    max_step_px: float = 0.5
    """Largest change of the flow in one step, in x and in y. Times `iterations` it
    bounds the whole correction.
    """


MASKED_LEAST_SQUARES_TUNING = MaskedLeastSquaresTuning()


def refine_mover_flow(
    source: np.ndarray,
    target: np.ndarray,
    flow: np.ndarray,
    moving: np.ndarray,
    tuning: MaskedLeastSquaresTuning = MASKED_LEAST_SQUARES_TUNING,
) -> np.ndarray:
    """`flow` (H, W, 2) px, corrected where `source` is `moving` (H, W) bool.

    It leads from `source` to `target`, rgb (H, W, 3) in [0, 1] at one exposure.
    """
    if not moving.any():
        return flow
    around = box_around(moving, tuning)
    source = cv2.GaussianBlur(source.astype(np.float32), (0, 0), tuning.blur_px)[around]
    target = cv2.GaussianBlur(target.astype(np.float32), (0, 0), tuning.blur_px)
    mask = moving[around].astype(np.float32)[..., None]
    # from pixels of the box to those of the target
    offset = np.array([around[1].start, around[0].start], np.float32)
    start = flow[around] + offset
    correction = np.zeros(start.shape, np.float32)
    for _ in range(tuning.iterations):
        step = lucas_kanade_step(source, target, start + correction, mask, tuning)
        step = np.clip(step, -tuning.max_step_px, tuning.max_step_px)
        smoothed = masked_mean((correction + step) * mask, mask, tuning.smoothing_px)
        correction = mask * smoothed
    result = flow.copy()
    result[around] += correction
    return result


def box_around(moving: np.ndarray, tuning: MaskedLeastSquaresTuning) -> tuple[slice, slice]:
    """Rows and columns of a box around the `moving` (H, W) pixels, so wide that no
    Gaussian around one of them leaves it, except where it leaves the picture.
    """
    margin = math.ceil(CUT_AT_SIGMAS * max(tuning.window_px, tuning.smoothing_px)) + 1
    inside = (np.nonzero(moving.any(axis))[0] for axis in (1, 0))
    rows, columns = (slice(max(i[0] - margin, 0), i[-1] + margin + 1) for i in inside)
    return rows, columns


def lucas_kanade_step(
    source: np.ndarray,
    target: np.ndarray,
    flow: np.ndarray,
    mask: np.ndarray,
    tuning: MaskedLeastSquaresTuning,
) -> np.ndarray:
    """The change (h, w, 2) px of `flow` that makes masked windows look alike.

    `flow` (h, w, 2) leads from the box `source` (h, w, 3) into the whole `target`
    (H, W, 3). Windows hold pixels of `mask` (h, w, 1) only; their mean brightness does
    not matter.
    """
    gradient_x = follow(cv2.Sobel(target, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8), flow)
    gradient_y = follow(cv2.Sobel(target, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8), flow)
    error = follow(target, flow, interpolation=cv2.INTER_CUBIC) - source
    error -= masked_mean(error * mask, mask, tuning.window_px)

    ones = np.ones(target.shape[:2], np.float32)
    inside = follow(ones, flow, fill=0.0) > 0.99  # 1 but for rounding
    weight = mask * inside[..., None] / (1 + (error / tuning.outlier_rgb) ** 2)
    factors = (
        (gradient_x, gradient_x),
        (gradient_x, gradient_y),
        (gradient_y, gradient_y),
        (gradient_x, error),
        (gradient_y, error),
    )
    channels = np.ones((1, 3), np.float32)  # OpenCV adds them up in a tenth of numpy's time
    products = np.stack([cv2.transform(weight * (a * b), channels) for a, b in factors], -1)
    means = masked_mean(products, mask, tuning.window_px)  # (h, w, 5)
    xx = means[..., 0] + tuning.flat_gradient
    xy = means[..., 1]
    yy = means[..., 2] + tuning.flat_gradient
    xe = means[..., 3]
    ye = means[..., 4]
    determinant = xx * yy - xy**2
    return np.stack([xy * ye - yy * xe, xy * xe - xx * ye], -1) / determinant[..., None]


def masked_mean(values: np.ndarray, mask: np.ndarray, sigma_px: float) -> np.ndarray:
    """The Gaussian mean of `values` (H, W, C) over the `mask` (H, W, 1) pixels around.

    `values` must be 0 outside the mask.
    """
    weight = np.maximum(cv2.GaussianBlur(mask, (0, 0), sigma_px), 1e-6)
    return cv2.GaussianBlur(values, (0, 0), sigma_px) / weight[..., None]
