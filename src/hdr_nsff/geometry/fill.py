"""Gaps in maps filled from what is known around them."""

from __future__ import annotations

import cv2
import numpy as np


def fill(disparity: np.ndarray, known: np.ndarray) -> np.ndarray:
    """`disparity` (H, W) with pixels that are not `known` (H, W) bool replaced by a
    smooth blend of the known ones around.
    """
    if known.all() or not known.any():
        return disparity
    values, weight = np.where(known, disparity, 0).astype(np.float32), known.astype(np.float32)
    result, missing = disparity.copy(), ~known
    sigma = 1.0
    while (
        missing.any()
    ):  # the nearest known pixels decide: a wider blur only where a narrower one found nothing
        blurred, share = (
            cv2.GaussianBlur(a, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
            for a in (values, weight)
        )
        found = missing & (share > 0.02)
        result[found] = blurred[found] / share[found]
        missing &= ~found
        sigma *= 2
    return result
