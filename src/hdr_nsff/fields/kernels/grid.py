"""Numba kernels for multiresolution grids on the CPU: interpolation, its gradients, and
an Adam step on touched rows.

One flat table holds all levels (L). A dense level stores grid point (x, y, z) of time
slice s in row `offset[l] + ((s * Z + z) * Y + y) * X + x`; a hashed one in the row that
a spatial hash of the four gives, modulo `size[l]`, a power of two (Teschner et al.
2003; Müller et al. 2022). Interpolation is trilinear in space and reads up to two time
slices with given weights; a static grid is the case of one slice.

Arguments that all kernels share: `coords` (N, 3) in [0, 1], clamped; `res` (L, 3) int32
grid points along x, y, z; `offset` and `size` (L,) int64 rows; `hashed` (L,) bool;
`slices` (L, 2) int32 time slices and `slice_weights` (L, 2) float32. Tables are (rows,
CHANNELS) float32. The plain-torch twin is `encodings.AdditiveGrid.reference`; a test
compares them.

No `fastmath`: with it, freshly compiled code and code from numba's cache differed in
the last bit, and it was no faster.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from hdr_nsff.core.jit import jit

# the usual spatial hash (Teschner et al. 2003) for x, y, z; the fourth prime is for
# time
PRIMES = (1, 2654435761, 805459861, 3674653429)
PRIME_Y, PRIME_Z, PRIME_TIME = (np.uint32(p) for p in PRIMES[1:])
ZERO, ONE = np.float32(0), np.float32(1)
# of every table: one constant lets LLVM unroll, and one compilation serves all grids
CHANNELS = 4


@jit(inline="always")
def cell_of(u: Any, resolution: Any) -> Any:
    """Lower grid point and fraction in [0, 1] of a coordinate, clamped to [0, 1].

    NaN has the first cell, and the fraction NaN: as an integer it may be any row.
    """
    position = min(max(u, ZERO), ONE) * np.float32(resolution - 1)
    low = np.int32(0)
    if position > ZERO:
        low = min(np.int32(position), np.int32(resolution - 2))
    return low, position - np.float32(low)


@jit(inline="always")
def row_of(
    x: Any, y: Any, z: Any, s: Any, nx: Any, ny: Any, nz: Any, hashed: Any, size: Any
) -> Any:
    """Row of grid point (x, y, z) of slice s within its level of (nx, ny, nz)."""
    if hashed:
        h = np.uint32(x) ^ (np.uint32(y) * PRIME_Y) ^ (np.uint32(z) * PRIME_Z)
        h ^= np.uint32(s) * PRIME_TIME
        return np.int64(h & np.uint32(size - 1))
    return np.int64(((s * nz + z) * ny + y) * nx + x)


@jit(parallel=True, nogil=True)
def forward(coords, table, res, offset, size, hashed, slices, slice_weights, out):
    """Fill `out` (N, CHANNELS), the sum over levels of the interpolated values."""
    for i in numba.prange(coords.shape[0]):
        for c in range(CHANNELS):
            out[i, c] = ZERO
        for level in range(res.shape[0]):
            nx, ny, nz = res[level, 0], res[level, 1], res[level, 2]
            x, fx = cell_of(coords[i, 0], nx)
            y, fy = cell_of(coords[i, 1], ny)
            z, fz = cell_of(coords[i, 2], nz)
            for k in range(2):
                s, ws = slices[level, k], slice_weights[level, k]
                if ws == ZERO:
                    continue
                for dz in range(2):
                    wz = ws * (fz if dz else ONE - fz)
                    for dy in range(2):
                        wy = wz * (fy if dy else ONE - fy)
                        for dx in range(2):
                            w = wy * (fx if dx else ONE - fx)
                            r = offset[level] + row_of(
                                x + dx, y + dy, z + dz, s, nx, ny, nz, hashed[level], size[level]
                            )
                            for c in range(CHANNELS):
                                out[i, c] += w * table[r, c]


@jit(parallel=True, nogil=True)
def backward_table(
    coords, grad_out, res, offset, size, hashed, slices, slice_weights, grad_table, touched
):
    """Add the table's gradient to `grad_table` and mark the rows it touches.

    `grad_out` is (N, CHANNELS), `grad_table` (rows, CHANNELS), `touched` (rows,) uint8.
    """
    # a level's rows belong to one thread: no race, and the same sum every time
    for level in numba.prange(res.shape[0]):
        nx, ny, nz = res[level, 0], res[level, 1], res[level, 2]
        for i in range(coords.shape[0]):
            x, fx = cell_of(coords[i, 0], nx)
            y, fy = cell_of(coords[i, 1], ny)
            z, fz = cell_of(coords[i, 2], nz)
            for k in range(2):
                s, ws = slices[level, k], slice_weights[level, k]
                if ws == ZERO:
                    continue
                for dz in range(2):
                    wz = ws * (fz if dz else ONE - fz)
                    for dy in range(2):
                        wy = wz * (fy if dy else ONE - fy)
                        for dx in range(2):
                            w = wy * (fx if dx else ONE - fx)
                            r = offset[level] + row_of(
                                x + dx, y + dy, z + dz, s, nx, ny, nz, hashed[level], size[level]
                            )
                            touched[r] = 1
                            for c in range(CHANNELS):
                                grad_table[r, c] += w * grad_out[i, c]


@jit(parallel=True, nogil=True)
def backward_coords(
    coords, table, grad_out, res, offset, size, hashed, slices, slice_weights, grad_coords
):
    """Fill `grad_coords` (N, 3), given `grad_out` (N, CHANNELS).

    The gradient is 0 where a coordinate is clamped.
    """
    for i in numba.prange(coords.shape[0]):
        gx = gy = gz = ZERO
        for level in range(res.shape[0]):
            nx, ny, nz = res[level, 0], res[level, 1], res[level, 2]
            x, fx = cell_of(coords[i, 0], nx)
            y, fy = cell_of(coords[i, 1], ny)
            z, fz = cell_of(coords[i, 2], nz)
            for k in range(2):
                s, ws = slices[level, k], slice_weights[level, k]
                if ws == ZERO:
                    continue
                for dz in range(2):
                    wz = fz if dz else ONE - fz
                    for dy in range(2):
                        wy = fy if dy else ONE - fy
                        for dx in range(2):
                            wx = fx if dx else ONE - fx
                            r = offset[level] + row_of(
                                x + dx, y + dy, z + dz, s, nx, ny, nz, hashed[level], size[level]
                            )
                            dot = ZERO
                            for c in range(CHANNELS):
                                dot += table[r, c] * grad_out[i, c]
                            dot *= ws
                            # a corner's weight wx wy wz grows with the coordinate on
                            # the upper side of the cell and falls on the lower side
                            gx += (dot if dx else -dot) * wy * wz * np.float32(nx - 1)
                            gy += (dot if dy else -dot) * wx * wz * np.float32(ny - 1)
                            gz += (dot if dz else -dot) * wx * wy * np.float32(nz - 1)
        grad_coords[i, 0] = gx if ZERO < coords[i, 0] < ONE else ZERO
        grad_coords[i, 1] = gy if ZERO < coords[i, 1] < ONE else ZERO
        grad_coords[i, 2] = gz if ZERO < coords[i, 2] < ONE else ZERO


@jit(parallel=True, nogil=True)
def adam_rows(
    table, grad, exp_avg, exp_avg_sq, touched, lr, beta1, beta2, eps, correction1, correction2
):
    """One Adam step (Kingma and Ba 2015) on the rows marked in `touched`.

    Other rows and their moments stay; gradients and marks are cleared. `table`, `grad`
    and both moments are (rows, CHANNELS); `correction1` and `correction2` are the bias
    corrections `1 - beta^t`.
    """
    for r in numba.prange(table.shape[0]):
        if touched[r] == 0:
            continue
        touched[r] = 0
        for c in range(CHANNELS):
            g = grad[r, c]
            m = beta1 * exp_avg[r, c] + (1 - beta1) * g
            v = beta2 * exp_avg_sq[r, c] + (1 - beta2) * g * g
            exp_avg[r, c] = m
            exp_avg_sq[r, c] = v
            table[r, c] -= lr * (m / correction1) / (np.sqrt(v / correction2) + eps)
            grad[r, c] = ZERO
