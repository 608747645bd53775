"""What two frames of different exposure both recorded: pictures of a pair limited to
their common range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def recorded_range(frame: np.ndarray, clipped: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest equalized rgb (3,), (3,) that this frame really recorded;
    (0, 1) where all of it is clipped.
    """
    if clipped.all():
        return np.zeros(3, np.float32), np.ones(3, np.float32)
    low, high = np.quantile(frame[~clipped], [0.001, 0.999], axis=0).astype(np.float32)
    return low, high


def common_gray(
    video: np.ndarray, ranges: Mapping | Sequence, i: int, j: int
) -> tuple[np.ndarray, np.ndarray]:
    """Frames `i` and `j` as gray uint8 (H, W), cut to the range both exposures recorded
    and stretched to it.

    What saturates in one frame then looks saturated in the other too, so its rim stays
    the same curve in the scene.
    """
    low, high = common_range(ranges[i], ranges[j])
    offset, scale = low @ LUMA, 255.0 / ((high - low) @ LUMA)
    a, b = ((np.clip(video[k], low, high) @ LUMA - offset) * scale for k in (i, j))
    return np.rint(a).astype(np.uint8), np.rint(b).astype(np.uint8)


def common_rgb(
    video: np.ndarray, ranges: Mapping | Sequence, i: int, j: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same in color: frames `i` and `j` (H, W, 3) in [0, 1], every channel
    stretched to the range both exposures recorded.
    """
    low, high = common_range(ranges[i], ranges[j])
    a, b = ((np.clip(video[k], low, high) - low) / (high - low) for k in (i, j))
    return a, b


def common_range(
    one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest rgb (3,), (3,) that two frames of these ranges both
    recorded.
    """
    low, high = np.maximum(one[0], other[0]), np.minimum(one[1], other[1])
    if (
        high - low < 0.02
    ).any():  # nothing in common: better the frames as they are than stretched noise
        return np.zeros(3, np.float32), np.ones(3, np.float32)
    return low, high
