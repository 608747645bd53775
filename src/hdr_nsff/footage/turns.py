"""Rigs in turn: clips whose frames are taken by several still cameras, one after the
other, as in the capture of HDR-NSFF: frame t is what camera t modulo N records.

Such a clip jumps from frame to frame, and shows the same picture again every N frames,
movers apart. A tripod's clip never jumps, and a moving camera's does not come back.
Fine detail tells: what a Gaussian blur takes away, at one local contrast, correlates
between two pictures of one still camera, also in noise and across exposures.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.radiometry.common_range import LUMA


@dataclass(frozen=True)
class TurnsTuning:
    """What counts as a rig. Rendered rigs of nine cameras correlate by at least 0.54
    between frames of one camera and by at most 0.34 between others; recorded clips of
    one camera by more than 0.55 from frame to frame, or nowhere.
    """

    max_width: int = 320  # pixels: larger frames are shrunk
    blur_px: float = 1.0  # standard deviations: of noise ...
    detail_px: float = 3.0  # ... of the blur that detail stands out from ...
    contrast_px: float = 6.0  # ... and of the neighborhood of local contrast
    min_contrast: float = 0.01  # of gray in [0, 1], below which detail is noise
    min_same: float = 0.45  # correlation between frames of one camera
    max_other: float = 0.4  # correlation between frames of two cameras ...
    min_ratio: float = 1.7  # ... and the ratio of both
    min_cameras: int = 3
    max_cameras: int = 64
    max_frames: int = 160  # that are looked at: the first ones


def find_cameras_in_turn(video: ArrayStack, tuning: TurnsTuning = TurnsTuning()) -> int:
    """How many cameras took the frames of `video` (T, H, W, 3), at one brightness, in
    turn; 1 where it is the clip of one camera.
    """
    count = min(len(video), tuning.max_frames)
    longest = min(tuning.max_cameras, count // 2)
    if longest < tuning.min_cameras:
        return 1
    details = np.stack([local_detail(video[t], tuning).ravel() for t in range(count)])
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


def local_detail(frame: np.ndarray, tuning: TurnsTuning = TurnsTuning()) -> np.ndarray:
    """The fine detail (h, w) of a frame (H, W, 3) in gray, at most `max_width` wide, at
    one local contrast, of length 1.
    """
    gray: np.ndarray = np.asarray(frame, np.float32) @ LUMA
    if gray.shape[1] > tuning.max_width:
        height = round(gray.shape[0] * tuning.max_width / gray.shape[1])
        gray = cv2.resize(gray, (tuning.max_width, height), interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(gray, (0, 0), tuning.blur_px)
    detail = gray - cv2.GaussianBlur(gray, (0, 0), tuning.detail_px)
    strength = np.sqrt(cv2.GaussianBlur(detail**2, (0, 0), tuning.contrast_px))
    detail = detail / (strength + tuning.min_contrast)
    return detail / max(float(np.linalg.norm(detail)), 1e-9)
