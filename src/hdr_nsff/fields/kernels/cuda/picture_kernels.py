"""CUDA kernels of a picture's pixels: composites over the background, and differences
to the recording and the priors; with their gradients.

A thread takes every so many pixels. Sums over pixels are added up in shared memory
first. What each pixel does stands in `kernels/pixel.py`; the plain-torch twins are
`splat/draw.py:composite` and `maths/losses.py`. Shapes: N pixels. The simulator of
numba-cuda replaces the name `cuda` in this module.
"""

from __future__ import annotations

from numba import cuda, float32

from hdr_nsff.fields.kernels import pixel
from hdr_nsff.fields.kernels.cuda.device import device_functions
from hdr_nsff.fields.kernels.cuda.layout import PICTURE_SUMS, THREADS
from hdr_nsff.fields.kernels.pixel import DEPTH, FLOW, MASK, PHOTOMETRIC, VALID

PIXEL = device_functions(pixel, fastmath=False, arrays=True)
background_radiance = PIXEL["background_radiance"]
pixel_losses, pixel_loss_gradients = PIXEL["pixel_losses"], PIXEL["pixel_loss_gradients"]
compose_pixel = PIXEL["compose_pixel"]
compose_pixel_gradients = PIXEL["compose_pixel_gradients"]
mix_pixel, mix_pixel_gradients = PIXEL["mix_pixel"], PIXEL["mix_pixel_gradients"]
DONE = 5  # position in `sums` of `losses`, after those of `pixel.py`: blocks that are done


def losses(
    rgb, recorded, depth, disparity, confidence, motion, moving, outline, flow, flow_target,
    flow_valid, near, fade, margin, limit, sums,
):  # fmt: skip
    """Add up the terms of the objective in `sums` (PICTURE_SUMS,), which start at 0.

    A prior that is missing has no pixels.
    """
    shared = cuda.shared.array(PICTURE_SUMS, float32)
    thread, count = cuda.threadIdx.x, rgb.shape[0]
    if thread < PICTURE_SUMS:
        shared[thread] = 0.0
    cuda.syncthreads()
    rendered = rgb, depth, motion, flow
    known = recorded, disparity, confidence, moving, outline, flow_target, flow_valid
    picture = far = mask = moved = valid = 0.0
    for i in range(cuda.grid(1), count, cuda.gridDim.x * THREADS):
        own = pixel_losses(i, rendered, known, margin, limit)
        picture += own[0]
        far += own[1]
        mask += own[2]
        moved += own[3]
        valid += own[4]
    cuda.atomic.add(shared, PHOTOMETRIC, float32(picture))
    cuda.atomic.add(shared, DEPTH, float32(far))
    cuda.atomic.add(shared, MASK, float32(mask))
    cuda.atomic.add(shared, FLOW, float32(moved))
    cuda.atomic.add(shared, VALID, float32(valid))
    cuda.syncthreads()
    if thread == 0:
        cuda.atomic.add(sums, PHOTOMETRIC, float32(shared[PHOTOMETRIC] / (3 * count)))
        cuda.atomic.add(sums, DEPTH, float32(shared[DEPTH] * near * fade / count))
        cuda.atomic.add(sums, MASK, float32(shared[MASK] / count))
        cuda.atomic.add(sums, FLOW, float32(shared[FLOW] * fade))
        cuda.atomic.add(sums, VALID, shared[VALID])
        cuda.threadfence()
        if cuda.atomic.add(sums, DONE, float32(1)) == cuda.gridDim.x - 1:
            # what other blocks added is only sure to be seen by atomic reads
            total = cuda.atomic.add(sums, FLOW, float32(0))
            pixels = cuda.atomic.add(sums, VALID, float32(0))
            sums[FLOW] = total / max(pixels, float32(1))


def losses_backward(
    rgb, recorded, depth, disparity, confidence, motion, moving, outline, flow, flow_target,
    flow_valid, near, fade, margin, limit, sums, d_terms, g_rgb, g_depth, g_motion, g_flow,
):  # fmt: skip
    """Fill the gradients of what was rendered, a thread per pixel."""
    i = cuda.grid(1)
    if i >= rgb.shape[0]:
        return
    rendered = rgb, depth, motion, flow
    known = recorded, disparity, confidence, moving, outline, flow_target, flow_valid
    numbers, made = (near, fade, margin, limit), (g_rgb, g_depth, g_motion, g_flow)
    pixel_loss_gradients(i, rendered, known, numbers, sums[VALID], d_terms, made)


def compose(
    planes, depths, alphas, background, behind, share, bounded, far, least, least_alpha,
    radiance, depth, motion, flow, late, late_share,
):  # fmt: skip
    """Fill the picture (N, 3), z-depth, motion, flow (N or 0, 2), and what is recorded
    `late` (N or 0, 3) with its share, over the background, of premultiplied `planes`
    (D, N), `depths` and `alphas` (N,).
    """
    i = cuda.grid(1)
    if i >= alphas.shape[0]:
        return
    light, _ = background_radiance(background, bounded)
    drawn, made = (planes, depths, alphas), (radiance, depth, motion, flow)
    compose_pixel(i, drawn, light, far, least, least_alpha, made)
    if late.shape[0] > 0:
        first = 6 if flow.shape[0] > 0 else 4
        mix_pixel(i, drawn, first, behind, share, late, late_share)


def compose_backward(
    planes, depths, alphas, background, behind, share, bounded, far, least, least_alpha,
    d_radiance, d_depth, d_motion, d_flow, d_late, d_late_share,
    g_planes, g_depths, g_alphas, g_background, g_behind, g_share,
):  # fmt: skip
    """Fill the gradients of the maps, and add to those of the background (3,), of what
    is recorded of it, and of the share (1,).
    """
    sums = cuda.shared.array(7, float32)
    thread = cuda.threadIdx.x
    if thread < 7:
        sums[thread] = 0.0
    cuda.syncthreads()
    light, slope = background_radiance(background, bounded)
    drawn, made = (planes, depths, alphas), (g_planes, g_depths, g_alphas)
    d = d_radiance, d_depth, d_motion, d_flow
    first = 6 if d_flow.shape[0] > 0 else 4
    for i in range(cuda.grid(1), alphas.shape[0], cuda.gridDim.x * THREADS):
        g = compose_pixel_gradients(i, drawn, light, least, least_alpha, d, made)
        for c in range(3):
            cuda.atomic.add(sums, c, float32(g[c] * slope[c]))
        if d_late.shape[0] > 0:
            g_late = mix_pixel_gradients(i, drawn, first, behind, d_late, d_late_share, made)
            for c in range(4):
                cuda.atomic.add(sums, 3 + c, float32(g_late[c]))
    cuda.syncthreads()
    if thread < 3:
        cuda.atomic.add(g_background, thread, sums[thread])
        if d_late.shape[0] > 0:
            cuda.atomic.add(g_behind, thread, sums[3 + thread])
    if thread == 3 and d_late.shape[0] > 0:
        cuda.atomic.add(g_share, 0, sums[6])
