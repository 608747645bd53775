"""Numba kernels of the recording on the CPU: gain, response curve and the ends of eq.
11 in one pass over the pixels, and back.

A value's bin comes without a power. Floats in [0, 1] that share their upper 16 bits
make a cell; a table says in which bin a cell begins, and since no cell holds two knots,
the bin is that one or the next. Pixels are taken in a fixed number of chunks that add
up what they say of curve and gain each for itself: the same sums whatever the number of
threads. The plain-torch twin is in `tonemap.py`; a test compares them. At a knot, where
the slope jumps, either neighbor's is right and the twins may differ.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.core.jit import jit

CHUNKS = 16
CELLS = 0x3F80 + 1  # upper halves of the floats from 0 to 1
F0, F1 = np.float32(0), np.float32(1)
NEXT, HALF_BITS, NO_SIGN = np.uint32(1), np.uint32(16), np.uint32(0x7FFF)


def bin_table(knots: Tensor) -> Tensor:
    """Bin (CELLS,) int16 in which each cell of [0, 1] begins, for rising float32 knots
    (K,) from 0 to 1.
    """
    starts = (torch.arange(CELLS, dtype=torch.int32, device=knots.device) << 16).view(torch.float32)
    bins = (torch.searchsorted(knots, starts) - 1).clamp(0, len(knots) - 2)
    assert int(bins.diff().max()) <= 1, (
        "two knots in one cell: the curve has too many for this table"
    )
    return bins.to(torch.int16)


@jit(inline="always")
def bin_of(x, knots, table):
    """Bin with knots[bin] < x <= knots[bin + 1], the first one for 0; x in [0, 1]."""
    cell = (np.float32(x).view(np.uint32) >> HALF_BITS) & NO_SIGN  # -0 is 0
    low = np.uint32(table[cell])
    return low + np.uint32(x > knots[low + NEXT])


@jit(parallel=True, nogil=True)
def forward(radiance, gain, values, knots, inverse, table, leaky, leak, out):
    """Fill `out` (3, N) with the recording of `radiance` (3, N).

    Radiance passes `gain` (3,) and a curve `values` (3, K) at `knots` (K,). `inverse`
    (K - 1,) is 1 / width of the bins, `table` that of `bin_table`. Beyond [0, 1] the
    result is clamped, or follows eq. 11 if `leaky`.
    """
    n, top = radiance.shape[1], F1 + leak
    for k in numba.prange(CHUNKS):
        for c in range(3):
            curve, factor = values[c], gain[c]
            channel, recorded = radiance[c], out[c]
            for i in range(k * n // CHUNKS, (k + 1) * n // CHUNKS):
                x = channel[i] * factor
                if F0 <= x <= F1:
                    b = bin_of(x, knots, table)
                    share = (x - knots[b]) * inverse[b]
                    recorded[i] = curve[b] + (curve[b + NEXT] - curve[b]) * share
                elif x > F1:
                    recorded[i] = top - leak / np.sqrt(x) if leaky else curve[-1]
                elif x < F0:
                    recorded[i] = leak * x if leaky else curve[0]
                else:
                    recorded[i] = x  # NaN


@jit(parallel=True, nogil=True)
def backward(
    radiance,
    gain,
    values,
    knots,
    inverse,
    table,
    leaky,
    leak,
    grad_out,
    grad_radiance,
    grad_gain,
    grad_values,
):
    """Fill `grad_radiance` (3, N) and `grad_gain` (CHUNKS, 3) and add to `grad_values`
    (CHUNKS, 3, K): sums over the chunks are to be taken.
    """
    n, half = radiance.shape[1], leak / np.float32(2)
    for k in numba.prange(CHUNKS):
        for c in range(3):
            curve, factor, said = values[c], gain[c], grad_values[k, c]
            total = 0.0
            for i in range(k * n // CHUNKS, (k + 1) * n // CHUNKS):
                x, g, slope = radiance[c, i] * factor, grad_out[c, i], F0
                if F0 <= x <= F1:
                    b = bin_of(x, knots, table)
                    right = g * ((x - knots[b]) * inverse[b])
                    said[b] += g - right
                    said[b + NEXT] += right
                    slope = (curve[b + NEXT] - curve[b]) * inverse[b]
                elif leaky:
                    slope = half / (x * np.sqrt(x)) if x > F1 else leak
                elif x > F1:
                    said[-1] += g
                elif x < F0:
                    said[0] += g
                if x != x:  # NaN has no bin and no slope, but the curve shall not hide it
                    said[0] += x
                    slope = F0
                grad_radiance[c, i] = g * slope * factor
                total += g * slope * radiance[c, i]
            grad_gain[k, c] = total


class Respond(torch.autograd.Function):
    """Recorded rgb (N, 3) of `radiance` (N, 3) through `gain` (3,) and a curve (3, K)
    at `knots` (K,), all float32 on the CPU.

    Ends as in eq. 11 with `leak`, clamped where that is None. `table` is
    `bin_table(knots)`. The kernels work channel by channel, so radiance that lies in
    memory like that is not copied, and the recording lies like that, too.
    """

    @staticmethod
    def forward(
        ctx: Any,
        radiance: Tensor,
        gain: Tensor,
        values: Tensor,
        knots: Tensor,
        table: Tensor,
        leak: float | None,
    ) -> Tensor:
        saved = (
            radiance.T.contiguous(),
            gain.contiguous(),
            values.contiguous(),
            knots,
            1 / knots.diff(),
            table,
        )
        ctx.save_for_backward(*saved)
        ctx.ends = leak is not None, np.float32(leak or 0)
        out = torch.empty_like(saved[0])
        forward(*(t.detach().numpy() for t in saved), *ctx.ends, out.numpy())
        return out.T

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> Any:
        saved = ctx.saved_tensors
        grad_radiance = torch.empty_like(saved[0])
        grad_gain = torch.empty(CHUNKS, 3, dtype=torch.float64)
        grad_values = torch.zeros(CHUNKS, *saved[2].shape, dtype=torch.float64)
        grads = grad_radiance, grad_gain, grad_values
        backward(
            *(t.detach().numpy() for t in saved),
            *ctx.ends,
            grad_out.T.contiguous().numpy(),
            *(t.numpy() for t in grads),
        )
        return (
            grad_radiance.T,
            grad_gain.sum(0).float(),
            grad_values.sum(0).float(),
            None,
            None,
            None,
        )
