"""CUDA kernels that make the Gaussians of a moment from the learned numbers of `splat`,
with their flow to a neighboring frame and the field's own terms, and carry gradients
back.

A thread per Gaussian: static ones first, then moving ones, then the time-local ones
that are alive. The rows of the shared motions get their gradients in two steps: blocks
of moving Gaussians add up what each basis gets (`cloud_backward`), and a thread per
basis carries that to the rows near the knot (`trajectory_backward`). The plain-torch
twin is `training_view.py:draw_by_torch`, of the fields' folder `splat`; a test compares
them.

Shapes: S static, M moving and A living time-local Gaussians, G of all, L time-local
ones; B bases at T knots. `numbers` (NUMBERS,) float64 hold what depends on the time
alone; `fused_cloud.py` lists them. The simulator of numba-cuda replaces the name `cuda`
in this module.
"""

from __future__ import annotations

import math

from numba import cuda, float32

from hdr_nsff.fields.kernels import footprint
from hdr_nsff.fields.kernels.cuda import layout
from hdr_nsff.fields.kernels.cuda.device import device_functions, exact_device
from hdr_nsff.fields.kernels.cuda.layout import POSE, THREADS

FOOTPRINT = device_functions(footprint, fastmath=False)
rotation, quaternion_gradient = FOOTPRINT["rotation"], FOOTPRINT["quaternion_gradient"]
# positions in `numbers`
KNOT, NEIGHBOR, TIME, STATIC_COLOR = 0, 5, 10, 12
MOVING_COLOR, OPACITY, UNIT, NEAR_FLOW, MAX_FLOW, BOUNDED = 14, 16, 18, 19, 20, 21
RIGIDITY_DUE, MIN_OPACITY, FIRST_ROW, LAST_ROW, OFFSET_SHARE = 22, 23, 24, 25, 26
# positions in `terms`
MEAN_OPACITY, MEAN_SCALE, TRAJECTORY, DRIFT, OPACITY_CHANGE, COLOR_CHANGE = 0, 1, 2, 3, 4, 5
RIGIDITY, EVENNESS = 6, 7
NO_POSE = (0.0,) * POSE
ROW = POSE + 1  # floats from one thread's numbers to the next one's: odd, for the banks


@exact_device
def quaternion_at(b, start, num_bases, numbers, rows):
    """The interpolated numbers of basis `b` in `rows` (T * B, 4) at a knot."""
    first = int(numbers[start])
    q0 = q1 = q2 = q3 = 0.0
    for i in range(4):
        weight = numbers[start + 1 + i]
        if weight != 0:
            r = (first + i) * num_bases + b
            q0 += weight * rows[r, 0]
            q1 += weight * rows[r, 1]
            q2 += weight * rows[r, 2]
            q3 += weight * rows[r, 3]
    return q0, q1, q2, q3


@exact_device
def pose_of(b, start, numbers, rotations, translations, centers):
    """Pose (POSE,) of basis `b` at a knot: a 3x4 matrix by rows, a unit quaternion."""
    num_bases = centers.shape[0]
    q, r, _ = rotation(quaternion_at(b, start, num_bases, numbers, rotations))
    s = quaternion_at(b, start, num_bases, numbers, translations)
    c0, c1, c2 = centers[b, 0], centers[b, 1], centers[b, 2]
    o0 = c0 + s[0] - (r[0][0] * c0 + r[0][1] * c1 + r[0][2] * c2)
    o1 = c1 + s[1] - (r[1][0] * c0 + r[1][1] * c1 + r[1][2] * c2)
    o2 = c2 + s[2] - (r[2][0] * c0 + r[2][1] * c1 + r[2][2] * c2)
    return (
        r[0][0], r[0][1], r[0][2], o0, r[1][0], r[1][1], r[1][2], o1,
        r[2][0], r[2][1], r[2][2], o2, q[0], q[1], q[2], q[3],
    )  # fmt: skip


@exact_device
def softmax_sum(mixture, m):
    """Largest logit of column `m` of `mixture` (B, M), and the sum of exponentials."""
    top = float(mixture[0, m])
    for b in range(1, mixture.shape[0]):
        top = max(top, float(mixture[b, m]))
    total = 0.0
    for b in range(mixture.shape[0]):
        total += math.exp(mixture[b, m] - top)
    return top, total


@exact_device
def mixed_pose(m, start, numbers, mixture, rotations, translations, centers):
    """The mean pose (POSE,) of moving Gaussian `m` at a knot."""
    top, total = softmax_sum(mixture, m)
    a = NO_POSE
    for b in range(mixture.shape[0]):
        w = math.exp(mixture[b, m] - top) / total
        p = pose_of(b, start, numbers, rotations, translations, centers)
        a = (
            a[0] + w * p[0], a[1] + w * p[1], a[2] + w * p[2], a[3] + w * p[3],
            a[4] + w * p[4], a[5] + w * p[5], a[6] + w * p[6], a[7] + w * p[7],
            a[8] + w * p[8], a[9] + w * p[9], a[10] + w * p[10], a[11] + w * p[11],
            a[12] + w * p[12], a[13] + w * p[13], a[14] + w * p[14], a[15] + w * p[15],
        )  # fmt: skip
    return a


@exact_device
def move_point(pose, x):
    """Where a pose moves the point x (3,)."""
    return (
        pose[0] * x[0] + pose[1] * x[1] + pose[2] * x[2] + pose[3],
        pose[4] * x[0] + pose[5] * x[1] + pose[6] * x[2] + pose[7],
        pose[8] * x[0] + pose[9] * x[1] + pose[10] * x[2] + pose[11],
    )


@exact_device
def product(a, b):
    """Hamilton product a b of quaternions w x y z."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@exact_device
def sigmoid(x):
    """The logistic function."""
    return 1 / (1 + math.exp(-x))


@exact_device
def radiance_of(stored, bounded):
    """Radiance of a stored number, and its derivative."""
    if bounded != 0:
        y = sigmoid(stored)
        return y, y * (1 - y)
    if stored > layout.MAX_LOG_RADIANCE:
        return math.exp(layout.MAX_LOG_RADIANCE), 0.0
    y = math.exp(stored)
    return y, y


@exact_device
def pixel_of_point(x, K, c2w, nearest):
    """Pixel of a world point x (3,), its camera point, and 1 / z, held at `nearest`.

    `K` (3, 3) and `c2w` (3, 4) are the camera.
    """
    d0, d1, d2 = x[0] - c2w[0, 3], x[1] - c2w[1, 3], x[2] - c2w[2, 3]
    t0 = d0 * c2w[0, 0] + d1 * c2w[1, 0] + d2 * c2w[2, 0]
    t1 = d0 * c2w[0, 1] + d1 * c2w[1, 1] + d2 * c2w[2, 1]
    t2 = d0 * c2w[0, 2] + d1 * c2w[1, 2] + d2 * c2w[2, 2]
    scale = 1.0 / max(t2, nearest)
    return (t0 * scale * K[0, 0] + K[0, 2], t1 * scale * K[1, 1] + K[1, 2]), (t0, t1, t2), scale


@exact_device
def point_gradient(x, K, c2w, nearest, g):
    """dL / d world point x (3,) from the gradient g (2,) of its pixel."""
    _, t, scale = pixel_of_point(x, K, c2w, nearest)
    gx, gy = g[0] * K[0, 0] * scale, g[1] * K[1, 1] * scale
    gz = -(gx * t[0] + gy * t[1]) * scale if t[2] > nearest else 0.0
    return (
        c2w[0, 0] * gx + c2w[0, 1] * gy + c2w[0, 2] * gz,
        c2w[1, 0] * gx + c2w[1, 1] * gy + c2w[1, 2] * gz,
        c2w[2, 0] * gx + c2w[2, 1] * gy + c2w[2, 2] * gz,
    )


@exact_device
def flow_of(here, there, numbers, K, c2w, neighbor_K, neighbor_c2w):
    """Flow (2,) in pixels between two means, and 1 for every axis within its limit."""
    nearest, limit = numbers[NEAR_FLOW], numbers[MAX_FLOW]
    a, _, _ = pixel_of_point(here, K, c2w, nearest)
    b, _, _ = pixel_of_point(there, neighbor_K, neighbor_c2w, nearest)
    x, y = b[0] - a[0], b[1] - a[1]
    free = (1.0 if abs(x) <= limit else 0.0, 1.0 if abs(y) <= limit else 0.0)
    return (min(max(x, -limit), limit), min(max(y, -limit), limit)), free


@exact_device
def column_sum(rows, column):
    """Sum over all threads of a column of `rows` (THREADS, ROW) in shared memory."""
    total = 0.0
    for n in range(THREADS):
        total += rows[n, column]
    return total


@exact_device
def between(values, i, c, start, numbers):
    """Interpolated (K, N, C) `values` of Gaussian i and channel c, at a position."""
    low = int(numbers[start])
    high = min(low + 1, values.shape[0] - 1)
    share = numbers[start + 1]
    return (1 - share) * values[low, i, c] + share * values[high, i, c]


@exact_device
def mean_square_of_offsets(values, i):
    """Mean over all (K, N, C) `values`: the share that Gaussian i has in it."""
    total = 0.0
    for k in range(values.shape[0]):
        for c in range(values.shape[2]):
            total += values[k, i, c] * values[k, i, c]
    return total / values.size


@exact_device
def mean_square_of_changes(values, i):
    """The same of the differences from knot to knot."""
    total = 0.0
    for k in range(1, values.shape[0]):
        for c in range(values.shape[2]):
            change = values[k, i, c] - values[k - 1, i, c]
            total += change * change
    return total / max(values.size - values.size // values.shape[0], 1)


@exact_device
def change_gradient(values, k, i, c):
    """d `mean_square_of_changes` / d one of the values."""
    count = max(values.size - values.size // values.shape[0], 1)
    g = 0.0
    if k > 0:
        g += values[k, i, c] - values[k - 1, i, c]
    if k < values.shape[0] - 1:
        g -= values[k + 1, i, c] - values[k, i, c]
    return 2 * g / count


@exact_device
def share_of(mixture, b, m, top, total):
    """Weight of basis b in the mixture of Gaussian m, given its `softmax_sum`."""
    return math.exp(mixture[b, m] - top) / total


@exact_device
def rigidity_of(m, mixture, neighbors):
    """Share of moving Gaussian m in the mean square difference to its neighbors."""
    top, total = softmax_sum(mixture, m)
    squares = 0.0
    for k in range(neighbors.shape[1]):
        other = neighbors[m, k]
        its_top, its_total = softmax_sum(mixture, other)
        for b in range(mixture.shape[0]):
            d = share_of(mixture, b, other, its_top, its_total)
            d -= share_of(mixture, b, m, top, total)
            squares += d * d
    return squares / (mixture.size * neighbors.shape[1])


@exact_device
def unevenness_of(row, velocities, neighbors, numbers, num_alive, c):
    """Sum over neighbors of differences of velocity on axis c, in units a frame."""
    total = 0.0
    squares = 0.0
    for k in range(neighbors.shape[1]):
        d = (velocities[row, c] - velocities[neighbors[row, k], c]) / numbers[UNIT]
        total += d
        squares += d * d
    count = max(num_alive * neighbors.shape[1] * 3, 1)
    return total / count, squares / count


@exact_device
def normalized_pose(r, numbers, rotations, translations):
    """Row r of the poses as 8 numbers: a unit quaternion, and a shift in units."""
    q0, q1, q2, q3 = rotations[r, 0], rotations[r, 1], rotations[r, 2], rotations[r, 3]
    n = max(math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3), footprint.MIN_LENGTH)
    u = numbers[UNIT]
    s = translations
    return (
        q0 / n, q1 / n, q2 / n, q3 / n, s[r, 0] / u, s[r, 1] / u, s[r, 2] / u, s[r, 3] / u,
    )  # fmt: skip


@exact_device
def third_difference(first, b, num_bases, numbers, rotations, translations):
    """Third difference (8,) of basis b's poses at `first` and three knots after it."""
    x0 = normalized_pose(first * num_bases + b, numbers, rotations, translations)
    x1 = normalized_pose((first + 1) * num_bases + b, numbers, rotations, translations)
    x2 = normalized_pose((first + 2) * num_bases + b, numbers, rotations, translations)
    x3 = normalized_pose((first + 3) * num_bases + b, numbers, rotations, translations)
    return (
        x3[0] - x0[0] + 3 * (x1[0] - x2[0]), x3[1] - x0[1] + 3 * (x1[1] - x2[1]),
        x3[2] - x0[2] + 3 * (x1[2] - x2[2]), x3[3] - x0[3] + 3 * (x1[3] - x2[3]),
        x3[4] - x0[4] + 3 * (x1[4] - x2[4]), x3[5] - x0[5] + 3 * (x1[5] - x2[5]),
        x3[6] - x0[6] + 3 * (x1[6] - x2[6]), x3[7] - x0[7] + 3 * (x1[7] - x2[7]),
    )  # fmt: skip


@exact_device
def roughness_of(b, num_bases, numbers, rotations, translations):
    """Share of basis b in the roughness of the poses near the knot."""
    first, last = int(numbers[FIRST_ROW]), int(numbers[LAST_ROW])
    total = 0.0
    for start in range(first, last - 3):
        d = third_difference(start, b, num_bases, numbers, rotations, translations)
        for n in range(8):
            total += d[n] * d[n]
    return total / max((last - first - 3) * num_bases, 1)


@exact_device
def local_at(r, means, velocities, quaternions, log_scales, colors, numbers):
    """Mean, mean at the neighbor's time, quaternion and opacity of a time-local one."""
    age, later = numbers[TIME] - means[r, 3], numbers[TIME + 1] - means[r, 3]
    v = (velocities[r, 0], velocities[r, 1], velocities[r, 2])
    x = (means[r, 0] + age * v[0], means[r, 1] + age * v[1], means[r, 2] + age * v[2])
    there = (means[r, 0] + later * v[0], means[r, 1] + later * v[1], means[r, 2] + later * v[2])
    q = (quaternions[r, 0], quaternions[r, 1], quaternions[r, 2], quaternions[r, 3])
    lives = age / math.exp(log_scales[r, 3])
    return x, there, q, math.exp(-0.5 * lives * lives) * sigmoid(colors[r, 3])


def living(means, log_scales, time, least, alive):
    """Fill `alive` (L,): which time-local Gaussians show more than a share of their
    opacity at a time, as `Living.opacities` has it.
    """
    r = cuda.grid(1)
    if r >= means.shape[0]:
        return
    lives = (time - means[r, 3]) / math.exp(log_scales[r, 3])
    alive[r] = 1 if math.exp(-0.5 * lives * lives) > least else 0


@exact_device
def finish(g, pose_term, x, there, q, log_scales, i, opacity, sight, made):
    """Write a Gaussian's mean, shape, opacity and flow; its opacity and scale terms."""
    numbers, K, c2w, neighbor_K, neighbor_c2w = sight
    means, quaternions, scales, opacities, features = made
    visible = 1.0 if float32(opacity) > float32(numbers[MIN_OPACITY]) else 0.0
    total = 0.0
    for n in range(3):
        means[g, n] = x[n]
        scale = math.exp(log_scales[i, n])
        scales[g, n] = scale
        total += scale
    for n in range(4):
        quaternions[g, n] = q[n]
    opacities[g] = opacity
    features[g, 3] = pose_term
    if features.shape[1] > 4:
        flow, _ = flow_of(x, there, numbers, K, c2w, neighbor_K, neighbor_c2w)
        features[g, 4], features[g, 5] = flow[0], flow[1]
    count = means.shape[0]
    return visible * opacity / count, visible * total / (3 * count * numbers[UNIT])


def cloud(
    s_means, s_quaternions, s_log_scales, s_logits, s_colors, s_offsets,
    m_means, m_quaternions, m_log_scales, m_logits, m_colors, m_offsets, presence, mixture,
    rotations, translations, centers, l_means, l_velocities, l_quaternions, l_log_scales,
    l_colors, alive, neighbors, l_neighbors, numbers, K, c2w, neighbor_K, neighbor_c2w,
    means, quaternions, scales, opacities, features, terms,
):  # fmt: skip
    """Fill the Gaussians of a moment, shaped like `rasterize` takes them, and `terms`.

    `features` (G, 4 or 6) are radiance, motion, and flow to the neighbor where wanted.
    """
    rows = cuda.shared.array((THREADS, ROW), float32)
    g, thread = cuda.grid(1), cuda.threadIdx.x
    num_static, num_moving = s_means.shape[0], m_means.shape[0]
    sight = numbers, K, c2w, neighbor_K, neighbor_c2w
    made = means, quaternions, scales, opacities, features
    for n in range(ROW):
        rows[thread, n] = 0.0
    m, lived = g - num_static, g - num_static - num_moving
    faint = small = 0.0
    if g < num_static:
        x = (s_means[g, 0], s_means[g, 1], s_means[g, 2])
        q = (s_quaternions[g, 0], s_quaternions[g, 1], s_quaternions[g, 2], s_quaternions[g, 3])
        opacity = sigmoid(s_logits[g])
        faint, small = finish(g, 0.0, x, x, q, s_log_scales, g, opacity, sight, made)
        offset = between(s_offsets, g, 0, STATIC_COLOR, numbers)
        for c in range(3):
            features[g, c], _ = radiance_of(s_colors[g, c] + offset, numbers[BOUNDED])
        rows[thread, DRIFT] = mean_square_of_offsets(s_offsets, g)
    elif m < num_moving:
        pose = mixed_pose(m, KNOT, numbers, mixture, rotations, translations, centers)
        rest = (m_means[m, 0], m_means[m, 1], m_means[m, 2])
        x = move_point(pose, rest)
        there = x
        if features.shape[1] > 4:
            next_pose = mixed_pose(m, NEIGHBOR, numbers, mixture, rotations, translations, centers)
            there = move_point(next_pose, rest)
        own = (m_quaternions[m, 0], m_quaternions[m, 1], m_quaternions[m, 2], m_quaternions[m, 3])
        q = product(pose[12:], own)
        opacity = sigmoid(m_logits[m] + between(presence, m, 0, OPACITY, numbers))
        faint, small = finish(g, 1.0, x, there, q, m_log_scales, m, opacity, sight, made)
        for c in range(3):
            stored = m_colors[m, c] + between(m_offsets, m, c, MOVING_COLOR, numbers)
            features[g, c], _ = radiance_of(stored, numbers[BOUNDED])
        rows[thread, OPACITY_CHANGE] = mean_square_of_changes(presence, m)
        rows[thread, COLOR_CHANGE] = mean_square_of_changes(m_offsets, m) + numbers[
            OFFSET_SHARE
        ] * mean_square_of_offsets(m_offsets, m)
        if numbers[RIGIDITY_DUE] != 0:
            rows[thread, RIGIDITY] = rigidity_of(m, mixture, neighbors)
    elif lived < alive.shape[0]:
        r = alive[lived]
        x, there, q, opacity = local_at(
            r, l_means, l_velocities, l_quaternions, l_log_scales, l_colors, numbers
        )
        faint, small = finish(g, 1.0, x, there, q, l_log_scales, r, opacity, sight, made)
        for c in range(3):
            features[g, c], _ = radiance_of(l_colors[r, c], numbers[BOUNDED])
        if numbers[RIGIDITY_DUE] != 0:
            for c in range(3):
                _, squares = unevenness_of(r, l_velocities, l_neighbors, numbers, alive.shape[0], c)
                rows[thread, EVENNESS] += squares
    rows[thread, MEAN_OPACITY], rows[thread, MEAN_SCALE] = faint, small
    if g < centers.shape[0]:
        rows[thread, TRAJECTORY] = roughness_of(
            g, centers.shape[0], numbers, rotations, translations
        )
    cuda.syncthreads()
    if thread < terms.shape[0]:
        cuda.atomic.add(terms, thread, float32(column_sum(rows, thread)))
