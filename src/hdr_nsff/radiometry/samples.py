"""Points that several exposures recorded: the input of `debevec.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Samples:
    """Points recorded in several exposures."""

    rgb: np.ndarray  # (P, B, 3) recorded, in [0, 1]
    valid: np.ndarray  # (P, B, 3) bool: seen there, and away from black and saturation
    saturated: np.ndarray  # (P, B, 3) bool: seen there, and saturated
    frame: np.ndarray | None = None  # (P,) where the point was chosen; None: unknown
    # (P, B) stops by which a recording's exposure exceeds its bracket's; None: 0
    offset: np.ndarray | None = None


def empty_samples(num_points: int, num_brackets: int, frame: int) -> Samples:
    """Points chosen in one frame that nothing is known of yet."""
    shape = (num_points, num_brackets, 3)
    return Samples(
        np.zeros(shape), np.zeros(shape, bool), np.zeros(shape, bool), np.full(num_points, frame)
    )


def joined(parts: Sequence[Samples], num_brackets: int) -> Samples:
    """The points of all `parts`, whose frames are known; no points without parts."""
    parts = parts or [empty_samples(0, num_brackets, 0)]
    frames = [p.frame for p in parts if p.frame is not None]
    assert len(frames) == len(parts)
    return Samples(
        np.concatenate([p.rgb for p in parts]),
        np.concatenate([p.valid for p in parts]),
        np.concatenate([p.saturated for p in parts]),
        np.concatenate(frames),
    )
