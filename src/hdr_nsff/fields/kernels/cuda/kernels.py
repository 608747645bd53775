"""CUDA kernels of the Gaussian rasterizer, written in Python for numba-cuda.

They draw by the rules of the CPU's kernels and call the same functions for everything
about one Gaussian (`footprint.py`) and one alpha (`compositing.py`). Tiles are 16 by 16
pixels, a block of threads draws one tile, and a thread one pixel (Kerbl et al. 2023).
Features come in chunks of CHANNELS; a second dimension of the grid has one block per
chunk, which composites on its own. Gradients are linear in the features, so the chunks'
moments simply add up.

The backward pass avoids reductions between the lanes of a warp. For BATCH Gaussians at
a time, every pixel leaves its weight and its gradient in shared memory. Then 16 threads
per Gaussian, one per column of the tile, sum over the rows; and one thread per number
sums over the columns and adds the result to the Gaussian's: one atomic addition per
Gaussian, number and tile.

Shapes: G Gaussians, P (Gaussian, tile) pairs sorted by tile and depth, C map channels,
D >= C channels of the features, a multiple of CHANNELS. The simulator of numba-cuda
replaces the name `cuda` in this module. Nothing imports this module unless kernels are
compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from numba import cuda, float32, int32
from numba.core import config
from numba.core.dispatcher import Dispatcher

from hdr_nsff.fields.kernels import compositing, footprint
from hdr_nsff.fields.kernels.compositing import HALF, MIN_TRANSMITTANCE, ONE
from hdr_nsff.fields.kernels.cuda.layout import BATCH, CHANNELS, PIXELS, TILE
from hdr_nsff.fields.kernels.footprint import MOMENTS
from hdr_nsff.fields.kernels.projection import ZERO

NUMBERS = MOMENTS + CHANNELS  # that the backward pass sums for a pair and a chunk
# floats from one Gaussian's pixels to the next one's in shared memory: half a warp
# reads one Gaussian and half the next, each of them half of the 32 banks
STRIDE = PIXELS + TILE
# floats from one number's columns to the next one's: odd, so that threads which read
# columns of different numbers use different banks
COLUMNS = TILE + 1
SLOTS = BATCH * STRIDE
ELLIPSE = 6  # numbers of a projected Gaussian: pixel center, conic, opacity
NOTHING = (ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)  # of CHANNELS channels


def device_functions(module: ModuleType, fastmath: bool) -> dict[str, Callable[..., Any]]:
    """The functions of a module that numba compiles for the CPU, as device functions.

    With `fastmath`, the compiler assumes that no number is NaN. The simulator calls the
    CPU's compiled functions.
    """
    compiled: dict[str, Any] = {k: v for k, v in vars(module).items() if isinstance(v, Dispatcher)}
    if config.ENABLE_CUDASIM:
        return compiled
    names = dict(vars(module))
    for name, function in compiled.items():
        again = FunctionType(function.py_func.__code__, names, name)
        names[name] = cuda.jit(device=True, fastmath=fastmath)(again)
    return {name: names[name] for name in compiled}


FOOTPRINT = device_functions(footprint, fastmath=False)
footprint_of, ellipse_of = FOOTPRINT["footprint"], FOOTPRINT["ellipse"]
world_gradients = FOOTPRINT["world_gradients"]
COMPOSITING = device_functions(compositing, fastmath=True)
full_alpha, cut_alpha = COMPOSITING["full_alpha"], COMPOSITING["cut_alpha"]


def project(
    means, quaternions, scales, opacities, camera, width, height, ellipses, depths, boxes, counts
):  # fmt: skip
    """Project world Gaussians, one thread each, as `projection.project` does.

    `camera` (16,) float64 is the world-to-camera matrix row by row, then fx, fy, cx,
    cy. Fills `ellipses` (G, ELLIPSE), z-`depths` (G,), tile `boxes` (G, 4: x0, y0, x1,
    y1; ends excluded) and `counts` (G,), the number of tiles; 0 where nothing shows.
    """
    g = cuda.grid(1)
    if g >= means.shape[0]:
        return
    m = (float(means[g, 0]), float(means[g, 1]), float(means[g, 2]))
    q = (
        float(quaternions[g, 0]),
        float(quaternions[g, 1]),
        float(quaternions[g, 2]),
        float(quaternions[g, 3]),
    )
    s = (float(scales[g, 0]), float(scales[g, 1]), float(scales[g, 2]))
    view = (
        (camera[0], camera[1], camera[2], camera[3]),
        (camera[4], camera[5], camera[6], camera[7]),
        (camera[8], camera[9], camera[10], camera[11]),
    )
    k = (camera[12], camera[13], camera[14], camera[15])
    t, _, _, _, _, covariance = footprint_of(m, q, s, view, k, width, height)
    shows, center, conic, bounds = ellipse_of(t, covariance, float(opacities[g]), k, width, height)
    depths[g] = t[2]
    ellipses[g, 0], ellipses[g, 1] = center[0], center[1]
    ellipses[g, 2], ellipses[g, 3], ellipses[g, 4] = conic[0], conic[1], conic[2]
    ellipses[g, 5] = opacities[g]
    x0 = y0 = x1 = y1 = 0
    if shows:
        tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
        x0, y0 = int(bounds[0]) // TILE, int(bounds[1]) // TILE
        x1 = min(int(bounds[2]) // TILE + 1, tiles_x)
        y1 = min(int(bounds[3]) // TILE + 1, tiles_y)
    boxes[g, 0], boxes[g, 1], boxes[g, 2], boxes[g, 3] = x0, y0, x1, y1
    counts[g] = (x1 - x0) * (y1 - y0)


def list_pairs(boxes, ends, depth_bits, tiles_x, keys, owners):
    """List every Gaussian's tiles, one thread per Gaussian.

    `ends` (G,) are the running sums of `counts`, `depth_bits` (G,) the bits of the
    depths, which sort like these where they are positive. Fills `keys` (P,), tile in
    the upper and depth in the lower half, and `owners` (P,), the Gaussians.
    """
    g = cuda.grid(1)
    if g >= boxes.shape[0]:
        return
    x0, y0, x1, y1 = boxes[g, 0], boxes[g, 1], boxes[g, 2], boxes[g, 3]
    i = ends[g] - (x1 - x0) * (y1 - y0)
    depth = np.int64(depth_bits[g])
    for y in range(y0, y1):
        for x in range(x0, x1):
            keys[i] = (np.int64(y * tiles_x + x) << 32) | depth
            owners[i] = g
            i += 1


def forward(starts, owners, ellipses, values, maps, alpha):
    """Composite a tile's Gaussians front to back into `maps` (C, H, W) and `alpha`.

    A block per tile and chunk of the features. `starts` (tiles + 1,) are where the
    tiles' lists of `owners` (P,) begin; `values` are the features (G, D).
    """
    shapes = cuda.shared.array((PIXELS, ELLIPSE), float32)
    colors = cuda.shared.array((PIXELS, CHANNELS), float32)
    tile, chunk, thread = cuda.blockIdx.x, cuda.blockIdx.y, cuda.threadIdx.x
    height, width = alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    x = tile % tiles_x * TILE + thread % TILE
    y = tile // tiles_x * TILE + thread // TILE
    inside = x < width and y < height
    px, py = float32(x) + HALF, float32(y) + HALF
    left = ONE if inside else ZERO  # transmittance
    channel = chunk * CHANNELS
    t = NOTHING
    first, last = starts[tile], starts[tile + 1]
    while first < last:
        if not cuda.syncthreads_or(1 if left >= MIN_TRANSMITTANCE else 0):
            break
        if first + thread < last:
            g = owners[first + thread]
            for n in range(ELLIPSE):
                shapes[thread, n] = ellipses[g, n]
            for d in range(CHANNELS):
                colors[thread, d] = values[g, channel + d]
        cuda.syncthreads()
        for j in range(min(PIXELS, last - first)):
            if left >= MIN_TRANSMITTANCE:
                dx, dy = px - shapes[j, 0], py - shapes[j, 1]
                alpha_j = cut_alpha(
                    full_alpha(shapes[j, 5], shapes[j, 2], shapes[j, 3], shapes[j, 4], dx, dy)
                )
                if alpha_j > ZERO:
                    v = alpha_j * left
                    left -= v
                    t = (
                        t[0] + v * colors[j, 0],
                        t[1] + v * colors[j, 1],
                        t[2] + v * colors[j, 2],
                        t[3] + v * colors[j, 3],
                        t[4] + v * colors[j, 4],
                        t[5] + v * colors[j, 5],
                        t[6] + v * colors[j, 6],
                        t[7] + v * colors[j, 7],
                    )
        first += PIXELS
    if inside:
        for d in range(CHANNELS):
            if channel + d < maps.shape[0]:
                maps[channel + d, y, x] = t[d]
        if chunk == 0:
            alpha[y, x] = ONE - left


def backward(starts, owners, ellipses, values, maps, alpha, grad_maps, grad_alpha, sums):
    """Add every Gaussian's gradients to `sums` (G, MOMENTS + D).

    They are moments of u = dL / ds over its pixels, then its features, as those of the
    pairs in `compositing.backward`. Arguments are those of `forward`, its results and
    their gradients.
    """
    shapes = cuda.shared.array((BATCH, ELLIPSE), float32)
    colors = cuda.shared.array((BATCH, CHANNELS), float32)
    members = cuda.shared.array(BATCH, int32)
    slopes = cuda.shared.array((CHANNELS, PIXELS), float32)  # gradients of the maps
    weights = cuda.shared.array(SLOTS, float32)
    moments = cuda.shared.array(SLOTS, float32)  # u, and then sums of columns
    tile, chunk, thread = cuda.blockIdx.x, cuda.blockIdx.y, cuda.threadIdx.x
    height, width = alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    left_edge, top_edge = tile % tiles_x * TILE, tile // tiles_x * TILE
    column, row = thread % TILE, thread // TILE
    x, y = left_edge + column, top_edge + row
    inside = x < width and y < height
    px, py = float32(x) + HALF, float32(y) + HALF
    left = ONE if inside else ZERO  # transmittance
    channel = chunk * CHANNELS
    d_alpha = behind = ZERO  # gradient of alpha, weight * value of all Gaussians behind
    if inside and chunk == 0:
        d_alpha = grad_alpha[y, x]
        behind = d_alpha * alpha[y, x]
    for d in range(CHANNELS):
        slope = ZERO
        if inside and channel + d < maps.shape[0]:
            slope = grad_maps[channel + d, y, x]
            behind += slope * maps[channel + d, y, x]
        slopes[d, thread] = slope
    first, last = starts[tile], starts[tile + 1]
    while first < last:
        if not cuda.syncthreads_or(1 if left >= MIN_TRANSMITTANCE else 0):
            break
        count = min(BATCH, last - first)
        member, number = thread // NUMBERS, thread % NUMBERS
        if member < count:
            g = owners[first + member]
            if number == 0:
                members[member] = g
            if number < ELLIPSE:
                shapes[member, number] = ellipses[g, number]
            else:
                colors[member, number - ELLIPSE] = values[g, channel + number - ELLIPSE]
        cuda.syncthreads()
        for j in range(count):
            v = u = ZERO
            if left >= MIN_TRANSMITTANCE:
                dx, dy = px - shapes[j, 0], py - shapes[j, 1]
                full = full_alpha(shapes[j, 5], shapes[j, 2], shapes[j, 3], shapes[j, 4], dx, dy)
                alpha_j = cut_alpha(full)
                if alpha_j > ZERO:
                    value = d_alpha
                    for d in range(CHANNELS):
                        value += slopes[d, thread] * colors[j, d]
                    v = alpha_j * left
                    behind -= v * value
                    if full == alpha_j:  # where alpha is cut off, it has no slope
                        u = -(left * value - behind / (ONE - alpha_j)) * alpha_j
                    left -= v
            weights[j * STRIDE + thread] = v
            moments[j * STRIDE + thread] = u
        cuda.syncthreads()
        # from here on, 16 threads per Gaussian `row`, one for each column
        t = NOTHING
        u0 = u1 = u2 = dx = ZERO  # sums of u, u dy and u dy^2 over the column
        if row < count:
            dx = px - shapes[row, 0]
            for n in range(TILE):
                p = n * TILE + column
                v, u = weights[row * STRIDE + p], moments[row * STRIDE + p]
                dy = float32(top_edge + n) + HALF - shapes[row, 1]
                u0 += u
                u1 += u * dy
                u2 += u * dy * dy
                t = (
                    t[0] + v * slopes[0, p],
                    t[1] + v * slopes[1, p],
                    t[2] + v * slopes[2, p],
                    t[3] + v * slopes[3, p],
                    t[4] + v * slopes[4, p],
                    t[5] + v * slopes[5, p],
                    t[6] + v * slopes[6, p],
                    t[7] + v * slopes[7, p],
                )
        cuda.syncthreads()
        if row < count:
            at = row * NUMBERS * COLUMNS + column
            moments[at] = u0
            moments[at + COLUMNS] = u0 * dx
            moments[at + 2 * COLUMNS] = u1
            moments[at + 3 * COLUMNS] = u0 * dx * dx
            moments[at + 4 * COLUMNS] = u1 * dx
            moments[at + 5 * COLUMNS] = u2
            for d in range(CHANNELS):
                moments[at + (MOMENTS + d) * COLUMNS] = t[d]
        cuda.syncthreads()
        if member < count:
            total = ZERO
            for n in range(TILE):
                total += moments[thread * COLUMNS + n]
            if total != ZERO:
                at = number if number < MOMENTS else channel + number
                cuda.atomic.add(sums, (members[member], at), total)
        first += BATCH


def project_backward(
    means, quaternions, scales, opacities, camera, width, height, counts, sums, depth_channel,
    grad_means, grad_quaternions, grad_scales, grad_opacities, grad_view,
):  # fmt: skip
    """Carry `sums` of `backward` back to the world, one thread per Gaussian.

    Arguments as in `project`; `depth_channel` is the feature that is the z-depth. Fills
    the `grad_...`, shaped like what they belong to. `grad_view` is (G, 12), or (0, 12)
    if it is not wanted.
    """
    g = cuda.grid(1)
    if g >= means.shape[0]:
        return
    if counts[g] == 0:
        for n in range(3):
            grad_means[g, n] = ZERO
            grad_scales[g, n] = ZERO
        for n in range(4):
            grad_quaternions[g, n] = ZERO
        grad_opacities[g] = ZERO
        if grad_view.shape[0] > 0:
            for n in range(12):
                grad_view[g, n] = ZERO
        return
    m = (float(means[g, 0]), float(means[g, 1]), float(means[g, 2]))
    q = (
        float(quaternions[g, 0]),
        float(quaternions[g, 1]),
        float(quaternions[g, 2]),
        float(quaternions[g, 3]),
    )
    s = (float(scales[g, 0]), float(scales[g, 1]), float(scales[g, 2]))
    view = (
        (camera[0], camera[1], camera[2], camera[3]),
        (camera[4], camera[5], camera[6], camera[7]),
        (camera[8], camera[9], camera[10], camera[11]),
    )
    k = (camera[12], camera[13], camera[14], camera[15])
    u = (
        float(sums[g, 0]),
        float(sums[g, 1]),
        float(sums[g, 2]),
        float(sums[g, 3]),
        float(sums[g, 4]),
        float(sums[g, 5]),
    )
    grad_opacities[g] = -sums[g, 0] / opacities[g]  # dL / do = dL / dalpha * alpha / o
    d_depth = float(sums[g, MOMENTS + depth_channel])
    d_mean, d_quaternion, d_scales, d_view = world_gradients(
        m, q, s, view, k, width, height, u, d_depth
    )
    for n in range(3):
        grad_means[g, n] = d_mean[n]
        grad_scales[g, n] = d_scales[n]
    for n in range(4):
        grad_quaternions[g, n] = d_quaternion[n]
    if grad_view.shape[0] > 0:
        for n in range(4):
            grad_view[g, n] = d_view[0][n]
            grad_view[g, 4 + n] = d_view[1][n]
            grad_view[g, 8 + n] = d_view[2][n]
