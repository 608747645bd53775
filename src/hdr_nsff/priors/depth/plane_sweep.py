"""Plane sweep: inverse depth of every pixel of one frame from other frames with known
poses.

For each candidate disparity (1 / z-depth) the other frames are warped as if everything
lay there, compared with the frame by normalized cross-correlation (blind to exposure),
and the costs are made smooth along eight scan directions (semi-global matching,
Hirschmueller 2008) before the best candidate wins. Written in numba without the GIL:
one thread per frame.
"""

from __future__ import annotations

import cv2
import numpy as np

from hdr_nsff.core.jit import jit
from hdr_nsff.radiometry.common_range import LUMA
from hdr_nsff.scene.posed_video import PosedVideo

RADIUS = 2  # of the correlation window, pixels
SHIFTS = np.ones(
    (5, 5), np.uint8
)  # a pixel may also use the best window that still holds it: sharper edges of objects
NOISE = 1e-4  # variance of gray values that carries no information; grays in [0, 1]
BEST = 0.75  # share of the views that counts: those that match worst may be occluded
UNKNOWN = 1.0  # cost where no view can tell: no correlation
STEP_PENALTY, JUMP_PENALTY = 0.1, 2.0  # of a neighbor one candidate off, and of any further jump
EDGE = 20.0  # how much an image edge lowers the price of a jump

OUTSIDE = 3  # obstacle where a view does not look at all


@jit(nogil=True, fastmath=True)
def box(image, radius, result):
    """Mean over a square window, edges repeated less often: running sums along rows,
    then columns.
    """
    h, w = image.shape
    rows = np.empty((h, w), np.float32)
    for y in range(h):
        total, n = np.float32(0), 0
        for x in range(min(radius, w)):
            total += image[y, x]
            n += 1
        for x in range(w):
            if x + radius < w:
                total += image[y, x + radius]
                n += 1
            if x - radius - 1 >= 0:
                total -= image[y, x - radius - 1]
                n -= 1
            rows[y, x] = total / n
    totals = np.zeros(w, np.float32)
    n = 0
    for y in range(min(radius, h)):
        totals += rows[y]
        n += 1
    for y in range(h):
        if y + radius < h:
            totals += rows[y + radius]
            n += 1
        if y - radius - 1 >= 0:
            totals -= rows[y - radius - 1]
            n -= 1
        result[y] = totals / np.float32(n)


@jit(nogil=True, fastmath=True)
def warp(image, obstacles, rotation, shift, disparity, warped, met):
    """`image` read where the pixels of the first frame fall if all lie at `disparity`;
    `met`: the `obstacles` there, `OUTSIDE`.
    """
    h, w = image.shape
    for y in range(met.shape[0]):
        for x in range(met.shape[1]):
            u, v = x + 0.5, y + 0.5
            q = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2] + disparity * shift[2]
            px = (
                rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2] + disparity * shift[0]
            ) / q - 0.5
            py = (
                rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2] + disparity * shift[1]
            ) / q - 0.5
            inside = q > 1e-6 and px >= 0 and py >= 0 and px <= w - 1 and py <= h - 1
            if not inside:
                px, py = min(max(px, 0.0), w - 1.0), min(max(py, 0.0), h - 1.0)
            x0, y0 = min(int(px), w - 2), min(int(py), h - 2)
            fx, fy = np.float32(px - x0), np.float32(py - y0)
            top = image[y0, x0] + fx * (image[y0, x0 + 1] - image[y0, x0])
            bottom = image[y0 + 1, x0] + fx * (image[y0 + 1, x0 + 1] - image[y0 + 1, x0])
            warped[y, x] = top + fy * (bottom - top)
            met[y, x] = obstacles[int(py + 0.5), int(px + 0.5)] if inside else OUTSIDE


@jit(nogil=True, fastmath=True)
def correlation_cost(gray, mean, square, other, scratch, result):
    """1 - normalized cross-correlation of two images over the window, per pixel, into
    `result`; in [0, 2].
    """
    other_mean, other_square, product = scratch
    box(other, RADIUS, other_mean)
    box(other * other, RADIUS, other_square)
    box(gray * other, RADIUS, product)
    for y in range(gray.shape[0]):
        for x in range(gray.shape[1]):
            variance = square[y, x] - mean[y, x] ** 2 + NOISE
            other_variance = other_square[y, x] - other_mean[y, x] ** 2 + NOISE
            covariance = product[y, x] - mean[y, x] * other_mean[y, x]
            result[y, x] = 1.0 - covariance / np.sqrt(variance * other_variance)


@jit(nogil=True, fastmath=True)
def best_share(values, n):
    """Mean of the lowest `BEST` share of the first `n` values, which are sorted in
    place; `UNKNOWN` if there are none.
    """
    if n == 0:
        return np.float32(UNKNOWN)
    for i in range(1, n):
        value, j = values[i], i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    count = max(1, int(np.ceil(BEST * n)))
    total = np.float32(0)
    for i in range(count):
        total += values[i]
    return total / np.float32(count)


@jit(nogil=True, fastmath=True)
def matching_costs(grays, others, tolerance, obstacles, rotations, shifts, disparities):
    """Costs (H, W, D) of each candidate disparity over `n` views.

    `grays` (n, H, W): the frame, cut to the range each view recorded too; `others` (n,
    H, W) the views. A view counts for a pixel where its obstacle (n, H, W) is below the
    pixel's `tolerance` (n, H, W): see `obstacles_of`. Pixels go to `rotations` (n, 3,
    3) (x, y, 1) + disparity `shifts` (n, 3), homogeneous.
    """
    n, h, w = grays.shape
    costs = np.empty((h, w, len(disparities)), np.float32)
    means, squares = np.empty((n, h, w), np.float32), np.empty((n, h, w), np.float32)
    for i in range(n):
        box(grays[i], RADIUS, means[i])
        box(grays[i] * grays[i], RADIUS, squares[i])
    scratch = np.empty((3, h, w), np.float32)
    warped, cost, met = (
        np.empty((h, w), np.float32),
        np.empty((n, h, w), np.float32),
        np.empty((n, h, w), np.uint8),
    )
    values = np.empty(n, np.float32)
    for k in range(len(disparities)):
        for i in range(n):
            warp(others[i], obstacles[i], rotations[i], shifts[i], disparities[k], warped, met[i])
            correlation_cost(grays[i], means[i], squares[i], warped, scratch, cost[i])
        for y in range(h):
            for x in range(w):
                count = 0
                for i in range(n):
                    if met[i, y, x] < tolerance[i, y, x]:
                        values[count] = cost[i, y, x]
                        count += 1
                costs[y, x, k] = best_share(values, count)
    return costs


@jit(nogil=True, fastmath=True)
def aggregate(costs, guide):
    """Semi-global matching: the sum over eight directions of the cheapest path to each
    candidate (H, W, D).

    A jump between neighbors costs less where the gray `guide` (H, W) has an edge.
    """
    h, w, d = costs.shape
    total = np.zeros((h, w, d), np.float32)
    step = np.float32(STEP_PENALTY)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        path = np.zeros((2, w, d), np.float32)
        lowest = np.zeros((2, w), np.float32)
        for row in range(h):
            y = row if dy >= 0 else h - 1 - row
            now = row & 1
            before = now if dy == 0 else 1 - now
            for column in range(w):
                x = column if dx >= 0 else w - 1 - column
                from_x = x - dx
                start = from_x < 0 or from_x >= w or (dy != 0 and row == 0)
                best = np.float32(1e30)
                jump = np.float32(0)
                if not start:
                    edge = abs(guide[y, x] - guide[y - dy, from_x])
                    jump = lowest[before, from_x] + max(
                        step, np.float32(JUMP_PENALTY / (1.0 + EDGE * edge))
                    )
                for k in range(d):
                    value = costs[y, x, k]
                    if not start:
                        cheapest = min(path[before, from_x, k], jump)
                        if k > 0:
                            cheapest = min(cheapest, path[before, from_x, k - 1] + step)
                        if k < d - 1:
                            cheapest = min(cheapest, path[before, from_x, k + 1] + step)
                        value += cheapest - lowest[before, from_x]
                    path[now, x, k] = value
                    total[y, x, k] += value
                    best = min(best, value)
                lowest[now, x] = best
    return total


def sweep(
    clip: PosedVideo, i: int, views: list[int], disparities: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity (H, W) of frame `i` of the static scene, and how well it matched (H, W)
    in [0, 1], 0 where no view could tell.
    """
    if not views:
        return np.full(clip.size, disparities.mean(), np.float32), np.zeros(clip.size, np.float32)
    grays, others, tolerance, obstacles, geometry = [], [], [], [], []
    for j in views:
        low, high = (
            np.maximum(clip.ranges[i][0], clip.ranges[j][0]),
            np.minimum(clip.ranges[i][1], clip.ranges[j][1]),
        )
        grays.append(
            np.clip(clip.video[i], low, high) @ LUMA
        )  # what saturates in one frame looks saturated in the other too
        others.append(np.clip(clip.video[j], low, high) @ LUMA)
        frozen = bool(
            clip.times[i] == clip.times[j]
        )  # two cameras at one instant: nothing moves between them
        obstacles.append(obstacles_of(clip, j, frozen))
        tolerance.append(np.array([1, 2, 0], np.uint8)[obstacles_of(clip, i, frozen)])
        geometry.append(clip.transfer(i, j))
    turns, shifts = (np.stack(x) for x in zip(*geometry, strict=True))
    costs = matching_costs(
        *(np.stack(x) for x in (grays, others, tolerance, obstacles)), turns, shifts, disparities
    )
    return winner(costs, clip.video[i] @ LUMA, disparities)


def obstacles_of(clip: PosedVideo, i: int, frozen: bool) -> np.ndarray:
    """0 where frame `i` shows the static scene, 1 where it moves (unless `frozen`), 2
    where clipped: (H, W) uint8.

    Static pixels are compared with static ones only. Pixels in a moving mask may match
    anything: if one depth fits many views all the same, the mask was wrong there.
    """
    moving = np.zeros_like(clip.moving[i]) if frozen else clip.moving[i]
    return np.where(clip.clipped[i], 2, moving).astype(np.uint8)


def winner(
    costs: np.ndarray, guide: np.ndarray, disparities: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity (H, W), refined between candidates by a parabola, and 1 - its cost (H,
    W), 0 where all candidates cost the same.
    """
    best_window = np.stack(
        [cv2.erode(np.ascontiguousarray(c), SHIFTS) for c in np.moveaxis(costs, -1, 0)], -1
    )
    total = aggregate((costs + best_window) / 2, np.ascontiguousarray(guide, np.float32))
    middle = np.clip(total.argmin(-1), 1, len(disparities) - 2)[..., None]
    low, at, high = (np.take_along_axis(total, middle + o, -1)[..., 0] for o in (-1, 0, 1))
    offset = np.clip((low - high) / (2 * np.maximum(low - 2 * at + high, 1e-6)), -1, 1)
    disparity = disparities[0] + (middle[..., 0] + offset) * (disparities[1] - disparities[0])
    matched = np.clip(1 - np.take_along_axis(costs, middle, -1)[..., 0], 0, 1)
    return disparity.astype(np.float32), np.where(np.ptp(costs, axis=-1) > 1e-6, matched, 0).astype(
        np.float32
    )
