"""Gradients of the Gaussians of a moment (`moment.py`), one by one.

A `d_` is a gradient of what was made, a `g_` one that is added or stored here, of a
learned number.
"""

from __future__ import annotations

import math

from numba import float32

from hdr_nsff.fields.kernels.moment import (
    BOUNDED,
    COLOR_CHANGE,
    DRIFT,
    EVENNESS,
    LEAST_DURATION,
    MEAN_OPACITY,
    MEAN_SCALE,
    MIN_OPACITY,
    MOVING_COLOR,
    NEAR_FLOW,
    OFFSET_SHARE,
    OPACITY,
    OPACITY_CHANGE,
    RIGIDITY_DUE,
    STATIC_COLOR,
    TIME,
    UNIT,
    between,
    flow_of,
    local_at,
    move_point,
    pixel_of_point,
    product,
    radiance_of,
    scalar,
    sigmoid,
    unevenness_of,
)


@scalar
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


@scalar
def change_gradient(values, k, i, c):
    """d `mean_square_of_changes` / d one of the values."""
    count = max(values.size - values.size // values.shape[0], 1)
    g = 0.0
    if k > 0:
        g += values[k, i, c] - values[k - 1, i, c]
    if k < values.shape[0] - 1:
        g -= values[k + 1, i, c] - values[k, i, c]
    return 2 * g / count


@scalar
def mean_gradients(g, x, there, sight, d_means, d_features):
    """Gradients (3,) of a Gaussian's mean, and of its mean at the neighbor's time."""
    d = (d_means[g, 0], d_means[g, 1], d_means[g, 2])
    if d_features.shape[1] <= 4:
        return (d[0] + 0.0, d[1] + 0.0, d[2] + 0.0), (0.0, 0.0, 0.0)
    numbers, K, c2w, neighbor_K, neighbor_c2w = sight
    _, free = flow_of(x, there, numbers, K, c2w, neighbor_K, neighbor_c2w)
    fx, fy = d_features[g, 4] * free[0], d_features[g, 5] * free[1]
    nearest = numbers[NEAR_FLOW]
    here = point_gradient(x, K, c2w, nearest, (-fx, -fy))
    later = point_gradient(there, neighbor_K, neighbor_c2w, nearest, (fx, fy))
    return (d[0] + here[0], d[1] + here[1], d[2] + here[2]), later


@scalar
def shape_gradients(g, i, opacity, log_scales, numbers, d):
    """Gradients of a Gaussian's opacity, and of its log scales (3,) in row i of their
    table.
    """
    _, _, d_scales, d_opacities, _, d_terms = d
    count = d_scales.shape[0]
    visible = 1.0 if float32(opacity) > float32(numbers[MIN_OPACITY]) else 0.0
    of_scale = d_terms[MEAN_SCALE] * visible / (3 * count * numbers[UNIT])
    return d_opacities[g] + d_terms[MEAN_OPACITY] * visible / count, (
        math.exp(log_scales[i, 0]) * (d_scales[g, 0] + of_scale),
        math.exp(log_scales[i, 1]) * (d_scales[g, 1] + of_scale),
        math.exp(log_scales[i, 2]) * (d_scales[g, 2] + of_scale),
    )


@scalar
def offset_gradient(k, start, numbers, num_knots):
    """d `between` / d the value at knot k."""
    low = int(numbers[start])
    g = 0.0
    if k == low:
        g += 1 - numbers[start + 1]
    if k == min(low + 1, num_knots - 1):
        g += numbers[start + 1]
    return g


@scalar
def color_gradients(g, m, colors, offsets, numbers, d_features, d_terms, g_colors, g_offsets):
    """Fill the gradients of a moving Gaussian's color and its changes in time."""
    num_knots = offsets.shape[0]
    for c in range(3):
        stored = colors[m, c] + between(offsets, m, c, MOVING_COLOR, numbers)
        _, slope = radiance_of(stored, numbers[BOUNDED])
        d = d_features[g, c] * slope
        g_colors[m, c] = d
        for k in range(num_knots):
            change = change_gradient(offsets, k, m, c)
            change += numbers[OFFSET_SHARE] * 2 * offsets[k, m, c] / offsets.size
            share = offset_gradient(k, MOVING_COLOR, numbers, num_knots)
            g_offsets[k, m, c] = d * share + d_terms[COLOR_CHANGE] * change


@scalar
def rest_gradients(m, pose, next_pose, d_here, d_there, d_q, g_means, g_quaternions):
    """Fill the gradients of a moving Gaussian's mean and quaternion."""
    for n in range(3):
        d = 0.0
        for axis in range(3):
            d += pose[4 * axis + n] * d_here[axis] + next_pose[4 * axis + n] * d_there[axis]
        g_means[m, n] = d
    back = product((pose[12], -pose[13], -pose[14], -pose[15]), d_q)
    for n in range(4):
        g_quaternions[m, n] = back[n]


@scalar
def static_gradients(g, learned, sight, d, made):
    """Fill the gradients `made` of the six tables of a static Gaussian; `learned` are
    these but for the quaternions.
    """
    means, log_scales, logits, colors, offsets = learned
    d_means, d_quaternions, _, _, d_features, d_terms = d
    g_means, g_quaternions, g_log_scales, g_logits, g_colors, g_offsets = made
    numbers = sight[0]
    x = (means[g, 0], means[g, 1], means[g, 2])
    here, later = mean_gradients(g, x, x, sight, d_means, d_features)
    for n in range(3):
        g_means[g, n] = here[n] + later[n]
    for n in range(4):
        g_quaternions[g, n] = d_quaternions[g, n]
    opacity = sigmoid(logits[g])
    d_opacity, of_scales = shape_gradients(g, g, opacity, log_scales, numbers, d)
    for n in range(3):
        g_log_scales[g, n] = of_scales[n]
    g_logits[g] = d_opacity * opacity * (1 - opacity)
    offset = between(offsets, g, 0, STATIC_COLOR, numbers)
    total = 0.0
    for c in range(3):
        _, slope = radiance_of(colors[g, c] + offset, numbers[BOUNDED])
        g_colors[g, c] = d_features[g, c] * slope
        total += d_features[g, c] * slope
    for k in range(offsets.shape[0]):
        drift = 2 * d_terms[DRIFT] * offsets[k, g, 0] / offsets.size
        g_offsets[k, g, 0] = (
            total * offset_gradient(k, STATIC_COLOR, numbers, offsets.shape[0]) + drift
        )


@scalar
def motion_gradients(g, m, pose, next_pose, learned, sight, d):
    """Gradients of where moving Gaussian m is (3,), will be (3,), and its turn (4,)."""
    means, quaternions = learned[0], learned[1]
    d_quaternions = d[1]
    rest = (means[m, 0], means[m, 1], means[m, 2])
    x, there = move_point(pose, rest), move_point(next_pose, rest)
    d_here, d_there = mean_gradients(g, x, there, sight, d[0], d[4])
    d_q = (d_quaternions[g, 0], d_quaternions[g, 1], d_quaternions[g, 2], d_quaternions[g, 3])
    back = (quaternions[m, 0], -quaternions[m, 1], -quaternions[m, 2], -quaternions[m, 3])
    return d_here, d_there, product(d_q, back)


@scalar
def moving_gradients(g, m, pose, next_pose, d_here, d_there, learned, sight, d, made):
    """Fill the gradients of the seven tables of a moving Gaussian."""
    _, _, log_scales, logits, colors, offsets, presence = learned
    _, d_quaternions, _, _, d_features, d_terms = d
    g_means, g_quaternions, g_log_scales, g_logits, g_colors, g_offsets, g_presence = made
    numbers = sight[0]
    d_q = (d_quaternions[g, 0], d_quaternions[g, 1], d_quaternions[g, 2], d_quaternions[g, 3])
    rest_gradients(m, pose, next_pose, d_here, d_there, d_q, g_means, g_quaternions)
    opacity = sigmoid(logits[m] + between(presence, m, 0, OPACITY, numbers))
    d_opacity, of_scales = shape_gradients(g, m, opacity, log_scales, numbers, d)
    for n in range(3):
        g_log_scales[m, n] = of_scales[n]
    d_logit = d_opacity * opacity * (1 - opacity)
    g_logits[m] = d_logit
    for k in range(presence.shape[0]):
        share = offset_gradient(k, OPACITY, numbers, presence.shape[0])
        change = d_terms[OPACITY_CHANGE] * change_gradient(presence, k, m, 0)
        g_presence[k, m, 0] = d_logit * share + change
    color_gradients(g, m, colors, offsets, numbers, d_features, d_terms, g_colors, g_offsets)


@scalar
def local_gradients(g, r, num_alive, learned, neighbors, sight, d, made, marks):
    """Add the gradients of the tables of a time-local Gaussian, and mark its rows."""
    means, velocities, _, log_scales, colors = learned
    d_means, d_quaternions, _, _, d_features, d_terms = d
    g_means, g_velocities, g_quaternions, g_log_scales, g_colors = made
    numbers = sight[0]
    marks[0][r] = marks[1][r] = marks[2][r] = marks[3][r] = marks[4][r] = 1
    x, there, opacity = local_at(r, learned, numbers)
    here, later = mean_gradients(g, x, there, sight, d_means, d_features)
    age, its_later = numbers[TIME] - means[r, 3], numbers[TIME + 1] - means[r, 3]
    for c in range(3):
        g_means[r, c] += here[c] + later[c]
        d_velocity = here[c] * age + later[c] * its_later
        if numbers[RIGIDITY_DUE] != 0:
            total, _ = unevenness_of(r, velocities, neighbors, numbers, num_alive, c)
            d_velocity += d_terms[EVENNESS] * 2 * total / numbers[UNIT]
        g_velocities[r, c] += d_velocity
        _, slope = radiance_of(colors[r, c], numbers[BOUNDED])
        g_colors[r, c] += d_features[g, c] * slope
    for n in range(4):
        g_quaternions[r, n] += d_quaternions[g, n]
    d_opacity, of_scales = shape_gradients(g, r, opacity, log_scales, numbers, d)
    for n in range(3):
        g_log_scales[r, n] += of_scales[n]
    duration = math.exp(log_scales[r, 3])
    d_duration = d_opacity * opacity * age * age / (duration * duration)
    if d_duration < 0 or duration > numbers[LEAST_DURATION]:  # what is short gets no shorter
        g_log_scales[r, 3] += d_duration
    g_colors[r, 3] += d_opacity * opacity * (1 - sigmoid(colors[r, 3]))
