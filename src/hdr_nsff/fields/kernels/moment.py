"""The Gaussians of a moment, one by one: where learned numbers move them, what they
become, their flow to a neighboring frame and their share in the field's own terms.

numba compiles these functions for the CPU (`cloud.py`), and numba-cuda the same ones
for NVIDIA GPUs (`cuda/cloud_kernels.py`); `moment_gradients.py` carries gradients back.
The plain-torch twin is `splat/training_view.py:draw_by_torch`.

Shapes: S static, M moving and L time-local Gaussians, G of a moment, with indices g of
a Gaussian of the moment, m of a moving one and r of a time-local one; K knots. `sight`
are `numbers` (NUMBERS,) float64, which hold what depends on the time alone, and the
intrinsics (3, 3) and poses (3, 4) of the camera and of its neighbor.
"""

from __future__ import annotations

import math

from numba import float32

from hdr_nsff.core.jit import jit
from hdr_nsff.fields.kernels.footprint import FAST

POSE = 16  # numbers of a basis at a time: a 3x4 matrix by rows and a unit quaternion
NO_POSE = (0.0,) * POSE
NUMBERS = 44  # that depend on the time alone
# positions in `numbers`
KNOT, NEIGHBOR, TIME, STATIC_COLOR = 0, 5, 10, 12
MOVING_COLOR, OPACITY, UNIT, NEAR_FLOW, MAX_FLOW, BOUNDED = 14, 16, 18, 19, 20, 21
RIGIDITY_DUE, MIN_OPACITY, FIRST_ROW, LAST_ROW, OFFSET_SHARE = 22, 23, 24, 25, 26
LEAST_DURATION = 27
DIFFERENCES = 28  # four weights for each third difference of the poses near the knot
TERMS = 8  # of the field's own
# positions in `terms`
MEAN_OPACITY, MEAN_SCALE, TRAJECTORY, DRIFT, OPACITY_CHANGE, COLOR_CHANGE = 0, 1, 2, 3, 4, 5
RIGIDITY, EVENNESS = 6, 7
MAX_LOG_RADIANCE = 16.0  # of a Gaussian, as in `splat/gaussians.py`

# Inlined, without reference counts: calls, which pass every table as several numbers,
# make kernels take four times as long.
scalar = jit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)


@scalar
def add_pose(a, w, p):
    """The pose `a` (POSE,) plus w times another one p."""
    return (
        a[0] + w * p[0], a[1] + w * p[1], a[2] + w * p[2], a[3] + w * p[3],
        a[4] + w * p[4], a[5] + w * p[5], a[6] + w * p[6], a[7] + w * p[7],
        a[8] + w * p[8], a[9] + w * p[9], a[10] + w * p[10], a[11] + w * p[11],
        a[12] + w * p[12], a[13] + w * p[13], a[14] + w * p[14], a[15] + w * p[15],
    )  # fmt: skip


@scalar
def move_point(pose, x):
    """Where a pose moves the point x (3,)."""
    return (
        pose[0] * x[0] + pose[1] * x[1] + pose[2] * x[2] + pose[3],
        pose[4] * x[0] + pose[5] * x[1] + pose[6] * x[2] + pose[7],
        pose[8] * x[0] + pose[9] * x[1] + pose[10] * x[2] + pose[11],
    )


@scalar
def product(a, b):
    """Hamilton product a b of quaternions w x y z."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@scalar
def sigmoid(x):
    """The logistic function."""
    return 1 / (1 + math.exp(-x))


@scalar
def radiance_of(stored, bounded):
    """Radiance of a stored number, and its derivative."""
    if bounded != 0:
        y = sigmoid(stored)
        return y, y * (1 - y)
    if stored > MAX_LOG_RADIANCE:
        return math.exp(MAX_LOG_RADIANCE), 0.0
    y = math.exp(stored)
    return y, y


@scalar
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


@scalar
def flow_of(here, there, numbers, K, c2w, neighbor_K, neighbor_c2w):
    """Flow (2,) in pixels between two means, and 1 for every axis within its limit."""
    nearest, limit = numbers[NEAR_FLOW], numbers[MAX_FLOW]
    a, _, _ = pixel_of_point(here, K, c2w, nearest)
    b, _, _ = pixel_of_point(there, neighbor_K, neighbor_c2w, nearest)
    x, y = b[0] - a[0], b[1] - a[1]
    free = (1.0 if abs(x) <= limit else 0.0, 1.0 if abs(y) <= limit else 0.0)
    return (min(max(x, -limit), limit), min(max(y, -limit), limit)), free


@scalar
def between(values, i, c, start, numbers):
    """Interpolated (K, N, C) `values` of Gaussian i and channel c, at a position."""
    low = int(numbers[start])
    high = min(low + 1, values.shape[0] - 1)
    share = numbers[start + 1]
    return (1 - share) * values[low, i, c] + share * values[high, i, c]


@scalar
def mean_square_of_offsets(values, i):
    """Mean over all (K, N, C) `values`: the share that Gaussian i has in it."""
    total = 0.0
    for k in range(values.shape[0]):
        for c in range(values.shape[2]):
            total += values[k, i, c] * values[k, i, c]
    return total / values.size


@scalar
def mean_square_of_changes(values, i):
    """The same of the differences from knot to knot."""
    total = 0.0
    for k in range(1, values.shape[0]):
        for c in range(values.shape[2]):
            change = values[k, i, c] - values[k - 1, i, c]
            total += change * change
    return total / max(values.size - values.size // values.shape[0], 1)


@scalar
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


@scalar
def finish(g, motion, x, there, q, log_scales, i, opacity, sight, made, sums):
    """Write a Gaussian's mean, shape, opacity and flow, of row i of its own tables, and
    add its opacity and scale terms.
    """
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
    features[g, 3] = motion
    if features.shape[1] > 4:
        flow, _ = flow_of(x, there, numbers, K, c2w, neighbor_K, neighbor_c2w)
        features[g, 4], features[g, 5] = flow[0], flow[1]
    count = means.shape[0]
    sums[MEAN_OPACITY] += visible * opacity / count
    sums[MEAN_SCALE] += visible * total / (3 * count * numbers[UNIT])


# The three kinds: each writes a row of the arrays `made`, and adds to `sums` (TERMS,)


@scalar
def make_static(g, learned, sight, made, sums):
    """A static Gaussian, from its six tables `learned`."""
    means, quaternions, log_scales, logits, colors, offsets = learned
    numbers, features = sight[0], made[4]
    x = (means[g, 0], means[g, 1], means[g, 2])
    q = (quaternions[g, 0], quaternions[g, 1], quaternions[g, 2], quaternions[g, 3])
    finish(g, 0.0, x, x, q, log_scales, g, sigmoid(logits[g]), sight, made, sums)
    offset = between(offsets, g, 0, STATIC_COLOR, numbers)
    for c in range(3):
        features[g, c], _ = radiance_of(colors[g, c] + offset, numbers[BOUNDED])
    sums[DRIFT] += mean_square_of_offsets(offsets, g)


@scalar
def make_moving(g, m, pose, next_pose, learned, sight, made, sums):
    """A moving Gaussian in its mean pose, now and at the neighbor's time, from its
    seven tables.
    """
    means, quaternions, log_scales, logits, colors, offsets, presence = learned
    numbers, features = sight[0], made[4]
    rest = (means[m, 0], means[m, 1], means[m, 2])
    x, there = move_point(pose, rest), move_point(next_pose, rest)
    own = (quaternions[m, 0], quaternions[m, 1], quaternions[m, 2], quaternions[m, 3])
    turn = (pose[12], pose[13], pose[14], pose[15])
    opacity = sigmoid(logits[m] + between(presence, m, 0, OPACITY, numbers))
    finish(g, 1.0, x, there, product(turn, own), log_scales, m, opacity, sight, made, sums)
    for c in range(3):
        stored = colors[m, c] + between(offsets, m, c, MOVING_COLOR, numbers)
        features[g, c], _ = radiance_of(stored, numbers[BOUNDED])
    sums[OPACITY_CHANGE] += mean_square_of_changes(presence, m)
    sums[COLOR_CHANGE] += mean_square_of_changes(offsets, m) + numbers[
        OFFSET_SHARE
    ] * mean_square_of_offsets(offsets, m)


@scalar
def local_at(r, learned, numbers):
    """Mean, mean at the neighbor's time, and opacity of a time-local one."""
    means, velocities, _, log_scales, colors = learned
    age, later = numbers[TIME] - means[r, 3], numbers[TIME + 1] - means[r, 3]
    v = (velocities[r, 0], velocities[r, 1], velocities[r, 2])
    x = (means[r, 0] + age * v[0], means[r, 1] + age * v[1], means[r, 2] + age * v[2])
    there = (means[r, 0] + later * v[0], means[r, 1] + later * v[1], means[r, 2] + later * v[2])
    lives = age / math.exp(log_scales[r, 3])
    return x, there, math.exp(-0.5 * lives * lives) * sigmoid(colors[r, 3])


@scalar
def make_local(g, r, num_alive, learned, neighbors, sight, made, sums):
    """A time-local Gaussian, from its five tables."""
    _, velocities, quaternions, log_scales, colors = learned
    numbers, features = sight[0], made[4]
    x, there, opacity = local_at(r, learned, numbers)
    q = (quaternions[r, 0], quaternions[r, 1], quaternions[r, 2], quaternions[r, 3])
    finish(g, 1.0, x, there, q, log_scales, r, opacity, sight, made, sums)
    for c in range(3):
        features[g, c], _ = radiance_of(colors[r, c], numbers[BOUNDED])
    if numbers[RIGIDITY_DUE] != 0:
        for c in range(3):
            _, squares = unevenness_of(r, velocities, neighbors, numbers, num_alive, c)
            sums[EVENNESS] += squares
