"""CUDA kernels of the shared tone mapper's learned numbers: response curves, a frame's
gain, and the regularizers; with their gradients.

A block per curve, a thread per knot; the first block does everything that is not a
curve. The plain-torch twins are `BracketGain`, `SharedResponse.values` and
`SharedToneMapper.regularizers`. Shapes: C cameras, B brackets, U of them unknown, F
training frames, K knots. A camera, a bracket and a frame choose the gain; a frame of -1
is any other view. The simulator of numba-cuda replaces the name `cuda` in
this module.
"""

from __future__ import annotations

import math

from numba import cuda, float64

from hdr_nsff.fields.kernels.cuda.device import exact_device
from hdr_nsff.fields.kernels.cuda.layout import MAX_KNOTS

SMOOTHNESS, RESIDUAL, ANCHOR, VIGNETTING = 0, 1, 2, 3  # positions in `terms`
LN2 = math.log(2.0)


@exact_device
def ev_of(b, known, unknown, learned):
    """EV of a bracket: as given, or as learned."""
    ev = float(known[b])
    for u in range(unknown.shape[0]):
        if unknown[u] == b:
            ev = float(learned[u])
    return ev


@exact_device
def log_gain(c, known, unknown, learned, drift, white, residual, means, camera, bracket, frame):
    """Natural log gain of channel c, of residuals whose `means` are taken off."""
    log = ev_of(bracket, known, unknown, learned) * LN2
    if camera > 0:
        log += white[camera - 1, c]
    if frame >= 0:
        log += drift[frame, c]
        if residual.shape[0] > 0:
            log += residual[frame, c] - means[c]
    return log


@exact_device
def largest(values):
    """The largest of values (N,)."""
    top = values[0]
    for n in range(1, values.shape[0]):
        top = max(top, values[n])
    return top


@exact_device
def bend(v, j, num_knots):
    """Second difference of a curve v from knot j on; 0 beyond its ends."""
    if j < 0 or j + 2 >= num_knots:
        return 0.0
    return v[j] - 2 * v[j + 1] + v[j + 2]


@exact_device
def curve_at(k, num_steps, sums, least):
    """Value at knot k, of running sums of the steps' exponentials."""
    if k == 0:
        return 0.0
    if k >= num_steps:
        return 1.0
    share = sums[k - 1] / sums[num_steps - 1]
    return (1 - least) * share + least * k / num_steps


def tone(
    logits, known, unknown, learned, drift, white, residual, anchor_curve, anchor_ev,
    anchor_white, vignetting, least, camera, bracket, frame, anchored,
    values, gain, terms,
):  # fmt: skip
    """Fill the curves `values` (C, 3, K) and `gain` (3,), and add up `terms` (4,)."""
    sums = cuda.shared.array(MAX_KNOTS, float64)
    curve = cuda.shared.array(MAX_KNOTS, float64)
    means = cuda.shared.array(3, float64)
    totals = cuda.shared.array(4, float64)
    k, block = cuda.threadIdx.x, cuda.blockIdx.x
    curve_camera, channel = block // 3, block % 3
    num_steps, num_curves = logits.shape[2], logits.shape[0] * 3
    sums[k] = 0.0
    if k < 4:
        totals[k] = 0.0
    if k < 3:
        means[k] = 0.0
    cuda.syncthreads()
    top = largest(logits[curve_camera, channel])
    if k < num_steps:
        sums[k] = math.exp(logits[curve_camera, channel, k] - top)
    reach = 1
    while reach < MAX_KNOTS:
        cuda.syncthreads()
        before = sums[k - reach] if k >= reach else 0.0
        cuda.syncthreads()
        sums[k] += before
        reach *= 2
    cuda.syncthreads()
    curve[k] = curve_at(k, num_steps, sums, least)
    if k <= num_steps:
        values[curve_camera, channel, k] = curve[k]
    if block == 0:
        for i in range(k, residual.size, MAX_KNOTS):
            cuda.atomic.add(means, i % 3, residual[i // 3, i % 3] / residual.shape[0])
    cuda.syncthreads()
    if block == 0 and k < 3:
        gain[k] = math.exp(
            log_gain(
                k, known, unknown, learned, drift, white, residual, means, camera, bracket, frame
            )
        )
    b = bend(curve, k, num_steps + 1)
    cuda.atomic.add(totals, SMOOTHNESS, b * b / num_curves)
    if anchored != 0 and k <= num_steps:
        d = curve[k] - anchor_curve[curve_camera, channel, k]
        cuda.atomic.add(totals, ANCHOR, d * d / anchor_curve.size)
    if block == 0:
        add_small_terms(
            k, known, unknown, learned, white, residual, anchor_ev, anchor_white, vignetting,
            anchored, totals,
        )  # fmt: skip
    cuda.syncthreads()
    if k < 4:
        cuda.atomic.add(terms, k, totals[k])


@exact_device
def add_small_terms(
    k, known, unknown, learned, white, residual, anchor_ev, anchor_white, vignetting, anchored,
    totals,
):  # fmt: skip
    """Add what a thread takes of the terms that are no curves."""
    for i in range(k, residual.size, MAX_KNOTS):
        r = float(residual[i // 3, i % 3])
        cuda.atomic.add(totals, RESIDUAL, r * r / residual.size)
    for i in range(k, white.size, MAX_KNOTS):
        w = float(white[i // 3, i % 3])
        cuda.atomic.add(totals, RESIDUAL, w * w / white.size)
        if anchored != 0:
            d = w - anchor_white[i // 3, i % 3]
            cuda.atomic.add(totals, ANCHOR, d * d / white.size)
    for i in range(k, vignetting.size, MAX_KNOTS):
        v = float(vignetting[i // 3, i % 3])
        cuda.atomic.add(totals, VIGNETTING, v * v / vignetting.size)
    if anchored != 0:
        for b in range(k, known.shape[0], MAX_KNOTS):
            d = (ev_of(b, known, unknown, learned) - anchor_ev[b]) * LN2
            cuda.atomic.add(totals, ANCHOR, d * d / known.shape[0])


def tone_backward(
    logits, known, unknown, learned, drift, white, residual, anchor_curve, anchor_ev,
    anchor_white, vignetting, least, camera, bracket, frame, anchored,
    values, gain, d_values, d_gain, d_terms,
    g_logits, g_learned, g_white, g_residual, g_vignetting,
):  # fmt: skip
    """Fill the gradients of everything that is learned.

    `d_values` (3, K) is the gradient of the curve of `camera`. Without gradients of
    values and gain, or of the terms, the others count.
    """
    suffix = cuda.shared.array(MAX_KNOTS, float64)
    totals = cuda.shared.array(2, float64)  # of the softmax, and weighted by gradients
    k, block = cuda.threadIdx.x, cuda.blockIdx.x
    curve_camera, channel = block // 3, block % 3
    num_steps = logits.shape[2]
    curve = values[curve_camera, channel]
    d = 0.0
    if k > 0 and k < num_steps:
        if d_values.shape[0] > 0 and curve_camera == camera:
            d += d_values[channel, k]
        if d_terms.shape[0] > 0:
            bends = bend(curve, k, num_steps + 1) - 2 * bend(curve, k - 1, num_steps + 1)
            bends += bend(curve, k - 2, num_steps + 1)
            d += d_terms[SMOOTHNESS] * 2 * bends / (logits.shape[0] * 3)
            if anchored != 0:
                off = curve[k] - anchor_curve[curve_camera, channel, k]
                d += d_terms[ANCHOR] * 2 * off / anchor_curve.size
    suffix[k] = d
    if k < 2:
        totals[k] = 0.0
    reach = 1
    while reach < MAX_KNOTS:
        cuda.syncthreads()
        after = suffix[k + reach] if k + reach < MAX_KNOTS else 0.0
        cuda.syncthreads()
        suffix[k] += after
        reach *= 2
    cuda.syncthreads()
    top = largest(logits[curve_camera, channel])
    weight = d_share = 0.0
    if k < num_steps:
        weight = math.exp(logits[curve_camera, channel, k] - top)
        d_share = (1 - least) * suffix[k + 1] if k + 1 < MAX_KNOTS else 0.0
        cuda.atomic.add(totals, 0, weight)
        cuda.atomic.add(totals, 1, weight * d_share)
    cuda.syncthreads()
    if k < num_steps:
        share, mean = weight / totals[0], totals[1] / totals[0]
        g_logits[curve_camera, channel, k] = share * (d_share - mean)
    if block == 0:
        fill_small_gradients(
            k, known, unknown, learned, white, residual, anchor_ev, anchor_white, vignetting,
            camera, bracket, frame, anchored, gain, d_gain, d_terms,
            g_learned, g_white, g_residual, g_vignetting,
        )  # fmt: skip


@exact_device
def fill_small_gradients(
    k, known, unknown, learned, white, residual, anchor_ev, anchor_white, vignetting, camera,
    bracket, frame, anchored, gain, d_gain, d_terms, g_learned, g_white, g_residual, g_vignetting,
):  # fmt: skip
    """Fill the gradients of what is no curve that a thread takes."""
    with_gain, with_terms = d_gain.shape[0] > 0, d_terms.shape[0] > 0
    for u in range(k, unknown.shape[0], MAX_KNOTS):
        d = 0.0
        if with_gain and unknown[u] == bracket:
            d += LN2 * (d_gain[0] * gain[0] + d_gain[1] * gain[1] + d_gain[2] * gain[2])
        if with_terms and anchored != 0:
            off = learned[u] - anchor_ev[unknown[u]]
            d += d_terms[ANCHOR] * 2 * off * LN2 * LN2 / known.shape[0]
        g_learned[u] = d
    for i in range(k, white.size, MAX_KNOTS):
        r, c = i // 3, i % 3
        d = 0.0
        if with_gain and r == camera - 1:
            d += d_gain[c] * gain[c]
        if with_terms:
            d += d_terms[RESIDUAL] * 2 * white[r, c] / white.size
            if anchored != 0:
                d += d_terms[ANCHOR] * 2 * (white[r, c] - anchor_white[r, c]) / white.size
        g_white[r, c] = d
    for i in range(k, residual.size, MAX_KNOTS):
        r, c = i // 3, i % 3
        d = 0.0
        if with_gain and frame >= 0:
            of_frame = 1.0 if r == frame else 0.0
            d += d_gain[c] * gain[c] * (of_frame - 1 / residual.shape[0])
        if with_terms:
            d += d_terms[RESIDUAL] * 2 * residual[r, c] / residual.size
        g_residual[r, c] = d
    for i in range(k, vignetting.size, MAX_KNOTS):
        d = 0.0
        if with_terms:
            d = d_terms[VIGNETTING] * 2 * vignetting[i // 3, i % 3] / vignetting.size
        g_vignetting[i // 3, i % 3] = d
