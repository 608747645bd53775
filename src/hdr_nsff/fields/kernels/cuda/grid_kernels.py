"""CUDA kernels of multiresolution grids: interpolation and its gradients.

They are those of `kernels/grid.py`, whose functions they call, with a thread per point.
Arguments that all kernels share: `coords` (N, 3) in [0, 1], clamped; `levels` (L, 6)
int64, which are grid points along x, y, z, first row, rows, and whether they are
hashed; `slices` (L, 2) int64 time slices and `slice_weights` (L, 2). Tables are (rows,
CHANNELS). The simulator of numba-cuda replaces the name `cuda` in this module.
"""

from __future__ import annotations

from numba import cuda, float32

from hdr_nsff.fields.kernels import grid
from hdr_nsff.fields.kernels.cuda.device import device_functions, exact_device
from hdr_nsff.fields.kernels.grid import CHANNELS, ONE, ZERO

GRID = device_functions(grid, fastmath=False)
cell_of, row_of = GRID["cell_of"], GRID["row_of"]
CORNERS = 8  # of a cell
SLICES = 2  # of time that a point reads


@exact_device
def cell_at(i, level, coords, levels):
    """Lower grid point of a point's cell, and where in the cell the point lies."""
    x, fx = cell_of(coords[i, 0], levels[level, 0])
    y, fy = cell_of(coords[i, 1], levels[level, 1])
    z, fz = cell_of(coords[i, 2], levels[level, 2])
    return x, y, z, fx, fy, fz


@exact_device
def corner_of(corner, cell, s, level, levels):
    """Table row of a corner of a cell, and its weights along x, y and z."""
    x, y, z, fx, fy, fz = cell
    dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
    nx, ny, nz = levels[level, 0], levels[level, 1], levels[level, 2]
    row = row_of(
        x + dx, y + dy, z + dz, s, nx, ny, nz, levels[level, 5] != 0, levels[level, 4]
    )  # fmt: skip
    wx = fx if dx else ONE - fx
    wy = fy if dy else ONE - fy
    wz = fz if dz else ONE - fz
    return levels[level, 3] + row, wx, wy, wz


def interpolate(coords, table, levels, slices, slice_weights, out):
    """Fill `out` (N, CHANNELS), the sum over levels of the interpolated values."""
    i = cuda.grid(1)
    if i >= coords.shape[0]:
        return
    a = b = c = d = ZERO
    for level in range(levels.shape[0]):
        cell = cell_at(i, level, coords, levels)
        for k in range(SLICES):
            ws = slice_weights[level, k]
            if ws != ZERO:
                for corner in range(CORNERS):
                    r, wx, wy, wz = corner_of(corner, cell, slices[level, k], level, levels)
                    w = ws * wz * wy * wx
                    a += w * table[r, 0]
                    b += w * table[r, 1]
                    c += w * table[r, 2]
                    d += w * table[r, 3]
    out[i, 0], out[i, 1], out[i, 2], out[i, 3] = a, b, c, d


def table_backward(coords, grad_out, levels, slices, slice_weights, grad_table, touched):
    """Add the table's gradient to `grad_table` (rows, CHANNELS), and mark its rows in
    `touched` (rows,). The grid of blocks has a second dimension: levels.
    """
    i, level = cuda.grid(1), cuda.blockIdx.y
    if i >= coords.shape[0]:
        return
    cell = cell_at(i, level, coords, levels)
    for k in range(SLICES):
        ws = slice_weights[level, k]
        if ws != ZERO:
            for corner in range(CORNERS):
                r, wx, wy, wz = corner_of(corner, cell, slices[level, k], level, levels)
                w = ws * wz * wy * wx
                touched[r] = 1
                for c in range(CHANNELS):
                    cuda.atomic.add(grad_table, (r, c), w * grad_out[i, c])


def coords_backward(coords, table, grad_out, levels, slices, slice_weights, grad_coords):
    """Fill `grad_coords` (N, 3); 0 where a coordinate is clamped."""
    i = cuda.grid(1)
    if i >= coords.shape[0]:
        return
    gx = gy = gz = ZERO
    for level in range(levels.shape[0]):
        cell = cell_at(i, level, coords, levels)
        lx = ly = lz = ZERO  # slopes, of a cell whose sides are 1
        for k in range(SLICES):
            ws = slice_weights[level, k]
            if ws != ZERO:
                for corner in range(CORNERS):
                    r, wx, wy, wz = corner_of(corner, cell, slices[level, k], level, levels)
                    dot = ZERO
                    for c in range(CHANNELS):
                        dot += table[r, c] * grad_out[i, c]
                    dot *= ws
                    lx += (dot if corner & 1 else -dot) * wy * wz
                    ly += (dot if corner & 2 else -dot) * wx * wz
                    lz += (dot if corner & 4 else -dot) * wx * wy
        gx += lx * float32(levels[level, 0] - 1)
        gy += ly * float32(levels[level, 1] - 1)
        gz += lz * float32(levels[level, 2] - 1)
    grad_coords[i, 0] = gx if ZERO < coords[i, 0] < ONE else ZERO
    grad_coords[i, 1] = gy if ZERO < coords[i, 1] < ONE else ZERO
    grad_coords[i, 2] = gz if ZERO < coords[i, 2] < ONE else ZERO
