"""CUDA kernels of a picture's pixels: what a lens passes, what a camera records of it,
and the differences to the recording and the priors; with their gradients.

A thread takes every so many pixels. Sums over pixels are added up in shared memory
first. Composites and losses of a pixel stand in `kernels/pixel.py`. The
plain-torch twins are `Vignetting`, `curve.record` and `maths/losses.py`.
Shapes: N pixels, K <= MAX_KNOTS points of a response curve. The simulator of numba-cuda
replaces the name `cuda` in this module.
"""

from __future__ import annotations

import math

from numba import cuda, float32

from hdr_nsff.fields.kernels import pixel
from hdr_nsff.fields.kernels.cuda.device import device_functions, exact_device
from hdr_nsff.fields.kernels.cuda.layout import MAX_KNOTS, PICTURE_SUMS, THREADS
from hdr_nsff.fields.kernels.pixel import DEPTH, FLOW, MASK, PHOTOMETRIC, VALID

PIXEL = device_functions(pixel, fastmath=False, arrays=True)
background_radiance = PIXEL["background_radiance"]
pixel_losses, pixel_loss_gradients = PIXEL["pixel_losses"], PIXEL["pixel_loss_gradients"]
compose_pixel = PIXEL["compose_pixel"]
compose_pixel_gradients = PIXEL["compose_pixel_gradients"]
CURVES = 3 * MAX_KNOTS
DONE = 5  # position in `sums` of `losses`, after those of `pixel.py`: blocks that are done


@exact_device
def bin_of(x, knots):
    """Bin with knots[bin] < x <= knots[bin + 1], the first one for 0; x in [0, 1]."""
    low, high = 0, knots.shape[0] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if x > knots[middle]:
            low = middle
        else:
            high = middle
    return low


def respond(radiance, gain, values, knots, leaky, leak, rgb):
    """`tonemap.kernel.forward`: fill `rgb` (N, 3) with the recording of `radiance`."""
    i = cuda.grid(1)
    if i >= radiance.shape[0]:
        return
    for c in range(3):
        x = radiance[i, c] * gain[c]
        if x >= 0 and x <= 1:
            b = bin_of(x, knots)
            share = (x - knots[b]) / (knots[b + 1] - knots[b])
            rgb[i, c] = values[c, b] + (values[c, b + 1] - values[c, b]) * share
        elif x > 1:
            rgb[i, c] = 1 + leak - leak / math.sqrt(x) if leaky != 0 else values[c, -1]
        elif x < 0:
            rgb[i, c] = leak * x if leaky != 0 else values[c, 0]
        else:
            rgb[i, c] = x  # NaN


@exact_device
def recorded_slope(x, g, c, values, knots, leaky, leak, curves):
    """Slope of the recording at x; adds the gradient g to shared `curves` (CURVES,)."""
    at = c * MAX_KNOTS
    if x >= 0 and x <= 1:
        b = bin_of(x, knots)
        inverse = 1 / (knots[b + 1] - knots[b])
        right = g * (x - knots[b]) * inverse
        cuda.atomic.add(curves, at + b, float32(g - right))
        cuda.atomic.add(curves, at + b + 1, float32(right))
        return (values[c, b + 1] - values[c, b]) * inverse
    if leaky != 0:
        return 0.5 * leak / (x * math.sqrt(x)) if x > 1 else leak
    if x > 1:
        cuda.atomic.add(curves, at + values.shape[1] - 1, float32(g))
    elif x < 0:
        cuda.atomic.add(curves, at, float32(g))
    return 0.0


def respond_backward(
    radiance, gain, values, knots, leaky, leak, d_rgb, g_radiance, g_gain, g_values
):  # fmt: skip
    """Fill `g_radiance`, and add to the gradients of gain (3,) and curve (3, K)."""
    curves = cuda.shared.array(CURVES, float32)
    gains = cuda.shared.array(3, float32)
    thread = cuda.threadIdx.x
    for n in range(thread, CURVES, THREADS):
        curves[n] = 0.0
    if thread < 3:
        gains[thread] = 0.0
    cuda.syncthreads()
    total0 = total1 = total2 = 0.0
    for i in range(cuda.grid(1), radiance.shape[0], cuda.gridDim.x * THREADS):
        for c in range(3):
            r, g = radiance[i, c], d_rgb[i, c]
            x = r * gain[c]
            slope = 0.0
            if x != x:  # NaN has no bin and no slope, but the curve shall not hide it
                cuda.atomic.add(curves, c * MAX_KNOTS, x)
            else:
                slope = recorded_slope(x, g, c, values, knots, leaky, leak, curves)
            g_radiance[i, c] = g * slope * gain[c]
            d = g * slope * r
            total0 += d if c == 0 else 0.0
            total1 += d if c == 1 else 0.0
            total2 += d if c == 2 else 0.0
    cuda.atomic.add(gains, 0, float32(total0))
    cuda.atomic.add(gains, 1, float32(total1))
    cuda.atomic.add(gains, 2, float32(total2))
    cuda.syncthreads()
    if thread < 3:
        cuda.atomic.add(g_gain, thread, gains[thread])
    for c in range(3):
        for k in range(thread, values.shape[1], THREADS):
            cuda.atomic.add(g_values, (c, k), curves[c * MAX_KNOTS + k])


@exact_device
def squared_radius(i, pixels, K, corner):
    """Squared tangent of pixel i to the axis, 1 at the `corner`."""
    x = (pixels[i, 0] - K[0, 2]) / K[0, 0]
    y = (pixels[i, 1] - K[1, 2]) / K[1, 1]
    return (x * x + y * y) / corner


@exact_device
def transmission(r2, v):
    """Share of light at a squared radius, of coefficients v (3,), not held yet."""
    return 1 + r2 * (v[0] + r2 * (v[1] + r2 * v[2]))


def shade(radiance, pixels, K, corners, coefficients, camera_id, least, shaded):
    """Fill `shaded` (N, 3) with what the lens of a camera passes of `radiance`."""
    i = cuda.grid(1)
    if i >= radiance.shape[0]:
        return
    r2 = squared_radius(i, pixels, K, corners[camera_id])
    share = max(transmission(r2, coefficients[camera_id]), least)
    for c in range(3):
        shaded[i, c] = radiance[i, c] * share


def shade_backward(
    radiance, pixels, K, corners, coefficients, camera_id, least, d_shaded, g_radiance, g
):  # fmt: skip
    """Fill `g_radiance`, and add to the gradients `g` (C, 3) of the coefficients."""
    sums = cuda.shared.array(3, float32)
    thread = cuda.threadIdx.x
    if thread < 3:
        sums[thread] = 0.0
    cuda.syncthreads()
    d0 = d1 = d2 = 0.0
    for i in range(cuda.grid(1), radiance.shape[0], cuda.gridDim.x * THREADS):
        r2 = squared_radius(i, pixels, K, corners[camera_id])
        free = transmission(r2, coefficients[camera_id])
        share = max(free, least)
        d = 0.0
        for c in range(3):
            g_radiance[i, c] = d_shaded[i, c] * share
            d += d_shaded[i, c] * radiance[i, c]
        if free >= least:
            d0 += d * r2
            d1 += d * r2 * r2
            d2 += d * r2 * r2 * r2
    cuda.atomic.add(sums, 0, float32(d0))
    cuda.atomic.add(sums, 1, float32(d1))
    cuda.atomic.add(sums, 2, float32(d2))
    cuda.syncthreads()
    if thread < 3:
        cuda.atomic.add(g, (camera_id, thread), sums[thread])


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
    planes, depths, alphas, background, bounded, far, least, least_alpha,
    radiance, depth, motion, flow,
):  # fmt: skip
    """Fill the picture (N, 3), z-depth, motion and flow (N, 2 or 0 of them) over the
    background, of premultiplied `planes` (D, N), `depths` and `alphas` (N,).
    """
    i = cuda.grid(1)
    if i >= alphas.shape[0]:
        return
    behind, _ = background_radiance(background, bounded)
    made = radiance, depth, motion, flow
    compose_pixel(i, (planes, depths, alphas), behind, far, least, least_alpha, made)


def compose_backward(
    planes, depths, alphas, background, bounded, far, least, least_alpha,
    d_radiance, d_depth, d_motion, d_flow, g_planes, g_depths, g_alphas, g_background,
):  # fmt: skip
    """Fill the gradients of the maps, and add to those of the background (3,)."""
    sums = cuda.shared.array(3, float32)
    thread = cuda.threadIdx.x
    if thread < 3:
        sums[thread] = 0.0
    cuda.syncthreads()
    behind, slope = background_radiance(background, bounded)
    drawn, made = (planes, depths, alphas), (g_planes, g_depths, g_alphas)
    d = d_radiance, d_depth, d_motion, d_flow
    for i in range(cuda.grid(1), alphas.shape[0], cuda.gridDim.x * THREADS):
        g = compose_pixel_gradients(i, drawn, behind, least, least_alpha, d, made)
        for c in range(3):
            cuda.atomic.add(sums, c, float32(g[c] * slope[c]))
    cuda.syncthreads()
    if thread < 3:
        cuda.atomic.add(g_background, thread, sums[thread])
