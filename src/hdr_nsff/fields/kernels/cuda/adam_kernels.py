"""The CUDA kernel of Adam on touched rows. numba-cuda's simulator replaces the name
`cuda` in this module.
"""

from __future__ import annotations

import math

from numba import cuda

from hdr_nsff.fields.kernels.grid import CHANNELS


def adam_rows(
    table, grad, exp_avg, exp_avg_sq, touched, lr, beta1, beta2, eps, correction1, correction2
):  # fmt: skip
    """`grid.adam_rows` with a thread per row: on rows with a mark or a gradient.

    Marks are cleared; gradients are to be dropped.
    """
    r = cuda.grid(1)
    if r >= table.shape[0]:
        return
    moves = touched[r] != 0
    for c in range(CHANNELS):
        moves = moves or grad[r, c] != 0
    if not moves:
        return
    touched[r] = 0
    for c in range(CHANNELS):
        g = grad[r, c]
        m = beta1 * exp_avg[r, c] + (1 - beta1) * g
        v = beta2 * exp_avg_sq[r, c] + (1 - beta2) * g * g
        exp_avg[r, c] = m
        exp_avg_sq[r, c] = v
        table[r, c] -= lr * (m / correction1) / (math.sqrt(v / correction2) + eps)
