"""Gain maps (ISO 21496-1): an HDR picture as an SDR picture and a factor per pixel.

The factor is stored as its base-2 logarithm, between a minimum and a maximum per
channel. A screen that shows `headroom` stops above SDR white applies all of it, another
one a share (section 6 of the standard). All light is linear, 1 is SDR white, and both
pictures have the primaries of the SDR picture.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.ultra_hdr import OFFSET, GainMap

MIN_RANGE = 1e-3  # stops between minimum and maximum: the standard divides by them


def make_gain_map(sdr: np.ndarray, hdr: np.ndarray, headroom: float) -> GainMap:
    """The gains that turn `sdr` into `hdr`.

    Both are linear light (H, W, 3); 1 is SDR white. `headroom` is in stops above it.
    """
    gains = np.log2((np.maximum(hdr, 0) + OFFSET) / (np.maximum(sdr, 0) + OFFSET))
    minimum = gains.reshape(-1, 3).min(0)
    maximum = np.maximum(gains.reshape(-1, 3).max(0), minimum + MIN_RANGE)
    codes = (gains - minimum) / (maximum - minimum)
    return GainMap(codes, minimum, maximum, headroom)


def apply_gain_map(sdr: np.ndarray, gains: GainMap, stops: float | None = None) -> np.ndarray:
    """Linear light (H, W, 3) on a screen with `stops` above SDR white.

    None: on a screen with the whole headroom.
    """
    share = 1.0
    if stops is not None:
        share = float(np.clip(stops / gains.headroom, 0, 1))
    logarithm = gains.minimum + gains.codes * (gains.maximum - gains.minimum)
    return (sdr + gains.offset) * 2.0 ** (share * logarithm) - gains.offset
