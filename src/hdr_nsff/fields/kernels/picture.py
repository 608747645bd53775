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
    planes, alphas, background, bounded, far, least, least_alpha,
    radiance, depth, motion, flow, late,
):  # fmt: skip
    """Fill the picture, z-depth, motion, flow (N or 0, 2) and what is recorded `late`
    (N or 0, 3), of premultiplied `planes` (D, N): these in turn, z-depth last.
    """
    count, first = len(alphas), 6 if len(flow) else 4
    for k in numba.prange(CHUNKS):
        drawn, made = (planes, planes[-1], alphas), (radiance, depth, motion, flow)
        behind, _ = background_radiance(background, bounded)
        for i in range(k * count // CHUNKS, (k + 1) * count // CHUNKS):
            compose_pixel(i, drawn, behind, far, least, least_alpha, made)
            if len(late):
                for c in range(3):
                    late[i, c] = planes[first + c, i]


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def compose_backward(
    planes, alphas, background, bounded, least, least_alpha,
    d_radiance, d_depth, d_motion, d_flow, d_late, g_planes, g_alphas, g_background,
):  # fmt: skip
    """Fill the gradients of planes and alphas, and of the background (CHUNKS, 3)."""
    count, first = len(alphas), 6 if len(d_flow) else 4
    for k in numba.prange(CHUNKS):
        drawn, made = (planes, planes[-1], alphas), (g_planes, g_planes[-1], g_alphas)
        d = d_radiance, d_depth, d_motion, d_flow
        behind, slope = background_radiance(background, bounded)
        red = green = blue = 0.0
        for i in range(k * count // CHUNKS, (k + 1) * count // CHUNKS):
            g = compose_pixel_gradients(i, drawn, behind, least, least_alpha, d, made)
            red += g[0]
            green += g[1]
            blue += g[2]
            if len(d_late):
                for c in range(3):
                    g_planes[first + c, i] = d_late[i, c]
        g_background[k, 0] = red * slope[0]
        g_background[k, 1] = green * slope[1]
        g_background[k, 2] = blue * slope[2]
