"""Fixed curves without parameters to learn: sRGB, the mu-law, PU21, and one display
tone map.

Every function takes and gives back numpy arrays or torch tensors of any shape; where a
luminance is needed, the last axis is linear Rec. 709 rgb. `radiance` is linear and
non-negative; encoded values are in [0, 1] unless the docstring gives another range. The
recorded rgb of a camera is made by the learned `ToneMapper`, not here.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

A = TypeVar("A", np.ndarray, Tensor)

REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)  # ITU-R BT.709: weights of linear r, g, b
# Mantiuk and Azimi 2021, type "banding + glare": p1 to p7
PU21_BANDING_GLARE = (
    0.353487901,
    0.3734658629,
    8.277049286e-05,
    0.9062562627,
    0.09150303166,
    0.9099517204,
    596.3148142,
)
PU21_RANGE = (0.005, 10000.0)  # cd/m^2 that PU21 is defined for

TRIMMED_SHARE = 0.02  # of the pixels, at either end, that `auto_exposure` leaves out
KEY = 0.18  # log-average luminance of an auto-exposed picture (Reinhard et al. 2002)
# exposed luminance that `display` maps to white (hand-chosen on rendered scenes)
DISPLAY_WHITE = 40.0


def array_module(x: Any) -> Any:
    """`torch` or `numpy`: the module whose functions take `x`."""
    return torch if isinstance(x, Tensor) else np


def luminance(rgb: A) -> A:
    """Rec. 709 luminance (...) of linear `rgb` (..., 3)."""
    r, g, b = REC709_LUMINANCE
    return r * rgb[..., 0] + g * rgb[..., 1] + b * rgb[..., 2]


def srgb_encode(linear: A) -> A:
    """sRGB (IEC 61966-2-1) of linear light in [0, 1], clipped to it."""
    x = linear.clip(0, 1)
    toe = 12.92 * x
    power = 1.055 * x.clip(min=0.0031308) ** (1 / 2.4) - 0.055
    return array_module(x).where(x <= 0.0031308, toe, power)


def srgb_decode(encoded: A) -> A:
    """Linear light of sRGB values in [0, 1], clipped to it."""
    x = encoded.clip(0, 1)
    return array_module(x).where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def mu_law(radiance: A, mu: float = 5000.0) -> A:
    """`log(1 + mu E) / log(1 + mu)` of radiance E (HDR-NSFF, eq. 17): 0 to 0, 1 to 1.

    E is in units of the sequence's peak.
    """
    return array_module(radiance).log1p(mu * radiance.clip(min=0)) / math.log1p(mu)


def pu21_encode(nits: A) -> A:
    """PU21 (Mantiuk and Azimi 2021, banding + glare) of luminance in cd/m^2.

    Luminance is clipped to [0.005, 10000]. Codes go from about 0 to 595, and are 256 at
    100 cd/m^2.
    """
    p1, p2, p3, p4, p5, p6, p7 = PU21_BANDING_GLARE
    y = nits.clip(*PU21_RANGE) ** p4
    ratio = (p1 + p2 * y) / (1 + p3 * y)
    return (p7 * (ratio**p5 - p6)).clip(min=0)


def auto_exposure(radiance: A, key: float = KEY) -> float:
    """The factor that brings the log-average luminance of `radiance` to `key`.

    Reinhard et al. 2002, eq. 1-2, of `radiance` (..., 3). The average leaves out the
    darkest and the brightest 2 % of the pixels, so that a lamp entering or leaving the
    view changes little.
    """
    rgb = radiance.reshape(-1, 3)
    y = np.sort(np.asarray(luminance(rgb), np.float64).ravel())
    first = int(TRIMMED_SHARE * len(y))
    last = max(int((1 - TRIMMED_SHARE) * len(y)), 1)
    kept = y[first:last]
    darkest = 1e-6 * max(float(kept.max()), 1e-12)  # keeps the logarithm of black finite
    log_average = np.log(np.maximum(kept, darkest)).mean()
    return key / math.exp(float(log_average))


def display(radiance: A, exposure: float = 1.0, white: float = DISPLAY_WHITE) -> A:
    """An sRGB picture (..., 3) in [0, 1] of linear HDR `radiance` (..., 3).

    The curve is `L (1 + L / white^2) / (1 + L)` on luminance (Reinhard et al. 2002, eq.
    4). `exposure` is a factor (see `auto_exposure`): one per shot, never per frame.
    Luminance `white / exposure` becomes display white. Hue is kept: a color too bright
    for the display is desaturated towards white rather than clipped per channel.
    """
    exposed = (radiance * exposure).clip(min=0)
    y = luminance(exposed)
    mapped = (y * (1 + y / white**2) / (1 + y)).clip(max=1)[..., None]
    rgb = exposed * (mapped / y.clip(min=1e-9)[..., None])
    # blend with gray of the same luminance, just as far as the largest channel needs
    largest = array_module(rgb).amax(rgb, -1)[..., None]
    gray_share = ((largest - 1) / (largest - mapped).clip(min=1e-9)).clip(0, 1)
    return srgb_encode(rgb + gray_share * (mapped - rgb))
