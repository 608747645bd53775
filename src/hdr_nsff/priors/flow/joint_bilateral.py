"""Means of the cells around a position, by distance and by likeness of color.

Joint bilateral upsampling (Kopf et al. 2007). Numba without the GIL.
"""

from __future__ import annotations

import math

import numpy as np

from hdr_nsff.core.jit import jit

MAX_COLOR_EXPONENT = 20.0  # keeps the weight of unlike cells above zero, so that none is empty


def joint_bilateral_mean(
    values: np.ndarray,
    valid: np.ndarray,
    cell_rgb: np.ndarray,
    positions: np.ndarray,
    rgb: np.ndarray,
    radius: int,
    color_sigma: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The mean (H, W, C) of `values` of cells around `positions`, and its weight.

    A cell counts by its distance, at most about `radius` cells, and by the likeness of
    its `cell_rgb` (h, w, 3) to `rgb` (H, W, 3). Only `valid` (h, w) cells enter, so no
    value from beyond an edge is mixed in; the others may be NaN. `values` are (h, w,
    C), `positions` (H, W, 2) in cells; the mean and its weight (H, W) are 0 where no
    cell counts.
    """
    size = positions.shape[:2]
    mean = np.zeros((*size, values.shape[-1]), np.float32)
    weights = np.zeros(size, np.float32)
    arrays = (np.ascontiguousarray(a, np.float32) for a in (values, cell_rgb, positions, rgb))
    add_cells(*arrays, np.ascontiguousarray(valid), radius, color_sigma, mean, weights)
    mean /= np.maximum(weights, np.float32(1e-12))[..., None]
    return mean, weights


@jit(nogil=True, error_model="numpy")
def add_cells(values, cell_rgb, positions, rgb, valid, radius, color_sigma, total, weights):
    """Add weighted `values` (h, w, C) to `total` (H, W, C), and their weights to
    `weights` (H, W); for the arguments see `joint_bilateral_mean`.
    """
    variance = np.float32(color_sigma**2)
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            u, v = positions[y, x, 0], positions[y, x, 1]
            column, row = int(np.rint(u)), int(np.rint(v))
            for i in range(max(row - radius, 0), min(row + radius + 1, valid.shape[0])):
                for j in range(max(column - radius, 0), min(column + radius + 1, valid.shape[1])):
                    if not valid[i, j]:
                        continue
                    unlike = np.float32(0)
                    for c in range(3):
                        unlike += (cell_rgb[i, j, c] - rgb[y, x, c]) ** 2
                    exponent = min(unlike / variance, np.float32(MAX_COLOR_EXPONENT))
                    distance = (j - np.float64(u)) ** 2 + (i - np.float64(v)) ** 2
                    weight = np.float32(math.exp(-0.5 * (distance / (radius / 2) ** 2 + exponent)))
                    weights[y, x] += weight
                    for c in range(total.shape[2]):
                        total[y, x, c] += weight * values[i, j, c]
