"""Many noisy disparity maps of one static scene into one good map per frame: carry the
neighbors' maps over, let them vote, and fill what nobody saw along the image's edges.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.jit import jit

AGREE = 0.03  # disparities within this share of the median are the same surface
REACH = 4  # pixels a cleaned value may come from
ALIKE = 0.1  # sum of rgb differences at which a pixel speaks e times less for another


@jit(nogil=True, fastmath=True)
def carry_over(disparity, weight, rotation, shift, result, result_weight):
    """Splat one frame's map into another: pixels go to `rotation` (x, y, 1) + disparity
    `shift`, whose third entry is z * disparity.

    Each lands on the nearest pixel; the nearest surface wins. `result_weight` is 0
    where nothing landed.
    """
    h, w = result.shape
    result[:] = 0
    result_weight[:] = 0
    for y in range(disparity.shape[0]):
        for x in range(disparity.shape[1]):
            if weight[y, x] <= 0:
                continue
            u, v, d = x + 0.5, y + 0.5, disparity[y, x]
            q = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2] + d * shift[2]
            if q <= 1e-6:
                continue
            px = int(
                np.floor(
                    (rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2] + d * shift[0]) / q
                )
            )
            py = int(
                np.floor(
                    (rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2] + d * shift[1]) / q
                )
            )
            if 0 <= px < w and 0 <= py < h and d / q > result[py, px]:
                result[py, px] = d / q
                result_weight[py, px] = weight[y, x]


@jit(nogil=True, fastmath=True)
def vote(disparities, weights):
    """Weighted median over `n` maps (n, H, W), averaged over those within `AGREE` of
    it: disparity (H, W), weight that agrees (H, W), weight of all (H, W).
    """
    n, h, w = disparities.shape
    fused, agreeing, everything = (
        np.zeros((h, w), np.float32),
        np.zeros((h, w), np.float32),
        np.zeros((h, w), np.float32),
    )
    for y in range(h):
        for x in range(w):
            order = np.argsort(disparities[:, y, x])
            total = np.float32(0)
            for i in range(n):
                total += weights[i, y, x]
            if total <= 0:
                continue
            median, running = np.float32(0), np.float32(0)
            for i in order:
                running += weights[i, y, x]
                if running >= 0.5 * total:
                    median = disparities[i, y, x]
                    break
            mean, agree = np.float32(0), np.float32(0)
            for i in range(n):
                if weights[i, y, x] > 0 and abs(disparities[i, y, x] - median) <= AGREE * median:
                    mean += weights[i, y, x] * disparities[i, y, x]
                    agree += weights[i, y, x]
            fused[y, x], agreeing[y, x], everything[y, x] = mean / agree, agree, total
    return fused, agreeing, everything


@jit(nogil=True, fastmath=True)
def clean(disparity, weight, rgb):
    """Weighted median (H, W) over the pixels around that look alike: depth edges move
    onto image edges, outliers go.

    `weight` (H, W) as found, `rgb` (H, W, 3) in [0, 1]. A pixel without any weight
    around it keeps its value.
    """
    h, w = disparity.shape
    result = disparity.copy()
    values, weights = (
        np.empty((2 * REACH + 1) ** 2, np.float32),
        np.empty((2 * REACH + 1) ** 2, np.float32),
    )
    for y in range(h):
        for x in range(w):
            n, total = 0, np.float32(0)
            for v in range(max(0, y - REACH), min(h, y + REACH + 1)):
                for u in range(max(0, x - REACH), min(w, x + REACH + 1)):
                    difference = np.float32(0)
                    for c in range(3):
                        difference += abs(rgb[y, x, c] - rgb[v, u, c])
                    distance = ((v - y) ** 2 + (u - x) ** 2) / (2.0 * REACH**2)
                    values[n] = disparity[v, u]
                    weights[n] = weight[v, u] * np.exp(-difference / ALIKE - distance)
                    total += weights[n]
                    n += 1
            if total > 0:
                running = np.float32(0)
                for k in np.argsort(values[:n]):
                    running += weights[k]
                    if running >= 0.5 * total:
                        result[y, x] = values[k]
                        break
    return result
