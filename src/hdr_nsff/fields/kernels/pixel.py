"""One pixel of a training picture: composited over the background, and its differences
to the recording and the priors; with their gradients.

numba compiles these functions for the CPU (`picture.py`), and numba-cuda the same ones
for NVIDIA GPUs (`cuda/picture_kernels.py`). The plain-torch twins are
`splat/draw.py:composite` and `maths/losses.py`.

Shapes: N pixels, of which i is one, and D planes of features.
"""

from __future__ import annotations

import math

from numba import float32

from hdr_nsff.fields.kernels.moment import radiance_of, scalar

# positions in the sums of `pixel_losses`: the terms, and valid pixels of flow
PHOTOMETRIC, DEPTH, MASK, FLOW, VALID = 0, 1, 2, 3, 4


@scalar
def sign(x):
    """-1, 0 or 1."""
    return (1.0 if x > 0 else 0.0) - (1.0 if x < 0 else 0.0)


@scalar
def flow_error(i, flow, target):
    """Absolute difference of flow at pixel i, both axes added up."""
    return abs(flow[i, 0] - target[i, 0]) + abs(flow[i, 1] - target[i, 1])


@scalar
def pixel_losses(i, rendered, known, margin, limit):
    """What pixel i adds to the sums of the terms, and 1 where its flow is valid.

    `rendered` are rgb, z-depth, motion and flow, `known` is what they are compared
    with. A prior that is missing has no pixels.
    """
    rgb, depth, motion, flow = rendered
    recorded, disparity, confidence, moving, outline, target, valid = known
    picture = far = mask = moved = counts = 0.0
    for c in range(3):
        picture += abs(rgb[i, c] - recorded[i, c])
    if disparity.shape[0] > 0:
        trust = confidence[i] if confidence.shape[0] > 0 else float32(1.0)
        far = trust * abs(1 / depth[i] - disparity[i])
    if moving.shape[0] > 0 and (outline.shape[0] == 0 or outline[i] == 0):
        inside = motion[i] * (1 - 2 * margin) + margin
        mask = -math.log(inside if moving[i] != 0 else 1 - inside)
    if valid.shape[0] > 0 and valid[i] != 0:
        moved = min(flow_error(i, flow, target), limit)
        counts = 1.0
    return picture, far, mask, moved, counts


@scalar
def pixel_loss_gradients(i, rendered, known, numbers, num_valid, d_terms, made):
    """Fill the gradients of what was rendered of pixel i, of mean terms `d_terms`.

    `numbers` are near, fade, margin and limit.
    """
    rgb, depth, motion, flow = rendered
    recorded, disparity, confidence, moving, outline, target, valid = known
    near, fade, margin, limit = numbers
    g_rgb, g_depth, g_motion, g_flow = made
    count = rgb.shape[0]
    for c in range(3):
        g_rgb[i, c] = d_terms[PHOTOMETRIC] / (3 * count) * sign(rgb[i, c] - recorded[i, c])
    g_depth[i] = g_motion[i] = 0.0
    if disparity.shape[0] > 0:
        trust = confidence[i] if confidence.shape[0] > 0 else float32(1.0)
        inverse = 1 / depth[i]
        d = trust * sign(inverse - disparity[i]) * near * fade / count
        g_depth[i] = -d_terms[DEPTH] * d * inverse * inverse
    if moving.shape[0] > 0 and (outline.shape[0] == 0 or outline[i] == 0):
        inside = motion[i] * (1 - 2 * margin) + margin
        d = -1 / inside if moving[i] != 0 else 1 / (1 - inside)
        g_motion[i] = d_terms[MASK] * d * (1 - 2 * margin) / count
    if flow.shape[0] > 0:
        weight = 0.0
        if valid[i] != 0 and flow_error(i, flow, target) <= limit:
            weight = d_terms[FLOW] * fade / max(num_valid, float32(1))
        for axis in range(2):
            g_flow[i, axis] = weight * sign(flow[i, axis] - target[i, axis])


@scalar
def background_radiance(background, bounded):
    """Radiance (3,) of stored numbers (3,), and its derivatives."""
    r, dr = radiance_of(background[0], bounded)
    g, dg = radiance_of(background[1], bounded)
    b, db = radiance_of(background[2], bounded)
    return (r, g, b), (dr, dg, db)


@scalar
def compose_pixel(i, drawn, behind, far, least, least_alpha, made):
    """Fill pixel i's radiance, z-depth, motion and flow over what lies `behind`.

    `drawn` are premultiplied planes (D, N), z-depths (N,) and alphas (N,). Where alpha
    is at most `least_alpha`, the depth is `far`, and nowhere is it below `least`.
    """
    planes, depths, alphas = drawn
    radiance, depth, motion, flow = made
    alpha = float(alphas[i])
    for c in range(3):
        radiance[i, c] = planes[c, i] + (1 - alpha) * behind[c]
    z = far
    if alphas[i] > float32(least_alpha):
        z = depths[i] / alpha
    depth[i] = max(z, least)
    motion[i] = planes[3, i]
    if flow.shape[0] > 0:
        for axis in range(2):
            flow[i, axis] = planes[4 + axis, i] / max(alpha, least_alpha)


@scalar
def compose_pixel_gradients(i, drawn, behind, least, least_alpha, d, made):
    """Fill the gradients of what was drawn at pixel i; returns those of `behind`."""
    planes, depths, alphas = drawn
    d_radiance, d_depth, d_motion, d_flow = d
    g_planes, g_depths, g_alphas = made
    alpha = float(alphas[i])
    g_alpha = g_depth = 0.0
    for c in range(3):
        g_planes[c, i] = d_radiance[i, c]
        g_alpha -= d_radiance[i, c] * behind[c]
    if alphas[i] > float32(least_alpha) and depths[i] / alpha >= least:
        g_depth = d_depth[i] / alpha
        g_alpha -= g_depth * depths[i] / alpha
    g_planes[3, i] = d_motion[i]
    if d_flow.shape[0] > 0:
        for axis in range(2):
            d_axis = d_flow[i, axis] / max(alpha, least_alpha)
            g_planes[4 + axis, i] = d_axis
            if alphas[i] >= float32(least_alpha):
                g_alpha -= d_axis * planes[4 + axis, i] / alpha
    g_depths[i], g_alphas[i] = g_depth, g_alpha
    left = 1 - alpha
    return d_radiance[i, 0] * left, d_radiance[i, 1] * left, d_radiance[i, 2] * left


@scalar
def mix_pixel(i, drawn, first, behind, share, late, late_share):
    """Fill pixel i's average of what is recorded of its parts (N, 3), and the share
    (N, 1) that it has in the pixel.

    What is recorded of the Gaussians are three planes from the `first` on; `behind`
    (3,) is that of the background, and `share` (1,) that of a pixel at rest.
    """
    planes, _, alphas = drawn
    left = 1 - float(alphas[i])
    for c in range(3):
        late[i, c] = planes[first + c, i] + left * behind[c]
    late_share[i, 0] = share[0] * (1 - planes[3, i])


@scalar
def mix_pixel_gradients(i, drawn, first, behind, d_late, d_late_share, made):
    """Fill the gradients of the three planes at pixel i, and add to that of alpha;
    returns those of `behind` and the share. Motion gets none.
    """
    planes, _, alphas = drawn
    g_planes, _, g_alphas = made
    for c in range(3):
        g_planes[first + c, i] = d_late[i, c]
        g_alphas[i] -= d_late[i, c] * behind[c]
    left = 1 - float(alphas[i])
    g_share = d_late_share[i, 0] * (1 - planes[3, i])
    return d_late[i, 0] * left, d_late[i, 1] * left, d_late[i, 2] * left, g_share
