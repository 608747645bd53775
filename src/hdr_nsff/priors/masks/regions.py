"""Connected regions of a picture: cleaned, and chosen by what lies in them."""

from __future__ import annotations

import cv2
import numpy as np


def without_specks(pixels: np.ndarray, opening_px: int, closing_px: int) -> np.ndarray:
    """The `pixels` (H, W) bool without regions narrower than `opening_px` and with gaps
    narrower than `closing_px` closed.
    """
    opening, closing = np.ones((opening_px,) * 2, np.uint8), np.ones((closing_px,) * 2, np.uint8)
    opened = cv2.morphologyEx(pixels.astype(np.uint8), cv2.MORPH_OPEN, opening)
    return cv2.morphologyEx(opened, cv2.MORPH_CLOSE, closing) > 0


def marked_regions(pixels: np.ndarray, marked: np.ndarray, min_share: float) -> np.ndarray:
    """The connected regions (H, W) of `pixels` of which at least `min_share` are
    `marked` (H, W), bool or a share in [0, 1].
    """
    num, labels = cv2.connectedComponents(pixels.astype(np.uint8))
    sizes = np.bincount(labels.ravel(), minlength=num)
    marked_sizes = np.bincount(labels.ravel(), weights=marked.ravel(), minlength=num)
    kept = marked_sizes >= min_share * sizes
    kept[0] = False  # what is none of the pixels
    return kept[labels]


def regions_with_disc(pixels: np.ndarray, inside: np.ndarray, radius: float) -> np.ndarray:
    """The connected regions (H, W) of `pixels` with a disc of `radius` px that is all
    `inside` (H, W).
    """
    _, labels = cv2.connectedComponents(pixels.astype(np.uint8))
    depth = cv2.distanceTransform((inside & pixels).astype(np.uint8), cv2.DIST_L2, 3)
    return np.isin(labels, np.unique(labels[depth > radius]))
