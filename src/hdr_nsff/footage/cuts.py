"""Cuts: places where the picture changes to another scene from one frame to the next.

Thumbnails of neighboring frames, at one brightness, are correlated. At a cut they are
unlike, while those before it are alike, and those after it are too: a fast pan, a rig
that takes frames in turn, and a single flash do not count. Frames without contrast,
such as the black ones between two scenes, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import ArrayStack


@dataclass(frozen=True)
class CutTuning:
    """What counts as a cut (hand-chosen on recorded clips, joined and single)."""

    thumbnail_px: int = 64  # width
    max_correlation: float = 0.45  # of the two frames at a cut
    min_correlation: float = 0.8  # of the frames before it, and of those after it
    around: int = 2  # pairs of frames looked at before, and after
    min_deviation: float = 0.02  # of gray: less contrast is none


def find_cuts(video: ArrayStack, tuning: CutTuning = CutTuning()) -> list[int]:
    """The first frames of new scenes, in `video` (T, H, W, 3) at one brightness."""
    height, width = video.shape[1:3]
    size = (tuning.thumbnail_px, max(2, round(tuning.thumbnail_px * height / width)))
    thumbnails = [thumbnail(frame, size) for frame in track(video, "exposure: cuts", len(video))]
    seen = [t for t, small in enumerate(thumbnails) if small.std() >= tuning.min_deviation]
    alike = np.array([correlation(thumbnails[s], thumbnails[t]) for s, t in pairwise(seen)])
    cuts = []
    for k, here in enumerate(alike):
        before = alike[max(0, k - tuning.around) : k]
        after = alike[k + 1 : k + 1 + tuning.around]
        sides = np.concatenate([before, after])
        if here < tuning.max_correlation and len(sides) and sides.min() > tuning.min_correlation:
            cuts.append(seen[k] + 1)
    return cuts


def thumbnail(frame: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A frame (H, W, 3) as a small gray picture of `size` (width, height)."""
    gray = frame.mean(-1).astype(np.float32)
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """The correlation of two thumbnails that have contrast, in [-1, 1]."""
    return float(((a - a.mean()) * (b - b.mean())).mean() / (a.std() * b.std()))
