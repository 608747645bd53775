"""Many noisy disparity maps of one static scene fused into one clean map per frame.

The maps of neighboring frames are warped into the frame and vote (weighted median, as
in Merrell et al. 2007); then depth edges are moved onto image edges by a joint weighted
median filter (Ma et al. 2013). Numba without the GIL: one thread per frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.jit import jit


@dataclass(frozen=True)
class FuseTuning:
    """Hand-chosen on rendered scenes."""

    # share of the disparity: values this close to the median are the same surface
    max_disparity_difference: float = 0.03
    window_px: int = 4  # a cleaned value comes from at most this far along x and y
    # sum of rgb differences at which another pixel's weight falls to 1 / e
    rgb_scale: float = 0.1


@jit(nogil=True, fastmath=True)
def warp_disparity(disparity, weight, rotation, shift, warped, warped_weight):
    """Splat one frame's map into another: pixels go to `rotation` (x, y, 1) + disparity
    `shift`, homogeneous, whose third entry is z * disparity (see `pinhole.transfer`).

    `disparity`, `weight` (H, W); each pixel lands on the nearest pixel of `warped`, and
    the nearest surface wins. `warped_weight` is 0 where nothing landed.
    """
    height, width = warped.shape
    warped[:] = 0
    warped_weight[:] = 0
    for y in range(disparity.shape[0]):
        for x in range(disparity.shape[1]):
            if weight[y, x] <= 0:
                continue
            u, v = x + 0.5, y + 0.5
            d = disparity[y, x]
            q = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2] + d * shift[2]
            if q <= 1e-6:
                continue
            qx = rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2] + d * shift[0]
            qy = rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2] + d * shift[1]
            px = int(np.floor(qx / q))
            py = int(np.floor(qy / q))
            inside = 0 <= px < width and 0 <= py < height
            if inside and d / q > warped[py, px]:
                warped[py, px] = d / q
                warped_weight[py, px] = weight[y, x]


@jit(nogil=True, fastmath=True)
def weighted_median(values, weights, total):
    """The lowest of the `values` (n,) up to which half of the `total` of their
    `weights` (n,) lies. Both are reordered.

    Values are parted around one of them, and the part with the median once more, until
    one is left (Hoare's selection, with weights in place of numbers of values).
    """
    low, high = 0, len(values) - 1
    below = np.float32(0)  # weight of the values before `low`
    while low < high:
        pivot = values[(low + high) // 2]
        i, j, left = low, high, np.float32(0)  # weight of the values from `low` to before `i`
        while i <= j:
            while values[i] < pivot:
                left += weights[i]
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                weights[i], weights[j] = weights[j], weights[i]
                left += weights[i]
                i += 1
                j -= 1
        between = weights[i - 1] if j < i - 1 else np.float32(0)  # of one equal to the pivot
        if below + left - between >= 0.5 * total:
            high = j
        elif below + left >= 0.5 * total:
            return pivot
        else:
            below += left
            low = i
    return values[min(low, len(values) - 1)]


@jit(nogil=True, fastmath=True)
def vote(disparities, weights, max_difference):
    """Weighted median over `n` maps (n, H, W), averaged over those within the share
    `max_difference` of it.

    Returns disparity (H, W), the weight that agrees (H, W), and the weight of all.
    """
    n, height, width = disparities.shape
    values, shares = np.empty(n, np.float32), np.empty(n, np.float32)
    fused = np.zeros((height, width), np.float32)
    agreeing_weight = np.zeros((height, width), np.float32)
    total_weight = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            total = np.float32(0)
            for i in range(n):
                values[i], shares[i] = disparities[i, y, x], weights[i, y, x]
                total += shares[i]
            if total <= 0:
                continue
            median = weighted_median(values, shares, total)
            mean, agreeing = np.float32(0), np.float32(0)
            for i in range(n):
                difference = abs(disparities[i, y, x] - median)
                if weights[i, y, x] > 0 and difference <= max_difference * median:
                    mean += weights[i, y, x] * disparities[i, y, x]
                    agreeing += weights[i, y, x]
            fused[y, x] = mean / agreeing
            agreeing_weight[y, x] = agreeing
            total_weight[y, x] = total
    return fused, agreeing_weight, total_weight


@jit(nogil=True, fastmath=True)
def joint_median(disparity, weight, rgb, radius, rgb_scale):
    """Weighted median (H, W) over the pixels around that look alike: depth edges move
    onto image edges, outliers disappear.

    `weight` (H, W) of the `disparity` (H, W), `rgb` (H, W, 3) in [0, 1]; the window
    reaches `radius` pixels, and pixels that differ by `rgb_scale` weigh 1 / e. A pixel
    without any weight around it keeps its value.
    """
    height, width = disparity.shape
    result = disparity.copy()
    side = 2 * radius + 1
    values, weights = np.empty(side**2, np.float32), np.empty(side**2, np.float32)
    distances = np.empty((side, side), np.float32)  # of the window's pixels, squared
    for v in range(side):
        for u in range(side):
            distances[v, u] = ((v - radius) ** 2 + (u - radius) ** 2) / (2.0 * radius**2)
    per_rgb = np.float32(1 / rgb_scale)
    for y in range(height):
        for x in range(width):
            n, total = 0, np.float32(0)
            for v in range(max(0, y - radius), min(height, y + radius + 1)):
                for u in range(max(0, x - radius), min(width, x + radius + 1)):
                    difference = np.float32(0)
                    for c in range(3):
                        difference += abs(rgb[y, x, c] - rgb[v, u, c])
                    distance = distances[v - y + radius, u - x + radius]
                    values[n] = disparity[v, u]
                    weights[n] = weight[v, u] * np.exp(-difference * per_rgb - distance)
                    total += weights[n]
                    n += 1
            if total > 0:
                result[y, x] = weighted_median(values[:n], weights[:n], total)
    return result
