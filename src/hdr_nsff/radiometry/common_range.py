"""Two frames of different exposure, limited to the range of values that both recorded.

What saturates in one frame then looks saturated in the other too, so the outline of a
clipped region stays the same curve in the scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hdr_nsff.core.stack import ArrayStack

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # Rec. 601
RANGE_QUANTILES = (0.001, 0.999)  # hand-chosen: single hot pixels do not count
# a common range narrower than this (of 1) would only stretch noise (hand-chosen)
MIN_RANGE = 0.02


def recorded_range(frame: np.ndarray, clipped: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest equalized rgb (3,), (3,) that a frame really recorded.

    `frame` (H, W, 3) in [0, 1], `clipped` (H, W) bool; 0 and 1 where all is clipped.
    """
    if clipped.all():
        return np.zeros(3, np.float32), np.ones(3, np.float32)
    low, high = np.quantile(frame[~clipped], RANGE_QUANTILES, axis=0).astype(np.float32)
    return low, high


def common_gray(
    video: ArrayStack, ranges: Mapping | Sequence, i: int, j: int
) -> tuple[np.ndarray, np.ndarray]:
    """Frames `i` and `j` of `video` (T, H, W, 3) as gray uint8 (H, W), cut to the range
    both recorded and stretched to it. `ranges`: per frame, as of `recorded_range`.
    """
    low, high = common_range(ranges[i], ranges[j])
    offset = low @ LUMA
    scale = 255.0 / ((high - low) @ LUMA)
    a, b = ((np.clip(video[k], low, high) @ LUMA - offset) * scale for k in (i, j))
    return np.rint(a).astype(np.uint8), np.rint(b).astype(np.uint8)


def common_rgb(
    video: ArrayStack, ranges: Mapping | Sequence, i: int, j: int
) -> tuple[np.ndarray, np.ndarray]:
    """As `common_gray`, in color: frames `i` and `j` (H, W, 3) in [0, 1], every channel
    cut and stretched by itself.
    """
    low, high = common_range(ranges[i], ranges[j])
    a, b = ((np.clip(video[k], low, high) - low) / (high - low) for k in (i, j))
    return a, b


def common_range(
    one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest rgb (3,), (3,) that two frames of these ranges both
    recorded; 0 and 1 where they have hardly any in common.
    """
    low, high = np.maximum(one[0], other[0]), np.minimum(one[1], other[1])
    if (high - low < MIN_RANGE).any():
        return np.zeros(3, np.float32), np.ones(3, np.float32)
    return low, high
