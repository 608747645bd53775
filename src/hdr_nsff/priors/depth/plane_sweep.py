"""Plane sweep (Collins 1996): disparity of every pixel of one frame from other frames
with known poses.

For each candidate disparity (1 / z-depth) the other frames are warped as if everything
lay there and compared with the frame by normalized cross-correlation, which does not
depend on exposure. The costs are made smooth along eight scan directions (semi-global
matching, Hirschmueller 2008) before the best candidate wins. Numba without the GIL: one
thread per frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from hdr_nsff.core.jit import jit
from hdr_nsff.radiometry.common_range import LUMA
from hdr_nsff.scene.posed_video import PosedVideo

UNKNOWN_COST = 1.0  # where no view contributes: no correlation
LEFT_OUT = np.float32(9)  # above every cost
# what a pixel shows, see `obstacle_map`
STATIC, MOVING = 0, 1
CLIPPED, OUTSIDE = 2, 3
# by what the pixel itself shows: obstacles of a view from this one on do not count
TOLERANCE = np.array([MOVING, CLIPPED, STATIC], np.uint8)


@dataclass(frozen=True)
class PlaneSweepTuning:
    """Matching costs and smoothness (hand-chosen on rendered scenes)."""

    radius_px: int = 2  # of the correlation window
    noise_variance: float = 1e-4  # of gray values in [0, 1] that carries no information
    # share of the views that counts: those that match worst may be occluded (Kang et
    # al. 2001: 0.5)
    best_view_share: float = 0.75
    step_penalty: float = 0.1  # cost of a neighbor one candidate off ...
    jump_penalty: float = 2.0  # ... and of any further jump (P1 and P2 of Hirschmueller)
    # a gray difference d between neighbors divides the cost of a jump by 1 + this d
    edge_weight: float = 20.0


@jit(nogil=True, fastmath=True)
def box(image, radius, result):
    """Mean (H, W) over a square window, of its pixels inside the image: running sums
    along rows, then columns.
    """
    height, width = image.shape
    rows = np.empty((height, width), np.float32)
    for y in range(height):
        total, n = np.float32(0), 0
        for x in range(min(radius, width)):
            total += image[y, x]
            n += 1
        for x in range(width):
            if x + radius < width:
                total += image[y, x + radius]
                n += 1
            if x - radius - 1 >= 0:
                total -= image[y, x - radius - 1]
                n -= 1
            rows[y, x] = total / n
    totals = np.zeros(width, np.float32)
    n = 0
    for y in range(min(radius, height)):
        totals += rows[y]
        n += 1
    for y in range(height):
        if y + radius < height:
            totals += rows[y + radius]
            n += 1
        if y - radius - 1 >= 0:
            totals -= rows[y - radius - 1]
            n -= 1
        result[y] = totals / np.float32(n)


@jit(nogil=True, fastmath=True, error_model="numpy")
def warp(image, obstacles, rotation, shift, disparity, warped, met):
    """`image` (H, W) read, bilinearly, where the pixels of the first frame fall if all
    lie at `disparity`, into `warped`; the `obstacles` there, or `OUTSIDE`, into `met`.
    """
    height, width = image.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    half, nearest = np.float32(0.5), np.float32(1e-6)
    step_x, step_y = np.float32(rotation[0, 0]), np.float32(rotation[1, 0])
    step_q = np.float32(rotation[2, 0])
    column = np.empty(met.shape[1], np.float32)
    row = np.empty(met.shape[1], np.float32)
    for y in range(met.shape[0]):
        # where the row's first pixel falls, homogeneous, in units of its depth
        u, v = 0.5, y + 0.5
        first = rotation[:, 0] * u + rotation[:, 1] * v + rotation[:, 2] + disparity * shift
        first_x, first_y = np.float32(first[0]), np.float32(first[1])
        first_q = np.float32(first[2])
        for x in range(len(column)):  # behind the camera is outside, too
            q = first_q + np.float32(x) * step_q
            at = (first_x + np.float32(x) * step_x) / q - half
            column[x] = at if q > nearest else np.float32(-1)
        for x in range(len(row)):
            q = first_q + np.float32(x) * step_q
            at = (first_y + np.float32(x) * step_y) / q - half
            row[x] = at if q > nearest else np.float32(-1)
        for x in range(len(row)):
            px, py = column[x], row[x]
            inside = px >= 0 and py >= 0 and px <= right and py <= bottom
            px = min(max(px, np.float32(0)), right)
            py = min(max(py, np.float32(0)), bottom)
            # unsigned: numba takes negative indices for counted from the end
            x0, y0 = np.uint64(min(px, right - 1)), np.uint64(min(py, bottom - 1))
            x1, y1 = x0 + np.uint64(1), y0 + np.uint64(1)
            fx, fy = px - np.float32(x0), py - np.float32(y0)
            upper = image[y0, x0] + fx * (image[y0, x1] - image[y0, x0])
            lower = image[y1, x0] + fx * (image[y1, x1] - image[y1, x0])
            warped[y, x] = upper + fy * (lower - upper)
            found = obstacles[np.uint64(py + half), np.uint64(px + half)]
            met[y, x] = found if inside else OUTSIDE


@jit(nogil=True, fastmath=True, error_model="numpy")
def correlation_cost(gray, mean, square, other, radius, noise_variance, result):
    """1 - normalized cross-correlation of two images over the window, per pixel, into
    `result`; in [0, 2].

    `mean`, `square` (H, W): means of `gray` and of its square. Sums go along columns,
    then along rows, each in a loop of its own, which the compiler does many pixels at a
    time.
    """
    height, width = gray.shape
    columns = np.zeros((3, width + 2 * radius), np.float32)  # of rows y - radius to y + radius
    sums = np.empty((3, width), np.float32)  # over the window: other, its square, the product
    shares = pixel_shares(width, radius)
    noise = np.float32(noise_variance)
    for y in range(-radius, height):
        if y + radius < height:
            add_row(columns, gray[y + radius], other[y + radius], np.float32(1), radius)
        if y - radius > 0:
            add_row(columns, gray[y - radius - 1], other[y - radius - 1], np.float32(-1), radius)
        if y < 0:
            continue
        for i in range(3):
            total = sums[i]
            total[:] = 0
            for k in range(2 * radius + 1):
                shifted = columns[i, k : k + width]
                for x in range(width):
                    total[x] += shifted[x]
        rows = min(y, radius) + min(height - 1 - y, radius) + 1
        other_sum, square_sum, product_sum = sums
        for x in range(width):
            each = shares[x] / np.float32(rows)
            other_mean = other_sum[x] * each
            variance = square[y, x] - mean[y, x] * mean[y, x] + noise
            other_variance = square_sum[x] * each - other_mean * other_mean + noise
            covariance = product_sum[x] * each - mean[y, x] * other_mean
            # math's root, unlike numpy's, is taken of many pixels at a time
            result[y, x] = 1 - covariance / math.sqrt(variance * other_variance)


@jit(nogil=True, fastmath=True)
def pixel_shares(size, radius):
    """The share (`size`,) of one pixel among those of a row within `radius` of each."""
    shares = np.empty(size, np.float32)
    for x in range(size):
        shares[x] = 1 / (min(x, radius) + min(size - 1 - x, radius) + 1)
    return shares


@jit(nogil=True, fastmath=True)
def add_row(columns, gray, other, sign, radius):
    """Add a row (W,) of two images to the sums `columns` (3, W + 2 `radius`), or, with
    the `sign` -1, take it away.
    """
    width = len(gray)
    plain, square, product = columns[:, radius : radius + width]
    for x in range(width):
        plain[x] += sign * other[x]
    for x in range(width):
        square[x] += sign * (other[x] * other[x])
    for x in range(width):
        product[x] += sign * (gray[x] * other[x])


@jit(nogil=True, fastmath=True, error_model="numpy")
def mean_of_lowest(values, share, result):
    """Mean of the lowest `share` of the `values` (n, W) of each column, into `result`
    (W,); those that are `LEFT_OUT` do not count. `UNKNOWN_COST` where none is left.

    They are sorted in place, all columns at a time.
    """
    n, width = values.shape
    lowest = np.zeros(width, np.float32)  # how many count, of these the lowest share
    for i in range(n):
        for x in range(width):
            lowest[x] += np.float32(1) if values[i, x] < LEFT_OUT else np.float32(0)
    for x in range(width):
        lowest[x] = np.ceil(np.float32(share) * lowest[x])
    for last in range(n - 1, 0, -1):
        for i in range(last):
            first, second = values[i], values[i + 1]
            for x in range(width):
                a, b = first[x], second[x]
                first[x] = min(a, b)
                second[x] = max(a, b)
    result[:] = 0
    for i in range(n):
        for x in range(width):
            result[x] += values[i, x] if np.float32(i) < lowest[x] else np.float32(0)
    for x in range(width):
        result[x] = result[x] / lowest[x] if lowest[x] > 0 else np.float32(UNKNOWN_COST)


@jit(nogil=True, fastmath=True)
def matching_costs(
    grays,
    others,
    tolerance,
    obstacles,
    rotations,
    shifts,
    disparities,
    radius,
    noise_variance,
    best_view_share,
):
    """Costs (D, H, W) of each candidate disparity (D,) over `n` views.

    `grays` (n, H, W): the frame, cut to the range each view recorded too; `others` (n,
    H, W): the views. A view counts for a pixel where its obstacle (n, H, W) is below
    the pixel's `tolerance` (n, H, W), see `obstacle_map`. Pixels go to `rotations` (n,
    3, 3) (x, y, 1) + disparity `shifts` (n, 3), homogeneous. For the numbers see
    `PlaneSweepTuning`.
    """
    n, height, width = grays.shape
    costs = np.empty((len(disparities), height, width), np.float32)
    means = np.empty((n, height, width), np.float32)
    squares = np.empty((n, height, width), np.float32)
    for i in range(n):
        box(grays[i], radius, means[i])
        box(grays[i] * grays[i], radius, squares[i])
    warped = np.empty((height, width), np.float32)
    cost = np.empty((n, height, width), np.float32)
    met = np.empty((n, height, width), np.uint8)
    values = np.empty((n, width), np.float32)
    for k in range(len(disparities)):
        for i in range(n):
            warp(others[i], obstacles[i], rotations[i], shifts[i], disparities[k], warped, met[i])
            correlation_cost(
                grays[i], means[i], squares[i], warped, radius, noise_variance, cost[i]
            )
        for y in range(height):
            for i in range(n):
                for x in range(width):
                    counts = met[i, y, x] < tolerance[i, y, x]
                    values[i, x] = cost[i, y, x] if counts else LEFT_OUT
            mean_of_lowest(values, best_view_share, costs[k, y])
    return costs


@jit(nogil=True, fastmath=True)
def mean_by_pixel(a, b):
    """The mean (H, W, D) of two arrays (D, H, W): candidates of a pixel go together."""
    num_candidates, height, width = a.shape
    result = np.empty((height, width, num_candidates), np.float32)
    block = 16  # pixels: what they read and write stays in the cache
    for y in range(height):
        for start in range(0, width, block):
            for k in range(num_candidates):
                for x in range(start, min(start + block, width)):
                    result[y, x, k] = (a[k, y, x] + b[k, y, x]) / 2
    return result


@jit(nogil=True, fastmath=True)
def aggregate(costs, guide, step_penalty, jump_penalty, edge_weight):
    """Semi-global matching: the sum (H, W, D) over eight directions of the cheapest
    path to each candidate.

    A jump between neighbors costs less where the gray `guide` (H, W) has an edge. For
    the numbers see `PlaneSweepTuning`.
    """
    height, width, num_candidates = costs.shape
    total = np.zeros((height, width, num_candidates), np.float32)
    step = np.float32(step_penalty)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        # path costs of two rows, the one before and the one at hand
        path = np.zeros((2, width, num_candidates), np.float32)
        lowest = np.zeros((2, width), np.float32)
        for row in range(height):
            y = row if dy >= 0 else height - 1 - row
            now = row & 1
            before = now if dy == 0 else 1 - now
            for column in range(width):
                x = column if dx >= 0 else width - 1 - column
                from_x = x - dx
                start = from_x < 0 or from_x >= width or (dy != 0 and row == 0)
                best = np.float32(1e30)
                jump = np.float32(0)
                if not start:
                    edge = abs(guide[y, x] - guide[y - dy, from_x])
                    penalty = np.float32(jump_penalty / (1.0 + edge_weight * edge))
                    jump = lowest[before, from_x] + max(step, penalty)
                for k in range(num_candidates):
                    value = costs[y, x, k]
                    if not start:
                        cheapest = min(path[before, from_x, k], jump)
                        if k > 0:
                            cheapest = min(cheapest, path[before, from_x, k - 1] + step)
                        if k < num_candidates - 1:
                            cheapest = min(cheapest, path[before, from_x, k + 1] + step)
                        value += cheapest - lowest[before, from_x]
                    path[now, x, k] = value
                    total[y, x, k] += value
                    best = min(best, value)
                lowest[now, x] = best
    return total


def sweep(
    clip: PosedVideo,
    i: int,
    views: list[int],
    disparities: np.ndarray,
    tuning: PlaneSweepTuning = PlaneSweepTuning(),
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity (H, W) of frame `i` of the static scene, and how well it matched (H, W)
    in [0, 1], 0 where no view contributes.

    `views`: the frames it is compared with; `disparities` (D,): evenly spaced
    candidates in 1 / scene units.
    """
    if not views:
        return np.full(clip.size, disparities.mean(), np.float32), np.zeros(clip.size, np.float32)
    grays, others = [], []
    tolerance, obstacles = [], []
    rotations, shifts = [], []
    for j in views:
        low, high = shared_range(clip, i, j)
        gray = np.clip(clip.video[i], low, high) @ LUMA
        # correlations stay the same, but less is lost by rounding on plain walls
        middle = gray.mean()
        grays.append(gray - middle)
        others.append(np.clip(clip.video[j], low, high) @ LUMA - middle)
        # nothing moves between two cameras at one instant
        same_time = bool(clip.times[i] == clip.times[j])
        obstacles.append(obstacle_map(clip, j, same_time))
        tolerance.append(TOLERANCE[obstacle_map(clip, i, same_time)])
        rotation, shift = clip.transfer(i, j)
        rotations.append(rotation)
        shifts.append(shift)
    costs = matching_costs(
        np.stack(grays),
        np.stack(others),
        np.stack(tolerance),
        np.stack(obstacles),
        np.stack(rotations),
        np.stack(shifts),
        disparities,
        tuning.radius_px,
        tuning.noise_variance,
        tuning.best_view_share,
    )
    return select_disparity(costs, clip.video[i] @ LUMA, disparities, tuning)


def shared_range(clip: PosedVideo, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest rgb (3,), (3,) that frames `i` and `j` both recorded: what
    saturates in one of them is then saturated in both.
    """
    low = np.maximum(clip.ranges[i][0], clip.ranges[j][0])
    high = np.minimum(clip.ranges[i][1], clip.ranges[j][1])
    return low, high


def obstacle_map(clip: PosedVideo, i: int, same_time: bool) -> np.ndarray:
    """What frame `i` shows, (H, W) uint8: `STATIC` scene, `MOVING` pixels, which are
    static too for views of the `same_time`, or `CLIPPED` ones.

    Static pixels are compared with static ones only. Pixels in a moving mask may match
    anything recorded: if one depth explains many views all the same, the mask was wrong
    there. Clipped pixels match nothing.
    """
    moving = np.zeros_like(clip.moving[i]) if same_time else clip.moving[i]
    return np.where(clip.clipped[i], CLIPPED, moving).astype(np.uint8)


def select_disparity(
    costs: np.ndarray,
    guide: np.ndarray,
    disparities: np.ndarray,
    tuning: PlaneSweepTuning = PlaneSweepTuning(),
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity (H, W), refined between candidates by a parabola, and 1 - its cost (H,
    W), 0 where all candidates cost the same.

    `costs` (D, H, W) of evenly spaced `disparities` (D,); `guide` (H, W) gray. A pixel
    may also use the best window that still holds it, for sharper edges (Kang et al.
    2001).
    """
    side = 2 * tuning.radius_px + 1
    shifts = np.ones((side, side), np.uint8)
    best_window = np.stack([cv2.erode(c, shifts) for c in costs])
    total = aggregate(
        mean_by_pixel(costs, best_window),
        np.ascontiguousarray(guide, np.float32),
        tuning.step_penalty,
        tuning.jump_penalty,
        tuning.edge_weight,
    )
    middle = np.clip(total.argmin(-1), 1, len(disparities) - 2)[..., None]
    at = np.take_along_axis(total, middle, -1)[..., 0]
    before = np.take_along_axis(total, middle - 1, -1)[..., 0]
    after = np.take_along_axis(total, middle + 1, -1)[..., 0]
    curvature = np.maximum(before - 2 * at + after, 1e-6)
    offset = np.clip((before - after) / (2 * curvature), -1, 1)
    spacing = disparities[1] - disparities[0]
    disparity = disparities[0] + (middle[..., 0] + offset) * spacing
    matched = np.clip(1 - np.take_along_axis(costs, middle[None, ..., 0], 0)[0], 0, 1)
    informative = np.ptp(costs, axis=0) > 1e-6
    return disparity.astype(np.float32), np.where(informative, matched, 0).astype(np.float32)
