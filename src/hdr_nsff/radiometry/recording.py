"""What a camera does to radiance (METHOD eq. 9-10, forwards): `rgb = g(clip(2^ev *
white_balance * vignette * radiance + noise))`, 8 bits. Used to make footage whose truth
is known; nothing that trains reads it.

A response curve is a list of points (x, y) per channel, ends fixed at (0, 0) and (1,
1), linear between them; x is the clipped sensor exposure in [0, 1]. The 256 points of a
named camera are evenly spaced in x^(1/2.2), so that the darks of a short exposure are
resolved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.errors import InputError

POINTS = 256
LOG_GAIN = 250.0  # of the log curve ln(1 + gain x) / ln(1 + gain)
# (gamma, contrast of the S-curve, lift of the shoulder), red green blue: every channel
# its own, as film has it
FILM = ((1.95, 0.42, 0.10), (2.10, 0.36, 0.12), (2.30, 0.28, 0.15))


@dataclass(frozen=True)
class Curve:
    """A sampled response, increasing, from (0, 0) to (1, 1)."""

    x: np.ndarray  # (N,) sensor exposure in [0, 1]
    y: np.ndarray  # (3, N) recorded value in [0, 1], per channel

    def apply(self, exposure: np.ndarray) -> np.ndarray:
        """Recorded value (..., 3) of a sensor exposure (..., 3); what leaves [0, 1] is
        clipped.
        """
        return np.stack([np.interp(exposure[..., c], self.x, self.y[c]) for c in range(3)], -1)

    def invert(self, rgb: np.ndarray) -> np.ndarray:
        """Sensor exposure (..., 3) in [0, 1] of a recorded value (..., 3)."""
        return np.stack([np.interp(rgb[..., c], self.y[c], self.x) for c in range(3)], -1)


@dataclass(frozen=True)
class Noise:
    """Noise of the sensor: variance `read^2 + shot * exposure`, in units where 1
    saturates.
    """

    read: float = 1e-3  # standard deviation of the read-out: 6 electrons of a full well of 6000
    shot: float = 1 / 6000  # one over the electrons that fill the well


def response_curve(name: str) -> Curve:
    """A named camera: "film" (S-curve, other per channel; not a plain gamma), "log" (as
    of video cameras: equal steps for equal ratios, but for the darkest), "gamma" (2.2)
    or "srgb".
    """
    t = np.linspace(0, 1, POINTS)
    x = t**2.2
    match name:
        case "film":
            y = np.stack([film(x, *channel) for channel in FILM])
        case "gamma":
            y = np.stack([t] * 3)
        case "srgb":
            y = np.stack([np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)] * 3)
        case "log":
            y = np.stack([np.log1p(LOG_GAIN * x) / np.log1p(LOG_GAIN)] * 3)
        case _:
            raise InputError(f"response {name!r}: unknown; use film, log, gamma or srgb")
    return Curve(x, y)


def film(x: np.ndarray, gamma: float, contrast: float, lift: float) -> np.ndarray:
    """A curve with a toe and a shoulder: a gamma curve u, steepened in the middle by a
    sine, lifted by `lift u (1 - u)`.

    Increasing for contrast + lift < 1, as du/du = 1 - contrast cos(2 pi u) + lift (1 -
    2u).
    """
    u = x ** (1 / gamma)
    return u - contrast * np.sin(2 * np.pi * u) / (2 * np.pi) + lift * u * (1 - u)


def vignette(height: int, width: int, K: np.ndarray, strength: float) -> np.ndarray:
    """What a lens passes to each pixel relative to the axis, (H, W, 1): the cos^4 law
    of the angle to the axis of a camera `K` (3, 3) at `strength` 1, nothing at 0.
    """
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    )
    return (1 - strength * (1 - (1 + x**2 + y**2) ** -2.0))[..., None]


def record(
    radiance: np.ndarray,
    ev: float,
    white_balance: tuple[float, float, float],
    response: Curve,
    noise: Noise | None,
    rng: np.random.Generator,
    passed: np.ndarray | float = 1.0,
) -> np.ndarray:
    """The frame a camera records of linear `radiance` (H, W, 3): float32 rgb in [0, 1]
    on multiples of 1/255.

    `ev` is log2 exposure relative to the exposure at which radiance 1 saturates;
    `noise` None is a perfect sensor; `passed` (H, W, 1) is what the lens lets through,
    see `vignette`.
    """
    exposure = np.asarray(radiance, np.float64) * (2.0**ev * np.asarray(white_balance)) * passed
    if noise is not None:
        exposure = exposure + rng.normal(size=exposure.shape) * np.sqrt(
            noise.read**2 + noise.shot * np.clip(exposure, 0, 1)
        )
    return (np.rint(response.apply(exposure) * 255) / 255).astype(np.float32)
