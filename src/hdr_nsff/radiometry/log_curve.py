"""The curve G = ln g^-1 of a camera: the log exposure of a recorded value z.

G(z) = a ln z + b ln srgb^-1(z) + H(z), where H is linear between nodes even in
asin(sqrt(z)), dense at both ends: a saturating shoulder is smooth in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hdr_nsff.maths.color import srgb_decode

# recorded values outside carry little: noise and rounding below, compression above
# (hand-chosen for 8 bits)
LOW, HIGH = 3 / 255, 252.5 / 255
SATURATED = 254.5 / 255  # rounds to the highest of 8-bit codes
NODES = 40  # of H
UNKNOWNS = NODES + 2  # of a channel: the nodes of H, then a and b
TYPICAL = (1.1, 0.5)  # a and b half way between gamma 2.2 and sRGB
GAMMA = 2.2  # of the response assumed by estimates from brightness alone
MIN_VALUE = 1e-4  # recorded values are raised to this before their logarithm
LN2 = float(np.log(2))


@dataclass(frozen=True)
class Top:
    """Where channels saturate, and how far their own curves reach."""

    level: np.ndarray  # (3,) G(1), log exposure
    # (3,) recorded value from which on a channel follows the others; 1: nowhere
    shown: np.ndarray

    def scaled(self, factor: float) -> Top:
        """The same of curves times a factor."""
        return replace(self, level=self.level * factor)


def basis(z: np.ndarray) -> np.ndarray:
    """Rows [H's hat functions, ln z, ln srgb^-1(z)] (..., 42), whose product with a
    channel's solution (42,) is G(z).
    """
    position = 2 / np.pi * np.arcsin(np.sqrt(np.clip(z, 0, 1))) * (NODES - 1)
    hats = np.clip(1 - np.abs(position[..., None] - np.arange(NODES)), 0, 1)
    z = np.maximum(z, MIN_VALUE)
    return np.concatenate([hats, np.log(z)[..., None], np.log(srgb_decode(z))[..., None]], -1)


def log_exposures(z: np.ndarray, curves: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """G (3, K) of recorded values z (K,).

    From its `shown` value on, a channel of `curves` (3, 42) rises as the median of all
    channels does: cameras develop them by much the same curve.
    """
    own = (basis(z) @ curves.T).T
    start = (basis(shown) @ curves.T).T  # (3 curves, 3 starts)
    others = np.median(own[:, None] - start[:, :, None], axis=0)  # (3 starts, K)
    return np.where(z > shown[:, None], np.diag(start)[:, None] + others, own)


def response_of(curves: np.ndarray, top: Top, num: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """x (num,), even in x^(1/2.2), and the response y (3, num) that ends at (1, 1).

    It is exp(G - G(1)), made monotone and inverted, of `curves` (3, 42). Where G falls,
    it is replaced by the mean of its upper and lower monotone envelopes.
    """
    z = np.linspace(0, HIGH, 1025)[1:]
    x = np.linspace(0, 1, num) ** GAMMA
    tie_breaker = np.linspace(-1e-9, 0, len(z))  # makes the exposures strictly rising
    y = []
    for g, level in zip(log_exposures(z, curves, top.shown), top.level, strict=True):
        upper = np.maximum.accumulate(g)
        lower = np.minimum.accumulate(g[::-1])[::-1]
        rising = (upper + lower) / 2
        exposure = np.exp(np.minimum(rising - level, -1e-6) + tie_breaker)  # below 1
        knots = np.concatenate([[0], exposure, [1]])
        y.append(np.interp(x, knots, np.concatenate([[0], z, [1]])))
    return x, np.stack(y)
