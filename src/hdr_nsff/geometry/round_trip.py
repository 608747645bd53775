"""Maps read where flow leads, and whether flow there and back returns to where it
started.
"""

from __future__ import annotations

import cv2
import numpy as np

TOLERANCE = 0.5  # pixels forward and backward flow may disagree by ...


# ... plus this share of the flow's length (METHOD.md 5: the reference allows 50 %)
RELATIVE_TOLERANCE = 0.01


def follow(
    field: np.ndarray,
    flow: np.ndarray,
    fill: float | None = None,
    interpolation: int = cv2.INTER_LINEAR,
) -> np.ndarray:
    """`field` (H, W) or (H, W, C) of the other frame, read where `flow` (H, W, 2) px
    leads; outside is `fill`, or the edge.
    """
    h, w = flow.shape[:2]
    x = np.arange(w, dtype=np.float32) + flow[..., 0]
    y = np.arange(h, dtype=np.float32)[:, None] + flow[..., 1]
    mode = cv2.BORDER_REPLICATE if fill is None else cv2.BORDER_CONSTANT
    return cv2.remap(
        field, x, y, interpolation, borderMode=mode, borderValue=0.0 if fill is None else fill
    )


def round_trip(forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """`|f(x) + b(x + f(x))|` (H, W) px: how far a pixel lands from where it started."""
    return np.linalg.norm(forward + follow(backward, forward), axis=-1)


def agreement(
    forward: np.ndarray, backward: np.ndarray, clipped_from: np.ndarray, clipped_to: np.ndarray
) -> np.ndarray:
    """Where flow can be believed (H, W) bool: round trip within tolerance, target
    inside the frame, neither end clipped.
    """
    blocked = follow(clipped_to.astype(np.float32), forward, fill=1.0)  # also 1 outside the frame
    return (round_trip(forward, backward) < allowed(forward)) & (blocked < 0.01) & ~clipped_from


def allowed(flow: np.ndarray) -> np.ndarray:
    """By how many pixels (H, W) a round trip that begins with `flow` (H, W, 2) px may
    miss.
    """
    return TOLERANCE + RELATIVE_TOLERANCE * np.linalg.norm(flow, axis=-1)
