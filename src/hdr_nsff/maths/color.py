"""Fixed curves without parameters to learn: sRGB, gamma, mu-law, PQ, HLG, PU21, EV, and
one display tone map.

Every function takes and gives back numpy arrays or torch tensors of any shape (the last
axis being rgb where a luminance is needed). `radiance` is linear and non-negative;
encoded values are in [0, 1] unless said otherwise. The recorded rgb of a camera is made
by the learned `ToneMapper`, not here.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

A = TypeVar("A", np.ndarray, Tensor)

REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)
PU21_BANDING_GLARE = (
    0.353487901,
    0.3734658629,
    8.277049286e-05,
    0.9062562627,
    0.09150303166,
    0.9099517204,
    596.3148142,
)


def library(x: Any) -> Any:
    """The module whose functions take `x`."""
    return torch if isinstance(x, Tensor) else np


def scale_ev(radiance: A, ev: float) -> A:
    """`radiance` under an exposure `ev` stops longer."""
    return radiance * 2.0**ev


def luminance(rgb: A) -> A:
    """Rec. 709 luminance (...) of linear `rgb` (..., 3)."""
    r, g, b = REC709_LUMINANCE
    return r * rgb[..., 0] + g * rgb[..., 1] + b * rgb[..., 2]


def gamma_encode(linear: A, gamma: float = 2.2) -> A:
    """linear^(1 / gamma); negative values are clipped."""
    return linear.clip(min=0) ** (1 / gamma)


def gamma_decode(encoded: A, gamma: float = 2.2) -> A:
    """encoded^gamma."""
    return encoded.clip(min=0) ** gamma


def srgb_encode(linear: A) -> A:
    """sRGB (IEC 61966-2-1) of linear light in [0, 1], clipped to it."""
    x = linear.clip(0, 1)
    return library(x).where(
        x <= 0.0031308, 12.92 * x, 1.055 * x.clip(min=0.0031308) ** (1 / 2.4) - 0.055
    )


def srgb_decode(encoded: A) -> A:
    """Linear light of sRGB values in [0, 1], clipped to it."""
    x = encoded.clip(0, 1)
    return library(x).where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def mu_law(radiance: A, mu: float = 5000.0) -> A:
    """log(1 + mu E) / log(1 + mu) (eq. 17) of radiance in units of the sequence's peak:
    0 to 0, 1 to 1.
    """
    return library(radiance).log1p(mu * radiance.clip(min=0)) / math.log1p(mu)


def pq_encode(nits: A) -> A:
    """PQ signal (SMPTE ST 2084) of luminance in cd/m^2; 10,000 gives 1."""
    y = (nits.clip(min=0) / 10000.0) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * y) / (1 + 2392 / 128 * y)) ** (2523 / 32)


def pq_decode(signal: A) -> A:
    """Luminance in cd/m^2 of a PQ signal in [0, 1]."""
    e = signal.clip(0, 1) ** (32 / 2523)
    return 10000.0 * ((e - 3424 / 4096).clip(min=0) / (2413 / 128 - 2392 / 128 * e)) ** (
        16384 / 2610
    )


def hlg_encode(linear: A) -> A:
    """HLG signal (ARIB STD-B67, BT.2100) of scene light in [0, 1]; 1/12 gives 0.5, 1
    gives 1.
    """
    a, b = 0.17883277, 1 - 4 * 0.17883277
    c = 0.5 - a * math.log(4 * a)
    x = linear.clip(0, 1)
    return library(x).where(
        x <= 1 / 12, (3 * x) ** 0.5, a * library(x).log((12 * x).clip(min=1) - b) + c
    )


def hlg_decode(signal: A) -> A:
    """Scene light in [0, 1] of an HLG signal in [0, 1]."""
    a, b = 0.17883277, 1 - 4 * 0.17883277
    c = 0.5 - a * math.log(4 * a)
    s = signal.clip(0, 1)
    return library(s).where(s <= 0.5, s**2 / 3, (library(s).exp((s - c) / a) + b) / 12)


def pu21_encode(nits: A) -> A:
    """PU21 (Mantiuk and Azimi 2021, banding + glare) of luminance in cd/m^2, clipped to
    [0.005, 10000]: about 0 to 595, 100 cd/m^2 at 256.
    """
    p1, p2, p3, p4, p5, p6, p7 = PU21_BANDING_GLARE
    y = nits.clip(0.005, 10000.0) ** p4
    return (p7 * (((p1 + p2 * y) / (1 + p3 * y)) ** p5 - p6)).clip(min=0)


def auto_exposure(radiance: A, key: float = 0.18) -> float:
    """The factor that brings the log-average luminance of `radiance` (..., 3) to `key`
    (Reinhard et al. 2002, eq. 1-2).

    The average leaves out the darkest and the brightest 2 %, so that a lamp in view or
    out of it changes little.
    """
    y = np.sort(np.asarray(luminance(radiance.reshape(-1, 3)), np.float64).ravel())
    y = y[int(0.02 * len(y)) : max(int(0.98 * len(y)), 1)]
    average = math.exp(float(np.log(np.maximum(y, 1e-6 * max(float(y.max()), 1e-12))).mean()))
    return key / average


def display(radiance: A, exposure: float = 1.0, white: float = 40.0) -> A:
    """An sRGB picture (..., 3) in [0, 1] of linear HDR `radiance` (..., 3): Reinhard's
    curve `L (1 + L / white^2) / (1 + L)` on luminance.

    `exposure` is a factor (see `auto_exposure`); one per shot, never per frame.
    Luminance `white / exposure` becomes display white. Hue is kept; a color too bright
    for the display is desaturated towards white rather than clipped per channel.
    """
    x = (radiance * exposure).clip(min=0)
    y = luminance(x)
    mapped = (y * (1 + y / white**2) / (1 + y)).clip(max=1)[..., None]
    rgb = x * (mapped / y.clip(min=1e-9)[..., None])
    top = library(rgb).amax(rgb, -1)[..., None]
    share = ((top - 1) / (top - mapped).clip(min=1e-9)).clip(
        0, 1
    )  # how far towards gray of the same luminance, until it fits
    return srgb_encode(rgb + share * (mapped - rgb))
