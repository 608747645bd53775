"""Numba kernels for multiresolution grids on the CPU: interpolation, its gradients and
a touched-only Adam step.

One flat table holds all levels; row `offset[l] + ((s * Z + z) * Y + y) * X + x` of a
dense level (x, y, z grid point, s time slice), or a hash of the four into `size[l]` (a
power of two) rows of a hashed one. A level is read at up to two time slices with given
weights; a static grid is the case of one slice. The plain-torch twin is in
`encodings.py`; a test compares them.

No `fastmath`: with it, code fresh from the compiler and code from its cache differed in
the last bit, and it was no faster.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from hdr_nsff.core.jit import jit

PRIMES = (
    1,
    2654435761,
    805459861,
    3674653429,
)  # the usual spatial hash (Teschner et al. 2003), the fourth for time
P1, P2, P3 = (np.uint32(p) for p in PRIMES[1:])
F0, F1 = np.float32(0), np.float32(1)
# channels of every table: one constant lets LLVM unroll, and one compilation serves all
# grids
C = 4


@jit(inline="always")
def cell_of(u: Any, resolution: Any) -> Any:
    """Lower grid point and fraction of a coordinate in [0, 1]; outside values clamp to
    the edge.
    """
    position = min(max(u, F0), F1) * np.float32(resolution - 1)
    low = min(np.int32(position), np.int32(resolution - 2))
    return low, position - np.float32(low)


@jit(inline="always")
def row_of(
    x: Any, y: Any, z: Any, s: Any, nx: Any, ny: Any, nz: Any, hashed: Any, size: Any
) -> Any:
    """Row of a grid point within its level."""
    if hashed:
        h = np.uint32(x) ^ (np.uint32(y) * P1) ^ (np.uint32(z) * P2) ^ (np.uint32(s) * P3)
        return np.int64(h & np.uint32(size - 1))
    return np.int64(((s * nz + z) * ny + y) * nx + x)


@jit(parallel=True, nogil=True)
def forward(coords, table, res, offset, size, hashed, slices, slice_weights, out):
    """Values (N, C) at coords (N, 3)."""
    for i in numba.prange(coords.shape[0]):
        for c in range(C):
            out[i, c] = F0
        for level in range(res.shape[0]):
            nx, ny, nz = res[level, 0], res[level, 1], res[level, 2]
            x, fx = cell_of(coords[i, 0], nx)
            y, fy = cell_of(coords[i, 1], ny)
            z, fz = cell_of(coords[i, 2], nz)
            for k in range(2):
                ws = slice_weights[level, k]
                if ws == F0:
                    continue
                for dz in range(2):
                    wz = ws * (fz if dz else F1 - fz)
                    for dy in range(2):
                        wy = wz * (fy if dy else F1 - fy)
                        for dx in range(2):
                            w = wy * (fx if dx else F1 - fx)
                            r = offset[level] + row_of(
                                x + dx,
                                y + dy,
                                z + dz,
                                slices[level, k],
                                nx,
                                ny,
                                nz,
                                hashed[level],
                                size[level],
                            )
                            for c in range(C):
                                out[i, c] += w * table[r, c]


@jit(parallel=True, nogil=True)
def backward_table(
    coords, grad_out, res, offset, size, hashed, slices, slice_weights, grad_table, touched
):
    """Add to grad_table what grad_out (N, C) says and mark the rows it touches."""
    for level in numba.prange(
        res.shape[0]
    ):  # a level's rows belong to one thread: no race, and the same sum every time
        nx, ny, nz = res[level, 0], res[level, 1], res[level, 2]
        for i in range(coords.shape[0]):
            x, fx = cell_of(coords[i, 0], nx)
            y, fy = cell_of(coords[i, 1], ny)
            z, fz = cell_of(coords[i, 2], nz)
            for k in range(2):
                ws = slice_weights[level, k]
                if ws == F0:
                    continue
                for dz in range(2):
                    wz = ws * (fz if dz else F1 - fz)
                    for dy in range(2):
                        wy = wz * (fy if dy else F1 - fy)
                        for dx in range(2):
                            w = wy * (fx if dx else F1 - fx)
                            r = offset[level] + row_of(
                                x + dx,
                                y + dy,
                                z + dz,
                                slices[level, k],
                                nx,
                                ny,
                                nz,
                                hashed[level],
                                size[level],
                            )
                            touched[r] = 1
                            for c in range(C):
                                grad_table[r, c] += w * grad_out[i, c]


@jit(parallel=True, nogil=True)
def backward_coords(
    coords, table, grad_out, res, offset, size, hashed, slices, slice_weights, grad_coords
):
    """Gradient (N, 3) to the coordinates."""
    for i in numba.prange(coords.shape[0]):
        gx = gy = gz = F0
        for level in range(res.shape[0]):
            nx, ny, nz = res[level, 0], res[level, 1], res[level, 2]
            x, fx = cell_of(coords[i, 0], nx)
            y, fy = cell_of(coords[i, 1], ny)
            z, fz = cell_of(coords[i, 2], nz)
            for k in range(2):
                ws = slice_weights[level, k]
                if ws == F0:
                    continue
                for dz in range(2):
                    wz = fz if dz else F1 - fz
                    for dy in range(2):
                        wy = fy if dy else F1 - fy
                        for dx in range(2):
                            wx = fx if dx else F1 - fx
                            r = offset[level] + row_of(
                                x + dx,
                                y + dy,
                                z + dz,
                                slices[level, k],
                                nx,
                                ny,
                                nz,
                                hashed[level],
                                size[level],
                            )
                            dot = F0
                            for c in range(C):
                                dot += table[r, c] * grad_out[i, c]
                            dot *= ws
                            gx += (dot if dx else -dot) * wy * wz * np.float32(nx - 1)
                            gy += (dot if dy else -dot) * wx * wz * np.float32(ny - 1)
                            gz += (dot if dz else -dot) * wx * wy * np.float32(nz - 1)
        grad_coords[i, 0] = gx if F0 < coords[i, 0] < F1 else F0  # clamped coordinates do not move
        grad_coords[i, 1] = gy if F0 < coords[i, 1] < F1 else F0
        grad_coords[i, 2] = gz if F0 < coords[i, 2] < F1 else F0


@jit(parallel=True, nogil=True)
def adam_rows(p, g, m, v, touched, lr, beta1, beta2, eps, correction1, correction2):
    """One Adam step on the marked rows of (rows, C) arrays; their gradients and marks
    are cleared. Other rows, moments included, stay.
    """
    for r in numba.prange(p.shape[0]):
        if touched[r] == 0:
            continue
        touched[r] = 0
        for c in range(C):
            d = g[r, c]
            a = beta1 * m[r, c] + (1 - beta1) * d
            b = beta2 * v[r, c] + (1 - beta2) * d * d
            m[r, c] = a
            v[r, c] = b
            p[r, c] -= lr * (a / correction1) / (np.sqrt(b / correction2) + eps)
            g[r, c] = F0
