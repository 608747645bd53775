"""The fine detail of a picture at one local contrast: what a Gaussian blur takes away.

It is comparable between two pictures of one still camera, also in noise and across
exposures.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hdr_nsff.radiometry.common_range import LUMA


@dataclass(frozen=True)
class LocalDetailTuning:
    """What counts as detail (hand-chosen on rendered rigs of nine cameras)."""

    max_width: int = 320  # pixels: larger frames are shrunk
    blur_px: float = 1.0  # standard deviations: of noise ...
    detail_px: float = 3.0  # ... of the blur that detail stands out from ...
    contrast_px: float = 6.0  # ... and of the neighborhood of local contrast
    min_contrast: float = 0.01  # of gray in [0, 1], below which detail is noise


def local_detail(frame: np.ndarray, tuning: LocalDetailTuning = LocalDetailTuning()) -> np.ndarray:
    """The fine detail (h, w) of a frame (H, W, 3) in gray, at most `max_width` wide.

    Its root mean square is about 1 wherever there is contrast.
    """
    gray: np.ndarray = np.asarray(frame, np.float32) @ LUMA
    if gray.shape[1] > tuning.max_width:
        height = round(gray.shape[0] * tuning.max_width / gray.shape[1])
        gray = cv2.resize(gray, (tuning.max_width, height), interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(gray, (0, 0), tuning.blur_px)
    detail = gray - cv2.GaussianBlur(gray, (0, 0), tuning.detail_px)
    strength = np.sqrt(cv2.GaussianBlur(detail**2, (0, 0), tuning.contrast_px))
    return detail / (strength + tuning.min_contrast)
