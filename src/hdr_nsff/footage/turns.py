"""Rigs in turn: clips whose frames are taken by several still cameras, one after the
other, as in the capture of HDR-NSFF: frame t is what camera t modulo N records.

Such a clip jumps from frame to frame, and shows the same picture again every N frames,
movers apart. A tripod's clip never jumps, and a moving camera's does not come back.
Fine detail tells (`local_detail.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.radiometry.local_detail import LocalDetailTuning, local_detail


@dataclass(frozen=True)
class TurnsTuning:
    """What counts as a rig. Rendered rigs of nine cameras correlate by at least 0.54
    between frames of one camera and by at most 0.34 between others; recorded clips of
    one camera by more than 0.55 from frame to frame, or nowhere.
    """

    min_same: float = 0.45  # correlation between frames of one camera
    max_other: float = 0.4  # correlation between frames of two cameras ...
    min_ratio: float = 1.7  # ... and the ratio of both
    min_cameras: int = 3
    max_cameras: int = 64
    max_frames: int = 160  # that are looked at: the first ones
    detail: LocalDetailTuning = field(default_factory=LocalDetailTuning)


def find_cameras_in_turn(video: ArrayStack, tuning: TurnsTuning = TurnsTuning()) -> int:
    """How many cameras took the frames of `video` (T, H, W, 3), at one brightness, in
    turn; 1 where it is the clip of one camera.
    """
    count = min(len(video), tuning.max_frames)
    longest = min(tuning.max_cameras, count // 2)
    if longest < tuning.min_cameras:
        return 1
    details = np.stack([local_detail(video[t], tuning.detail).ravel() for t in range(count)])
    details /= np.maximum(np.linalg.norm(details, axis=1, keepdims=True), 1e-9)
    correlation = details @ details.T
    # beyond two periods nothing new is learned
    gaps = range(1, min(2 * longest, count - 1) + 1)
    alike = {gap: float(np.median(np.diagonal(correlation, gap))) for gap in gaps}
    for cameras in range(tuning.min_cameras, longest + 1):
        if is_period(alike, cameras, tuning):
            return cameras
    return 1


def is_period(alike: dict[int, float], cameras: int, tuning: TurnsTuning = TurnsTuning()) -> bool:
    """Whether frames `cameras` apart show the same picture and no others do; `alike`:
    the correlation of pictures by the gap between frames.
    """
    gaps = [gap for gap in alike if gap <= 2 * cameras]
    same = min(alike[gap] for gap in gaps if gap % cameras == 0)
    other = max(alike[gap] for gap in gaps if gap % cameras)
    return same > max(tuning.min_same, tuning.min_ratio * other) and other < tuning.max_other
