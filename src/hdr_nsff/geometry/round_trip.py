"""Maps read where flow leads, points that follow flow, and the forward-backward check.

The check is whether a pixel returns to where it started (Sundaram, Brox and Keutzer
2010).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage


@dataclass(frozen=True)
class RoundTripTuning:
    """How far a round trip may miss its start: `max_error_px` plus
    `max_error_share` of the flow's length.
    """

    max_error_px: float = 0.5  # hand-chosen on rendered scenes
    max_error_share: float = 0.01  # hand-chosen; the paper's reference code allows 0.5
    # share of clipped neighbors that bilinear reading tolerates: rounding only
    max_clipped_weight: float = 0.01


def follow(
    field: np.ndarray,
    flow: np.ndarray,
    fill: float | None = None,
    interpolation: int = cv2.INTER_LINEAR,
) -> np.ndarray:
    """`field` (H, W) or (H, W, C) of the other frame, read where `flow` (H, W, 2) px
    leads. Outside the frame it is `fill`, or the edge's value without one.
    """
    height, width = flow.shape[:2]
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    if fill is None:
        return cv2.remap(field, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
    return cv2.remap(field, x, y, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=fill)


def flow_at(flow: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """`flow` (H, W, 2) px at `pixels` (N, 2), xy with centers at +0.5, bilinear.

    Outside the frame it is the edge's. NaN where pixels, or the flow around, are NaN.
    """
    known = np.isfinite(pixels).all(-1)
    y, x = np.where(known[:, None], pixels - 0.5, 0)[:, ::-1].T
    axes = [
        ndimage.map_coordinates(flow[..., axis], (y, x), order=1, mode="nearest") for axis in (0, 1)
    ]
    return np.where(known[:, None], np.stack(axes, -1), np.nan)


def round_trip(forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """`|f(x) + b(x + f(x))|` (H, W) px: how far a pixel lands from where it started."""
    return np.linalg.norm(forward + follow(backward, forward), axis=-1)


def valid_flow(
    forward: np.ndarray,
    backward: np.ndarray,
    clipped_from: np.ndarray,
    clipped_to: np.ndarray,
    tuning: RoundTripTuning = RoundTripTuning(),
) -> np.ndarray:
    """Where flow is valid (H, W) bool: its round trip is within tolerance, its target
    inside the frame, and neither end clipped.

    `forward`, `backward` (H, W, 2) px; `clipped_from`, `clipped_to` (H, W) bool.
    """
    # 1 outside the frame too
    clipped_weight = follow(clipped_to.astype(np.float32), forward, fill=1.0)
    target_recorded = clipped_weight < tuning.max_clipped_weight
    returns = round_trip(forward, backward) < max_round_trip(forward, tuning)
    return returns & target_recorded & ~clipped_from


def max_round_trip(flow: np.ndarray, tuning: RoundTripTuning = RoundTripTuning()) -> np.ndarray:
    """How many pixels (H, W) a round trip that begins with `flow` (H, W, 2) px may miss
    its start by.
    """
    return tuning.max_error_px + tuning.max_error_share * np.linalg.norm(flow, axis=-1)
