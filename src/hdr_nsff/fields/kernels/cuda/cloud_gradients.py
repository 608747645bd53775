"""CUDA kernels that carry gradients of `cloud_kernels.cloud` to the learned numbers.

A thread per Gaussian of one kind; what it does stands in `kernels/moment_gradients.py`.
Gradients of the shared motions come in two steps: blocks of moving Gaussians add up
what each basis gets (`moving_backward`), and a thread per basis carries that to the
rows near the knot (`trajectory_backward`).

Names, shapes and `numbers` are those of `cloud_kernels.py`. A `d_` is a gradient of
what `cloud` filled, a `g_` one that is made here. Gradients of tables of which only
some rows are touched, and of the mixtures, must be 0 before.
"""

from __future__ import annotations

from numba import cuda, float32

from hdr_nsff.fields.kernels import footprint, moment_gradients
from hdr_nsff.fields.kernels.cuda.cloud_kernels import (
    ROW,
    column_sum,
    mixed_pose,
    move_point,
    pose_of,
    quaternion_at,
    rotation,
    share_of,
    softmax_sum,
    third_difference,
)
from hdr_nsff.fields.kernels.cuda.device import device_functions, exact_device
from hdr_nsff.fields.kernels.cuda.layout import THREADS
from hdr_nsff.fields.kernels.moment import (
    DIFFERENCES,
    FIRST_ROW,
    KNOT,
    LAST_ROW,
    NEIGHBOR,
    POSE,
    RIGIDITY,
    RIGIDITY_DUE,
    TRAJECTORY,
    UNIT,
)

quaternion_gradient = device_functions(footprint, fastmath=False)["quaternion_gradient"]
MOMENT = device_functions(moment_gradients, fastmath=False, arrays=True)
static_gradients, motion_gradients = MOMENT["static_gradients"], MOMENT["motion_gradients"]
moving_gradients, local_gradients = MOMENT["moving_gradients"], MOMENT["local_gradients"]


def static_backward(
    means, log_scales, logits, colors, offsets, numbers, K, c2w, neighbor_K, neighbor_c2w,
    d_means, d_quaternions, d_scales, d_opacities, d_features, d_terms,
    g_means, g_quaternions, g_log_scales, g_logits, g_colors, g_offsets,
):  # fmt: skip
    """Gradients of the static Gaussians."""
    g = cuda.grid(1)
    if g >= means.shape[0]:
        return
    learned = means, log_scales, logits, colors, offsets
    sight = numbers, K, c2w, neighbor_K, neighbor_c2w
    d = d_means, d_quaternions, d_scales, d_opacities, d_features, d_terms
    made = g_means, g_quaternions, g_log_scales, g_logits, g_colors, g_offsets
    static_gradients(g, learned, sight, d, made)


@exact_device
def rigidity_weight_gradient(b, m, mixture, neighbors, weight):
    """dL / d weight of basis b in Gaussian m's own mixture, by rigidity."""
    top, total = softmax_sum(mixture, m)
    d = 0.0
    for k in range(neighbors.shape[1]):
        other = neighbors[m, k]
        its_top, its_total = softmax_sum(mixture, other)
        d -= share_of(mixture, b, other, its_top, its_total)
        d += share_of(mixture, b, m, top, total)
    return weight * d


@exact_device
def add_rigidity_of_neighbors(m, mixture, neighbors, weight, g_mixture):
    """Add the gradients of Gaussian m's rigidity to the logits of its neighbors."""
    top, total = softmax_sum(mixture, m)
    num_bases = mixture.shape[0]
    for k in range(neighbors.shape[1]):
        other = neighbors[m, k]
        its_top, its_total = softmax_sum(mixture, other)
        inner = 0.0
        for b in range(num_bases):
            w = share_of(mixture, b, other, its_top, its_total)
            inner += w * weight * (w - share_of(mixture, b, m, top, total))
        for b in range(num_bases):
            w = share_of(mixture, b, other, its_top, its_total)
            d = weight * (w - share_of(mixture, b, m, top, total))
            cuda.atomic.add(g_mixture, (b, other), float32(w * (d - inner)))


@exact_device
def weight_gradient(b, rest, motion, d, numbers, with_flow):
    """dL / d weight of basis b for a Gaussian at `rest`, by its motion."""
    rotations, translations, centers = motion
    d_here, d_there, d_turn = d
    p = pose_of(b, KNOT, numbers, rotations, translations, centers)
    x = move_point(p, rest)
    total = d_here[0] * x[0] + d_here[1] * x[1] + d_here[2] * x[2]
    total += d_turn[0] * p[12] + d_turn[1] * p[13] + d_turn[2] * p[14] + d_turn[3] * p[15]
    if with_flow:
        p = pose_of(b, NEIGHBOR, numbers, rotations, translations, centers)
        x = move_point(p, rest)
        total += d_there[0] * x[0] + d_there[1] * x[1] + d_there[2] * x[2]
    return total


@exact_device
def mixture_gradients(m, rest, motion, d, mixture, neighbors, numbers, d_terms, with_flow, g):
    """Add the gradients of a moving Gaussian's mixture to the logits' `g` (B, M)."""
    weight = 0.0
    if numbers[RIGIDITY_DUE] != 0:
        weight = 2 * d_terms[RIGIDITY] / (mixture.size * neighbors.shape[1])
        add_rigidity_of_neighbors(m, mixture, neighbors, weight, g)
    top, total = softmax_sum(mixture, m)
    inner = 0.0
    for b in range(mixture.shape[0]):
        d_w = weight_gradient(b, rest, motion, d, numbers, with_flow)
        if weight != 0:
            d_w += rigidity_weight_gradient(b, m, mixture, neighbors, weight)
        inner += share_of(mixture, b, m, top, total) * d_w
    for b in range(mixture.shape[0]):
        d_w = weight_gradient(b, rest, motion, d, numbers, with_flow)
        if weight != 0:
            d_w += rigidity_weight_gradient(b, m, mixture, neighbors, weight)
        w = share_of(mixture, b, m, top, total)
        cuda.atomic.add(g, (b, m), float32(w * (d_w - inner)))


@exact_device
def add_rows(rows, sums):
    """Add the first POSE columns of all threads' `rows` to `sums` (POSE,).

    `rows` (THREADS, ROW) lie in shared memory; all threads of the block come here.
    """
    cuda.syncthreads()
    thread = cuda.threadIdx.x
    if thread < POSE:
        cuda.atomic.add(sums, thread, float32(column_sum(rows, thread)))
    cuda.syncthreads()


@exact_device
def fill_row(rows, thread, w, d, rest, d_turn):
    """One Gaussian's gradient of a basis's pose, of which it has the weight `w`."""
    for axis in range(3):
        rows[thread, 4 * axis] = w * d[axis] * rest[0]
        rows[thread, 4 * axis + 1] = w * d[axis] * rest[1]
        rows[thread, 4 * axis + 2] = w * d[axis] * rest[2]
        rows[thread, 4 * axis + 3] = w * d[axis]
    for n in range(4):
        rows[thread, 12 + n] = w * d_turn[n]


def moving_backward(
    means, quaternions, log_scales, logits, colors, offsets, presence, mixture,
    rotations, translations, centers, neighbors, num_static,
    numbers, K, c2w, neighbor_K, neighbor_c2w,
    d_means, d_quaternions, d_scales, d_opacities, d_features, d_terms,
    g_means, g_quaternions, g_log_scales, g_logits, g_colors, g_offsets, g_presence, g_mixture,
    sums,
):  # fmt: skip
    """Gradients of the moving Gaussians, and in `sums` (2 B, POSE) of the bases' poses:
    at the knot, then at the neighbor's.
    """
    rows = cuda.shared.array((THREADS, ROW), float32)
    m, thread = cuda.grid(1), cuda.threadIdx.x
    exists, with_flow = m < means.shape[0], d_features.shape[1] > 4
    num_bases, i = mixture.shape[0], min(m, means.shape[0] - 1)
    g = num_static + i
    learned = means, quaternions, log_scales, logits, colors, offsets, presence
    sight = numbers, K, c2w, neighbor_K, neighbor_c2w
    d = d_means, d_quaternions, d_scales, d_opacities, d_features, d_terms
    rest = (means[i, 0], means[i, 1], means[i, 2])
    pose = mixed_pose(i, KNOT, numbers, mixture, rotations, translations, centers)
    next_pose = pose
    if with_flow:
        next_pose = mixed_pose(i, NEIGHBOR, numbers, mixture, rotations, translations, centers)
    motion = motion_gradients(g, i, pose, next_pose, learned, sight, d)
    d_here, d_there, d_turn = motion
    if exists:
        made = g_means, g_quaternions, g_log_scales, g_logits, g_colors, g_offsets, g_presence
        moving_gradients(g, i, pose, next_pose, d_here, d_there, learned, sight, d, made)
        bases = rotations, translations, centers
        mixture_gradients(
            i, rest, bases, motion, mixture, neighbors, numbers, d_terms, with_flow, g_mixture
        )
    top, total = softmax_sum(mixture, i)
    no_turn = (0.0, 0.0, 0.0, 0.0)
    for b in range(num_bases):
        w = share_of(mixture, b, i, top, total) if exists else 0.0
        fill_row(rows, thread, w, d_here, rest, d_turn)
        add_rows(rows, sums[b])
        if with_flow:
            fill_row(rows, thread, w, d_there, rest, no_turn)
            add_rows(rows, sums[num_bases + b])


@exact_device
def add_to_rows(b, start, num_bases, numbers, d, count, g_rows):
    """Carry a gradient of basis b at a knot to the rows around it."""
    first = int(numbers[start])
    for i in range(4):
        weight = numbers[start + 1 + i]
        if weight != 0:
            for n in range(count):
                g_rows[(first + i) * num_bases + b, n] += weight * d[n]


@exact_device
def pose_gradient(b, start, numbers, motion, s, g_rotations, g_translations):
    """Carry the gradient `s` (POSE,) of a basis's pose to the rows around the knot."""
    rotations, _, centers = motion
    num_bases = centers.shape[0]
    unit, _, length = rotation(quaternion_at(b, start, num_bases, numbers, rotations))
    c0, c1, c2 = centers[b, 0], centers[b, 1], centers[b, 2]
    d_rotation = (
        (s[0] - s[3] * c0, s[1] - s[3] * c1, s[2] - s[3] * c2),
        (s[4] - s[7] * c0, s[5] - s[7] * c1, s[6] - s[7] * c2),
        (s[8] - s[11] * c0, s[9] - s[11] * c1, s[10] - s[11] * c2),
    )
    d = quaternion_gradient(unit, length, d_rotation)
    along = s[12] * unit[0] + s[13] * unit[1] + s[14] * unit[2] + s[15] * unit[3]
    d_quaternion = (
        d[0] + (s[12] - along * unit[0]) / length,
        d[1] + (s[13] - along * unit[1]) / length,
        d[2] + (s[14] - along * unit[2]) / length,
        d[3] + (s[15] - along * unit[3]) / length,
    )
    add_to_rows(b, start, num_bases, numbers, d_quaternion, 4, g_rotations)
    add_to_rows(b, start, num_bases, numbers, (s[3], s[7], s[11]), 3, g_translations)


@exact_device
def roughness_gradient(b, numbers, motion, weight, g_rotations, g_translations):
    """Add `weight` times the gradient of `roughness_of` to the rows near the knot."""
    rotations, translations, centers = motion
    num_bases = centers.shape[0]
    first, last = int(numbers[FIRST_ROW]), int(numbers[LAST_ROW])
    factor = 2 * weight / max((last - first - 3) * num_bases, 1)
    for row in range(last - first - 3):
        d = third_difference(row, b, num_bases, numbers, rotations, translations)
        for i in range(4):
            w = factor * numbers[DIFFERENCES + 4 * row + i]
            r = (first + row + i) * num_bases + b
            q = (rotations[r, 0], rotations[r, 1], rotations[r, 2], rotations[r, 3])
            unit, _, length = rotation(q)
            along = d[0] * unit[0] + d[1] * unit[1] + d[2] * unit[2] + d[3] * unit[3]
            for n in range(4):
                g_rotations[r, n] += w * (d[n] - along * unit[n]) / length
                g_translations[r, n] += w * d[4 + n] / numbers[UNIT]


def trajectory_backward(
    rotations, translations, centers, numbers, with_flow, sums, d_terms,
    g_rotations, g_translations, rotations_touched, translations_touched,
):  # fmt: skip
    """Gradients and marks of the rows near the knot, a thread per basis."""
    b, num_bases = cuda.grid(1), centers.shape[0]
    if b >= num_bases:
        return
    motion = rotations, translations, centers
    for r in range(int(numbers[FIRST_ROW]), int(numbers[LAST_ROW])):
        rotations_touched[r * num_bases + b] = 1
        translations_touched[r * num_bases + b] = 1
    pose_gradient(b, KNOT, numbers, motion, sums[b], g_rotations, g_translations)
    if with_flow != 0:
        pose_gradient(
            b, NEIGHBOR, numbers, motion, sums[num_bases + b], g_rotations, g_translations
        )
    roughness_gradient(b, numbers, motion, d_terms[TRAJECTORY], g_rotations, g_translations)


def local_backward(
    means, velocities, quaternions, log_scales, colors, alive, neighbors, before,
    numbers, K, c2w, neighbor_K, neighbor_c2w,
    d_means, d_quaternions, d_scales, d_opacities, d_features, d_terms,
    g_means, g_velocities, g_quaternions, g_log_scales, g_colors,
    means_touched, velocities_touched, quaternions_touched, log_scales_touched, colors_touched,
):  # fmt: skip
    """Gradients and marks of the living time-local Gaussians, after `before` others."""
    i = cuda.grid(1)
    if i >= alive.shape[0]:
        return
    learned = means, velocities, quaternions, log_scales, colors
    sight = numbers, K, c2w, neighbor_K, neighbor_c2w
    d = d_means, d_quaternions, d_scales, d_opacities, d_features, d_terms
    made = g_means, g_velocities, g_quaternions, g_log_scales, g_colors
    marks = means_touched, velocities_touched, quaternions_touched, log_scales_touched
    local_gradients(
        before + i, alive[i], alive.shape[0], learned, neighbors, sight, d, made,
        (*marks, colors_touched),
    )  # fmt: skip
