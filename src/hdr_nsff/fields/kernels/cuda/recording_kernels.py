"""CUDA kernels of recordings: what a lens passes of radiance, through a frame's gain
and a response curve, at the pixels of a picture and of Gaussians one by one; with their
gradients.

A thread takes a pixel or a Gaussian forward, every so many of them backward. Sums over
them are added up in shared memory first. The plain-torch twins are `Vignetting`,
`curve.record`, `late_mixing.py:Parts.of` and `ToneMapper.record_render`. Shapes: N
pixels, G Gaussians, F features, C cameras, K <= MAX_KNOTS points of a response curve.
The arguments from `gain` to `least` are those of `Sensor.numbers`; without coefficients
of vignetting, the lens passes all. The simulator of numba-cuda replaces the name `cuda`
in this module.
"""

from __future__ import annotations

import math

from numba import cuda, float32

from hdr_nsff.fields.kernels import moment, pixel
from hdr_nsff.fields.kernels.cuda.device import device_functions, exact_device
from hdr_nsff.fields.kernels.cuda.layout import MAX_KNOTS, THREADS
from hdr_nsff.geometry.pinhole import MIN_DEPTH

pixel_of_point = device_functions(moment, fastmath=False, arrays=True)["pixel_of_point"]
background_radiance = device_functions(pixel, fastmath=False, arrays=True)["background_radiance"]
CURVES = 3 * MAX_KNOTS
SUMS = 6  # gradients of gain and lens, three numbers each


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


@exact_device
def recorded(x, c, curve, knots, leaky, leak):
    """What is recorded of exposure x in channel c (eq. 11)."""
    if x >= 0 and x <= 1:
        b = bin_of(x, knots)
        share = (x - knots[b]) / (knots[b + 1] - knots[b])
        return curve[c, b] + (curve[c, b + 1] - curve[c, b]) * share
    if x > 1:
        return 1 + leak - leak / math.sqrt(x) if leaky != 0 else curve[c, curve.shape[1] - 1]
    if x < 0:
        return leak * x if leaky != 0 else curve[c, 0]
    return x  # NaN


@exact_device
def exposure_gradient(x, d, c, curve, knots, leaky, leak, curves):
    """Gradient of exposure x, where that of what is recorded is d; adds the curve's to
    shared `curves` (CURVES,).
    """
    at = c * MAX_KNOTS
    if x != x:  # NaN has no bin and no slope, but the curve shall not hide it
        cuda.atomic.add(curves, at, float32(x))
        return 0.0
    if x >= 0 and x <= 1:
        b = bin_of(x, knots)
        inverse = 1 / (knots[b + 1] - knots[b])
        right = d * (x - knots[b]) * inverse
        cuda.atomic.add(curves, at + b, float32(d - right))
        cuda.atomic.add(curves, at + b + 1, float32(right))
        return d * (curve[c, b + 1] - curve[c, b]) * inverse
    if leaky != 0:
        return d * (0.5 * leak / (x * math.sqrt(x)) if x > 1 else leak)
    if x > 1:
        cuda.atomic.add(curves, at + curve.shape[1] - 1, float32(d))
    else:
        cuda.atomic.add(curves, at, float32(d))
    return 0.0


@exact_device
def squared_radius(x, y, K, corner):
    """Squared tangent of pixel (x, y) to the axis, 1 at the `corner`."""
    x = (x - K[0, 2]) / K[0, 0]
    y = (y - K[1, 2]) / K[1, 1]
    return (x * x + y * y) / corner


@exact_device
def transmission(r2, v):
    """Share of light at a squared radius, of coefficients v (3,), not held yet."""
    return 1 + r2 * (v[0] + r2 * (v[1] + r2 * v[2]))


@exact_device
def radius_of_pixel(i, pixels, K, vignetting, corners, camera_id):
    """`squared_radius` of pixel i; 0 where the lens passes all."""
    if vignetting.shape[0] == 0:
        return 0.0
    return float(squared_radius(pixels[i, 0], pixels[i, 1], K, corners[camera_id]))


@exact_device
def radius_of_mean(i, means, K, c2w, width, height, vignetting, corners, camera_id):
    """`squared_radius` of the pixel of Gaussian i; 0 where the lens passes all."""
    if vignetting.shape[0] == 0:
        return 0.0
    point = means[i, 0], means[i, 1], means[i, 2]
    at, _, _ = pixel_of_point(point, K, c2w, MIN_DEPTH)
    x, y = min(max(at[0], 0.0), float(width)), min(max(at[1], 0.0), float(height))
    return float(squared_radius(x, y, K, corners[camera_id]))


@exact_device
def passed(r2, vignetting, camera_id, least):
    """Share of light that the lens passes at a squared radius."""
    if vignetting.shape[0] == 0:
        return 1.0
    return max(float(transmission(r2, vignetting[camera_id])), least)


@exact_device
def channel_gradients(r, d, light, c, gain, curve, knots, leaky, leak, curves):
    """Gradients of radiance r in channel c, of gain and of the share of light, where
    that of what is recorded is d; adds the curve's to shared `curves` (CURVES,).
    """
    g = exposure_gradient(r * light * gain[c], d, c, curve, knots, leaky, leak, curves)
    return g * light * gain[c], g * light * r, g * gain[c] * r


@exact_device
def add_at(sums, c, value):
    """`sums` (3,) with a value added to number c."""
    red = sums[0] + (value if c == 0 else 0.0)
    green = sums[1] + (value if c == 1 else 0.0)
    return red, green, sums[2] + (value if c == 2 else 0.0)


@exact_device
def add_lens(sums, d, r2, vignetting, camera_id, least):
    """`sums` (3,) with the gradients of a lens added, where that of its share is d."""
    if vignetting.shape[0] == 0 or transmission(r2, vignetting[camera_id]) < least:
        return sums
    return sums[0] + d * r2, sums[1] + d * r2 * r2, sums[2] + d * r2 * r2 * r2


@exact_device
def clear(curves, sums):
    """Shared sums start at 0."""
    thread = cuda.threadIdx.x
    for n in range(thread, CURVES, THREADS):
        curves[n] = 0.0
    if thread < SUMS:
        sums[thread] = 0.0
    cuda.syncthreads()


@exact_device
def give(curves, of_gain, of_lens, sums, camera_id, g_gain, g_curve, g_vignetting):
    """Add the sums of a block's threads to the gradients of gain (3,), curve (3, K) and
    lenses (C, 3); `of_gain` (3,) and `of_lens` (3,) are one thread's.
    """
    thread = cuda.threadIdx.x
    for n in range(3):
        cuda.atomic.add(sums, n, float32(of_gain[n]))
        cuda.atomic.add(sums, 3 + n, float32(of_lens[n]))
    cuda.syncthreads()
    if thread < 3:
        cuda.atomic.add(g_gain, thread, sums[thread])
        if g_vignetting.shape[0] > 0:
            cuda.atomic.add(g_vignetting, (camera_id, thread), sums[3 + thread])
    for c in range(3):
        for k in range(thread, g_curve.shape[1], THREADS):
            cuda.atomic.add(g_curve, (c, k), curves[c * MAX_KNOTS + k])


def photograph(
    radiance, late, late_share, pixels, K,
    gain, curve, knots, vignetting, corners, leaky, leak, camera_id, least, rgb,
):  # fmt: skip
    """Fill `rgb` (N, 3) with what is recorded of `radiance` (N, 3), `late` (N or 0, 3)
    having a share (N or 0, 1) in it.
    """
    i = cuda.grid(1)
    if i >= radiance.shape[0]:
        return
    r2 = radius_of_pixel(i, pixels, K, vignetting, corners, camera_id)
    light = passed(r2, vignetting, camera_id, least)
    for c in range(3):
        y = recorded(radiance[i, c] * light * gain[c], c, curve, knots, leaky, leak)
        if late.shape[0] > 0:
            y += late_share[i, 0] * (late[i, c] - y)
        rgb[i, c] = y


def photograph_backward(
    radiance, late, late_share, pixels, K,
    gain, curve, knots, vignetting, corners, leaky, leak, camera_id, least,
    d_rgb, g_radiance, g_late, g_late_share, g_gain, g_curve, g_vignetting,
):  # fmt: skip
    """Fill the gradients of what is given for each pixel, and add to the others."""
    curves = cuda.shared.array(CURVES, float32)
    sums = cuda.shared.array(SUMS, float32)
    clear(curves, sums)
    of_gain = of_lens = (0.0, 0.0, 0.0)
    for i in range(cuda.grid(1), radiance.shape[0], cuda.gridDim.x * THREADS):
        r2 = radius_of_pixel(i, pixels, K, vignetting, corners, camera_id)
        light = passed(r2, vignetting, camera_id, least)
        d_light = d_share = 0.0
        for c in range(3):
            r, d = radiance[i, c], float(d_rgb[i, c])
            if late.shape[0] > 0:
                share, x = late_share[i, 0], r * light * gain[c]
                d_share += d * (late[i, c] - recorded(x, c, curve, knots, leaky, leak))
                g_late[i, c] = d * share
                d -= d * share
            g = channel_gradients(r, d, light, c, gain, curve, knots, leaky, leak, curves)
            g_radiance[i, c] = g[0]
            of_gain = add_at(of_gain, c, g[1])
            d_light += g[2]
        if late.shape[0] > 0:
            g_late_share[i, 0] = d_share
        of_lens = add_lens(of_lens, d_light, r2, vignetting, camera_id, least)
    give(curves, of_gain, of_lens, sums, camera_id, g_gain, g_curve, g_vignetting)


def record_parts(
    features, background, means, K, c2w, width, height, bounded,
    gain, curve, knots, vignetting, corners, leaky, leak, camera_id, least, made, behind,
):  # fmt: skip
    """Fill `made` (G, F + 3) with `features` (G, F) and what is recorded of the first
    three, and `behind` (3,) with what is recorded of the stored `background` (3,).
    """
    i, count, num_features = cuda.grid(1), features.shape[0], features.shape[1]
    if i < count:
        for n in range(num_features):
            made[i, n] = features[i, n]
        r2 = radius_of_mean(i, means, K, c2w, width, height, vignetting, corners, camera_id)
        light = passed(r2, vignetting, camera_id, least)
        for c in range(3):
            x = features[i, c] * light * gain[c]
            made[i, num_features + c] = recorded(x, c, curve, knots, leaky, leak)
    elif i == count:
        radiance, _ = background_radiance(background, bounded)
        for c in range(3):
            behind[c] = recorded(radiance[c] * gain[c], c, curve, knots, leaky, leak)


def record_parts_backward(
    features, background, means, K, c2w, width, height, bounded,
    gain, curve, knots, vignetting, corners, leaky, leak, camera_id, least,
    d_made, d_behind, g_features, g_background, g_gain, g_curve, g_vignetting,
):  # fmt: skip
    """Fill the gradients of features, and add to the others."""
    curves = cuda.shared.array(CURVES, float32)
    sums = cuda.shared.array(SUMS, float32)
    clear(curves, sums)
    count, num_features = features.shape[0], features.shape[1]
    of_gain = of_lens = (0.0, 0.0, 0.0)
    for i in range(cuda.grid(1), count + 1, cuda.gridDim.x * THREADS):
        behind, slope = background_radiance(background, bounded)
        r2, light, d_light = 0.0, 1.0, 0.0
        if i < count:
            r2 = radius_of_mean(i, means, K, c2w, width, height, vignetting, corners, camera_id)
            light = passed(r2, vignetting, camera_id, least)
            for n in range(num_features):
                g_features[i, n] = d_made[i, n]
        for c in range(3):
            r = float(features[i, c]) if i < count else behind[c]
            d = float(d_made[i, num_features + c] if i < count else d_behind[c])
            g = channel_gradients(r, d, light, c, gain, curve, knots, leaky, leak, curves)
            if i < count:
                g_features[i, c] += g[0]
            else:
                cuda.atomic.add(g_background, c, float32(g[0] * slope[c]))
            of_gain = add_at(of_gain, c, g[1])
            d_light += g[2]
        if i < count:
            of_lens = add_lens(of_lens, d_light, r2, vignetting, camera_id, least)
    give(curves, of_gain, of_lens, sums, camera_id, g_gain, g_curve, g_vignetting)
