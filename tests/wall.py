"""A wall in closed form, recorded by several cameras, for tests of the response."""

import math

import numpy as np

from hdr_nsff.radiometry.static_samples import ResponseView

U = np.linspace(0, 1, 2001)
X = U**2.2
GAMMA22 = np.stack([U] * 3)
SRGB = np.stack([np.where(X <= 0.0031308, 12.92 * X, 1.055 * X ** (1 / 2.4) - 0.055)] * 3)
S_CURVE = np.stack(
    [U - k * np.sin(2 * np.pi * U) / (2 * np.pi) for k in (0.2, 0.3, 0.4)]
)  # other per channel
EV = [-4.0, -2.0, 0.0]


def record(exposure, curve, rng):
    """8 bits of a noisy sensor: (..., 3)."""
    noisy = exposure + rng.standard_normal(exposure.shape) * np.sqrt(
        1e-6 + np.clip(exposure, 0, 1) / 6000
    )
    z = np.stack([np.interp(np.clip(noisy[..., c], 0, 1), X, curve[c]) for c in range(3)], -1)
    return np.rint(z * 255) / 255


def rmse(fit_x, fit_y, curve):
    return math.sqrt(np.mean([(np.interp(X, fit_x, fit_y[c]) - curve[c]) ** 2 for c in range(3)]))


K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
HEIGHT, WIDTH = 48, 64


def wall(x, y):
    """Radiance of a wall at z = 4: a smooth pattern over three decades."""
    level = 2 ** (3.2 * np.sin(0.9 * x) + 2.4 * np.cos(1.1 * y) - 3)
    return np.stack([level, level * 2 ** (0.5 * np.sin(x + y)), level * 0.8], -1)


def wall_view(index, curve, rng, depth_noise=0.0, shift=0.06, gain=1.0):
    """Camera `index` beside the others, before the wall; a square that moves is marked
    as moving.
    """
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x = (column - K[0, 2]) / K[0, 0] * 4 + shift * index
    y = (row - K[1, 2]) / K[1, 1] * 4
    moving = np.zeros((HEIGHT, WIDTH), bool)
    moving[10:20, 3 * index : 3 * index + 10] = True
    radiance = np.where(moving[..., None], 3.0, wall(x, y))
    c2w = np.concatenate([np.eye(3), [[shift * index], [0], [0]]], 1)
    disparity = 0.25 * (1 + depth_noise * rng.standard_normal((HEIGHT, WIDTH)))
    bracket = index % 3
    return ResponseView(
        record(radiance * gain * 2.0 ** EV[bracket], curve, rng),
        bracket,
        float(index),
        K,
        c2w,
        disparity,
        None,
        moving,
    )
