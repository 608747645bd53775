"""CUDA kernels that make the Gaussians of a moment from the learned numbers of `splat`,
with their flow to a neighboring frame and the field's own terms, and carry gradients
back.

A thread per Gaussian: static ones first, then moving ones, then the time-local ones
that are alive. What each of them does stands in `kernels/moment.py`. The rows of the
shared motions get their gradients in two steps: blocks of moving Gaussians add up what
each basis gets (`moving_backward`), and a thread per basis carries that to the rows
near the knot (`trajectory_backward`). The twins are `kernels/cloud.py` and plain torch
(`training_view.py:draw_by_torch`, of the fields' folder `splat`); tests compare them.

Shapes: those of `moment.py`, A living time-local Gaussians; B bases at T knots.
`Moment.numbers` of `splat/moment.py` lists the `numbers`. The simulator of numba-cuda
replaces the name `cuda` in this module.
"""

from __future__ import annotations

import math

from numba import cuda, float32

from hdr_nsff.fields.kernels import footprint, moment
from hdr_nsff.fields.kernels.cuda.device import device_functions, exact_device
from hdr_nsff.fields.kernels.cuda.layout import THREADS
from hdr_nsff.fields.kernels.moment import (
    DIFFERENCES,
    FIRST_ROW,
    KNOT,
    LAST_ROW,
    NEIGHBOR,
    NO_POSE,
    POSE,
    RIGIDITY,
    RIGIDITY_DUE,
    TRAJECTORY,
    UNIT,
)

rotation = device_functions(footprint, fastmath=False)["rotation"]
MOMENT = device_functions(moment, fastmath=False, arrays=True)
make_static, make_moving = MOMENT["make_static"], MOMENT["make_moving"]
make_local, move_point = MOMENT["make_local"], MOMENT["move_point"]
add_pose = MOMENT["add_pose"]
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
        a = add_pose(a, w, pose_of(b, start, numbers, rotations, translations, centers))
    return a


@exact_device
def column_sum(rows, column):
    """Sum over all threads of a column of `rows` (THREADS, ROW) in shared memory."""
    total = 0.0
    for n in range(THREADS):
        total += rows[n, column]
    return total


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
def third_difference(row, b, num_bases, numbers, rotations, translations):
    """The row-th third difference (8,) of the poses of basis b near the knot."""
    start, at = int(numbers[FIRST_ROW]) + row, DIFFERENCES + 4 * row
    x0 = normalized_pose(start * num_bases + b, numbers, rotations, translations)
    x1 = normalized_pose((start + 1) * num_bases + b, numbers, rotations, translations)
    x2 = normalized_pose((start + 2) * num_bases + b, numbers, rotations, translations)
    x3 = normalized_pose((start + 3) * num_bases + b, numbers, rotations, translations)
    w0, w1, w2, w3 = numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]
    return (
        w0 * x0[0] + w1 * x1[0] + w2 * x2[0] + w3 * x3[0],
        w0 * x0[1] + w1 * x1[1] + w2 * x2[1] + w3 * x3[1],
        w0 * x0[2] + w1 * x1[2] + w2 * x2[2] + w3 * x3[2],
        w0 * x0[3] + w1 * x1[3] + w2 * x2[3] + w3 * x3[3],
        w0 * x0[4] + w1 * x1[4] + w2 * x2[4] + w3 * x3[4],
        w0 * x0[5] + w1 * x1[5] + w2 * x2[5] + w3 * x3[5],
        w0 * x0[6] + w1 * x1[6] + w2 * x2[6] + w3 * x3[6],
        w0 * x0[7] + w1 * x1[7] + w2 * x2[7] + w3 * x3[7],
    )


@exact_device
def roughness_of(b, num_bases, numbers, rotations, translations):
    """Share of basis b in the roughness of the poses near the knot."""
    first, last = int(numbers[FIRST_ROW]), int(numbers[LAST_ROW])
    total = 0.0
    for row in range(last - first - 3):
        d = third_difference(row, b, num_bases, numbers, rotations, translations)
        for n in range(8):
            total += d[n] * d[n]
    return total / max((last - first - 3) * num_bases, 1)


def living(means, log_scales, time, least, alive):
    """Fill `alive` (L,): which time-local Gaussians show more than a share of their
    opacity at a time, as `Living.opacities` has it.
    """
    r = cuda.grid(1)
    if r >= means.shape[0]:
        return
    lives = (time - means[r, 3]) / math.exp(log_scales[r, 3])
    alive[r] = 1 if math.exp(-0.5 * lives * lives) > least else 0


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
    sums = rows[thread]
    m, lived = g - num_static, g - num_static - num_moving
    if g < num_static:
        learned = s_means, s_quaternions, s_log_scales, s_logits, s_colors, s_offsets
        make_static(g, learned, sight, made, sums)
    elif m < num_moving:
        moving = m_means, m_quaternions, m_log_scales, m_logits, m_colors, m_offsets, presence
        pose = mixed_pose(m, KNOT, numbers, mixture, rotations, translations, centers)
        next_pose = pose
        if features.shape[1] > 4:
            next_pose = mixed_pose(m, NEIGHBOR, numbers, mixture, rotations, translations, centers)
        make_moving(g, m, pose, next_pose, moving, sight, made, sums)
        if numbers[RIGIDITY_DUE] != 0:
            sums[RIGIDITY] = rigidity_of(m, mixture, neighbors)
    elif lived < alive.shape[0]:
        tables = l_means, l_velocities, l_quaternions, l_log_scales, l_colors
        count = alive.shape[0]
        make_local(g, alive[lived], count, tables, l_neighbors, sight, made, sums)
    if g < centers.shape[0]:
        sums[TRAJECTORY] = roughness_of(g, centers.shape[0], numbers, rotations, translations)
    cuda.syncthreads()
    if thread < terms.shape[0]:
        cuda.atomic.add(terms, thread, float32(column_sum(rows, thread)))
