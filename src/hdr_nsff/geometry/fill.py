"""Gaps in maps, filled from the known pixels around them by normalized convolution
(Knutsson and Westin 1993) with Gaussians of growing width.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

# sum of a Gaussian's weight over known pixels above which its mean counts (hand-chosen)
MIN_KNOWN_WEIGHT = 0.02


def fill(disparity: np.ndarray, known: np.ndarray) -> np.ndarray:
    """`disparity` (H, W) with unknown pixels replaced by a smooth blend of known ones.

    `known` (H, W) bool. The nearest known pixels decide: a wider blur is used only
    where a narrower one found nothing. Where known pixels are too few for any, the
    nearest one counts. A map without known pixels comes back as it is.
    """
    if known.all() or not known.any():
        return disparity
    values = np.where(known, disparity, 0).astype(np.float32)
    weight = known.astype(np.float32)
    result = disparity.copy()
    missing = ~known
    sigma = 1.0  # pixels
    while missing.any():
        blurred = blur(values, sigma)
        blurred_weight = blur(weight, sigma)
        found = missing & (blurred_weight > MIN_KNOWN_WEIGHT)
        if not found.any():  # nor will a wider blur find any: it spreads them thinner
            break
        result[found] = blurred[found] / blurred_weight[found]
        missing &= ~found
        sigma *= 2
    if missing.any():
        _, (y, x) = ndimage.distance_transform_edt(~known, return_indices=True)
        result[missing] = disparity[y[missing], x[missing]]
    return result


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """`image` (H, W) smoothed by a Gaussian of `sigma` pixels, edges repeated."""
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
