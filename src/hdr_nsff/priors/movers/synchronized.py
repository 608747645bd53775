"""The depth of movers that several synchronized cameras see at the same instants.

Nothing moves between such pictures, so parallax shows the depth of every moving pixel
that two cameras recorded (`priors/depth/geometric.py`). The others of a connected
region take the median of what is known of it.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.priors.movers.tuning import SYNCHRONIZED_TUNING, SynchronizedTuning


def take_same_time_depth(
    disparity: ArrayStack,
    confidence: ArrayStack,
    seen: ArrayStack,
    seen_confidence: ArrayStack,
    moving: np.ndarray,
    tuning: SynchronizedTuning = SYNCHRONIZED_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """`disparity` and `confidence` with moving pixels as other cameras have seen them
    at the same time; all (T, H, W).

    `seen` and `seen_confidence` are of everything; `moving` is bool. A region of which
    too little was seen twice stays as it is.
    """
    disparity, confidence = np.array(disparity), np.array(confidence)
    for k, mask in enumerate(moving):
        known = mask & (seen_confidence[k] > tuning.min_confidence)
        regions, count = ndimage.label(mask)
        for region in range(1, count + 1):
            own = regions == region
            certain = own & known
            if certain.sum() < tuning.min_known_share * own.sum():
                continue
            disparity[k][own] = np.median(seen[k][certain])
            confidence[k][own] = tuning.region_confidence
        disparity[k][known] = seen[k][known]
        confidence[k][known] = tuning.known_confidence
    return disparity, confidence
