"""The CUDA kernels of Adam, on vectors and on touched rows. numba-cuda's simulator
replaces the name `cuda` in this module.
"""

from __future__ import annotations

import math

from numba import cuda

from hdr_nsff.fields.kernels.cuda.device import exact_device
from hdr_nsff.fields.kernels.grid import CHANNELS


@exact_device
def move_number(i, p, g, exp_avg, exp_avg_sq, lr, eps, shared):
    """Move number i of a vector, if there is one."""
    if i >= p.shape[0]:
        return
    beta1, beta2, correction1, correction2 = shared
    m = beta1 * exp_avg[i] + (1 - beta1) * g[i]
    v = beta2 * exp_avg_sq[i] + (1 - beta2) * g[i] * g[i]
    exp_avg[i] = m
    exp_avg_sq[i] = v
    p[i] -= lr * (m / correction1) / (math.sqrt(v / correction2) + eps)


@exact_device
def move_row(r, table, grad, exp_avg, exp_avg_sq, touched, lr, eps, shared):
    """Move row r of a table if it has a mark or a gradient, and clear the mark."""
    if r >= table.shape[0]:
        return
    moves = touched[r] != 0
    for c in range(CHANNELS):
        moves = moves or grad[r, c] != 0
    if not moves:
        return
    touched[r] = 0
    beta1, beta2, correction1, correction2 = shared
    for c in range(CHANNELS):
        g = grad[r, c]
        m = beta1 * exp_avg[r, c] + (1 - beta1) * g
        v = beta2 * exp_avg_sq[r, c] + (1 - beta2) * g * g
        exp_avg[r, c] = m
        exp_avg_sq[r, c] = v
        table[r, c] -= lr * (m / correction1) / (math.sqrt(v / correction2) + eps)


def adam_rows(
    p0, g0, m0, v0, k0, lr0, eps0,
    p1, g1, m1, v1, k1, lr1, eps1,
    p2, g2, m2, v2, k2, lr2, eps2,
    p3, g3, m3, v3, k3, lr3, eps3,
    p4, g4, m4, v4, k4, lr4, eps4,
    p5, g5, m5, v5, k5, lr5, eps5,
    p6, g6, m6, v6, k6, lr6, eps6,
    p7, g7, m7, v7, k7, lr7, eps7,
    beta1, beta2, correction1, correction2,
):  # fmt: skip
    """`grid.adam_rows` of ADAM_TABLES tables p, a thread for a row of each of them.

    `g` are gradients, which are to be dropped, `m` and `v` moments, and `k` marks. Of a
    table that is missing, there are no rows.
    """
    r = cuda.grid(1)
    shared = beta1, beta2, correction1, correction2
    move_row(r, p0, g0, m0, v0, k0, lr0, eps0, shared)
    move_row(r, p1, g1, m1, v1, k1, lr1, eps1, shared)
    move_row(r, p2, g2, m2, v2, k2, lr2, eps2, shared)
    move_row(r, p3, g3, m3, v3, k3, lr3, eps3, shared)
    move_row(r, p4, g4, m4, v4, k4, lr4, eps4, shared)
    move_row(r, p5, g5, m5, v5, k5, lr5, eps5, shared)
    move_row(r, p6, g6, m6, v6, k6, lr6, eps6, shared)
    move_row(r, p7, g7, m7, v7, k7, lr7, eps7, shared)


def adam(
    p0, g0, m0, v0, lr0, eps0,
    p1, g1, m1, v1, lr1, eps1,
    p2, g2, m2, v2, lr2, eps2,
    p3, g3, m3, v3, lr3, eps3,
    p4, g4, m4, v4, lr4, eps4,
    p5, g5, m5, v5, lr5, eps5,
    p6, g6, m6, v6, lr6, eps6,
    p7, g7, m7, v7, lr7, eps7,
    p8, g8, m8, v8, lr8, eps8,
    p9, g9, m9, v9, lr9, eps9,
    p10, g10, m10, v10, lr10, eps10,
    p11, g11, m11, v11, lr11, eps11,
    p12, g12, m12, v12, lr12, eps12,
    p13, g13, m13, v13, lr13, eps13,
    p14, g14, m14, v14, lr14, eps14,
    p15, g15, m15, v15, lr15, eps15,
    beta1, beta2, correction1, correction2,
):  # fmt: skip
    """Adam (Kingma and Ba 2015) on ADAM_VECTORS vectors p, a thread for a number of
    each of them.

    `g` are gradients, `m` and `v` moments. A vector that is missing has no numbers.
    """
    i = cuda.grid(1)
    shared = beta1, beta2, correction1, correction2
    move_number(i, p0, g0, m0, v0, lr0, eps0, shared)
    move_number(i, p1, g1, m1, v1, lr1, eps1, shared)
    move_number(i, p2, g2, m2, v2, lr2, eps2, shared)
    move_number(i, p3, g3, m3, v3, lr3, eps3, shared)
    move_number(i, p4, g4, m4, v4, lr4, eps4, shared)
    move_number(i, p5, g5, m5, v5, lr5, eps5, shared)
    move_number(i, p6, g6, m6, v6, lr6, eps6, shared)
    move_number(i, p7, g7, m7, v7, lr7, eps7, shared)
    move_number(i, p8, g8, m8, v8, lr8, eps8, shared)
    move_number(i, p9, g9, m9, v9, lr9, eps9, shared)
    move_number(i, p10, g10, m10, v10, lr10, eps10, shared)
    move_number(i, p11, g11, m11, v11, lr11, eps11, shared)
    move_number(i, p12, g12, m12, v12, lr12, eps12, shared)
    move_number(i, p13, g13, m13, v13, lr13, eps13, shared)
    move_number(i, p14, g14, m14, v14, lr14, eps14, shared)
    move_number(i, p15, g15, m15, v15, lr15, eps15, shared)
