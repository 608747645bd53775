"""Numba kernels on the CPU of a training picture: drawn planes over the background, and
the objective's terms of a whole frame, with their gradients.

What each pixel does stands in `pixel.py`. Pixels are taken in a fixed number of chunks
that add up their sums each for itself: the same sums whatever the number of threads.
The twins are `cuda/picture_kernels.py` and plain torch (`splat/draw.py:composite`,
`Objective.terms`).

Shapes: N pixels; a picture (N, 3) or flow (N, 2) lies in memory channel by channel.
"""

from __future__ import annotations

import numba

from hdr_nsff.core.jit import jit
from hdr_nsff.fields.kernels.footprint import FAST
from hdr_nsff.fields.kernels.pixel import (
    background_radiance,
    compose_pixel,
    compose_pixel_gradients,
    mix_pixel,
    mix_pixel_gradients,
    pixel_loss_gradients,
    pixel_losses,
)

CHUNKS = 32


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def losses(
    rgb, depth, motion, flow, recorded, disparity, confidence, moving, outline, target, valid,
    margin, limit, sums,
):  # fmt: skip
    """Fill `sums` (CHUNKS, 5) with sums over the pixels of each chunk."""
    count = len(rgb)
    for k in numba.prange(CHUNKS):
        rendered = rgb, depth, motion, flow
        known = recorded, disparity, confidence, moving, outline, target, valid
        picture = far = mask = moved = counts = 0.0
        for i in range(k * count // CHUNKS, (k + 1) * count // CHUNKS):
            own = pixel_losses(i, rendered, known, margin, limit)
            picture += own[0]
            far += own[1]
            mask += own[2]
            moved += own[3]
            counts += own[4]
        sums[k, 0], sums[k, 1], sums[k, 2] = picture, far, mask
        sums[k, 3], sums[k, 4] = moved, counts


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def losses_backward(
    rgb, depth, motion, flow, recorded, disparity, confidence, moving, outline, target, valid,
    near, fade, margin, limit, num_valid, d_terms, g_rgb, g_depth, g_motion, g_flow,
):  # fmt: skip
    """Fill the gradients of what was rendered."""
    count = len(rgb)
    for k in numba.prange(CHUNKS):
        rendered = rgb, depth, motion, flow
        known = recorded, disparity, confidence, moving, outline, target, valid
        numbers, made = (near, fade, margin, limit), (g_rgb, g_depth, g_motion, g_flow)
        for i in range(k * count // CHUNKS, (k + 1) * count // CHUNKS):
            pixel_loss_gradients(i, rendered, known, numbers, num_valid, d_terms, made)


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def compose(
    planes, alphas, background, behind, share, bounded, far, least, least_alpha,
    radiance, depth, motion, flow, late, late_share,
):  # fmt: skip
    """Fill the picture, z-depth, motion, flow (N or 0, 2), and what is recorded `late`
    (N or 0, 3) with its share, of premultiplied `planes` (D, N): these in turn, z-depth
    last. `behind` (3,) and `share` (1,) are those of `pixel.mix_pixel`.
    """
    count, first = len(alphas), 6 if len(flow) else 4
    for k in numba.prange(CHUNKS):
        drawn, made = (planes, planes[-1], alphas), (radiance, depth, motion, flow)
        light, _ = background_radiance(background, bounded)
        for i in range(k * count // CHUNKS, (k + 1) * count // CHUNKS):
            compose_pixel(i, drawn, light, far, least, least_alpha, made)
            if len(late):
                mix_pixel(i, drawn, first, behind, share, late, late_share)


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def compose_backward(
    planes, alphas, background, behind, bounded, least, least_alpha,
    d_radiance, d_depth, d_motion, d_flow, d_late, d_late_share, g_planes, g_alphas, sums,
):  # fmt: skip
    """Fill the gradients of planes and alphas, and `sums` (CHUNKS, 7): those of the
    background, of `behind` and of the share.
    """
    count, first = len(alphas), 6 if len(d_flow) else 4
    for k in numba.prange(CHUNKS):
        drawn, made = (planes, planes[-1], alphas), (g_planes, g_planes[-1], g_alphas)
        d = d_radiance, d_depth, d_motion, d_flow
        light, slope = background_radiance(background, bounded)
        red = green = blue = late_red = late_green = late_blue = g_share = 0.0
        for i in range(k * count // CHUNKS, (k + 1) * count // CHUNKS):
            g = compose_pixel_gradients(i, drawn, light, least, least_alpha, d, made)
            red += g[0]
            green += g[1]
            blue += g[2]
            if len(d_late):
                g_late = mix_pixel_gradients(i, drawn, first, behind, d_late, d_late_share, made)
                late_red += g_late[0]
                late_green += g_late[1]
                late_blue += g_late[2]
                g_share += g_late[3]
        sums[k, 0], sums[k, 1], sums[k, 2] = red * slope[0], green * slope[1], blue * slope[2]
        sums[k, 3], sums[k, 4], sums[k, 5] = late_red, late_green, late_blue
        sums[k, 6] = g_share
