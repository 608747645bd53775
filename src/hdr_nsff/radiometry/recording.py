"""What a camera does to radiance (docs/method.md#eq-9 and #eq-10, forwards).

    rgb = g(clip(2^ev * white_balance * vignette * radiance + noise))

in 8 bits. Used to make footage whose truth is known; nothing that trains reads it.

A response curve is a list of points (x, y) per channel, ends fixed at (0, 0) and (1,
1), linear between them; x is the clipped sensor exposure in [0, 1]. The 256 points of a
named camera are evenly spaced in x^(1/2.2), so that the darks of a short exposure are
resolved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.geometry import pinhole
from hdr_nsff.maths.color import srgb_encode

POINTS = 256
LOG_GAIN = 250.0  # of the log curve ln(1 + gain x) / ln(1 + gain)
# (gamma, contrast of the S-curve, lift of the shoulder) of red, green, blue: every
# channel its own, as film has it
FILM = ((1.95, 0.42, 0.10), (2.10, 0.36, 0.12), (2.30, 0.28, 0.15))


@dataclass(frozen=True)
class Curve:
    """A sampled response, increasing, from (0, 0) to (1, 1)."""

    x: np.ndarray  # (N,) sensor exposure in [0, 1]
    y: np.ndarray  # (3, N) recorded value in [0, 1], per channel

    def apply(self, exposure: np.ndarray) -> np.ndarray:
        """Recorded values (..., 3) in [0, 1] of sensor exposures (..., 3), clipped."""
        return np.stack([np.interp(exposure[..., c], self.x, self.y[c]) for c in range(3)], -1)

    def invert(self, rgb: np.ndarray) -> np.ndarray:
        """Sensor exposures (..., 3) in [0, 1] of recorded values (..., 3)."""
        return np.stack([np.interp(rgb[..., c], self.y[c], self.x) for c in range(3)], -1)


@dataclass(frozen=True)
class Noise:
    """Noise of the sensor: variance `read^2 + shot * exposure`, in units where 1
    saturates.
    """

    read: float = 1e-3  # standard deviation of the read-out: 6 electrons of a full well of 6000
    shot: float = 1 / 6000  # one over the electrons that fill the well


def response_curve(name: str) -> Curve:
    """A camera's response by name.

    "film" (an S-curve, different per channel; not a plain gamma), "log" (as of video
    cameras: equal steps for equal ratios, except for the darkest), "gamma" (2.2) or
    "srgb". InputError for any other name.
    """
    t = np.linspace(0, 1, POINTS)
    x = t**2.2
    match name:
        case "film":
            y = np.stack([film(x, *channel) for channel in FILM])
        case "gamma":
            y = np.stack([t] * 3)
        case "srgb":
            y = np.stack([srgb_encode(x)] * 3)
        case "log":
            y = np.stack([np.log1p(LOG_GAIN * x) / np.log1p(LOG_GAIN)] * 3)
        case _:
            raise InputError(f"--response {shorten(name)!r}: unknown; use film, log, gamma or srgb")
    return Curve(x, y)


def film(x: np.ndarray, gamma: float, contrast: float, lift: float) -> np.ndarray:
    """A response with a toe and a shoulder: a gamma curve u, steepened in the middle by
    a sine, lifted by `lift u (1 - u)`.

    Its derivative by u, `1 - contrast cos(2 pi u) + lift (1 - 2 u)`, is positive for
    contrast + lift < 1.
    """
    u = x ** (1 / gamma)
    return u - contrast * np.sin(2 * np.pi * u) / (2 * np.pi) + lift * u * (1 - u)


def vignette(height: int, width: int, K: np.ndarray, strength: float) -> np.ndarray:
    """The share of light (H, W, 1) that the lens of a camera `K` (3, 3) passes to each
    pixel, relative to the axis.

    The cos^4 law of the angle to the axis at `strength` 1, no falloff at 0.
    """
    return light_share(pinhole.pixel_centers(height, width), K, strength)


def light_share(pixels: np.ndarray, K: np.ndarray, strength: float) -> np.ndarray:
    """The same (..., 1) along the rays through `pixels` (..., 2)."""
    rays = pinhole.camera_rays(pixels, K)
    squared_length = (rays**2).sum(-1, keepdims=True)  # 1 / cos^2
    return 1 - strength * (1 - squared_length**-2.0)


def record(
    radiance: np.ndarray,
    ev: float,
    white_balance: tuple[float, float, float],
    response: Curve,
    noise: Noise | None,
    rng: np.random.Generator,
    transmission: np.ndarray | float = 1.0,
) -> np.ndarray:
    """The frame a camera records of linear `radiance` (H, W, 3): float32 rgb in [0, 1]
    on multiples of 1/255.

    `ev` is log2 exposure relative to the exposure at which radiance 1 saturates;
    `noise` None is a perfect sensor; `transmission` (H, W, 1) of the lens, see
    `vignette`.
    """
    gain = 2.0**ev * np.asarray(white_balance)
    exposure = np.asarray(radiance, np.float64) * gain * transmission
    if noise is not None:
        variance = noise.read**2 + noise.shot * np.clip(exposure, 0, 1)
        exposure = exposure + rng.normal(size=exposure.shape) * np.sqrt(variance)
    return (np.rint(response.apply(exposure) * 255) / 255).astype(np.float32)
