"""CUDA kernels that composite tiles of Gaussians, forward and backward, in Python for
numba-cuda.

They draw by the rules of the CPU's kernels and call the same functions for one alpha
(`compositing.py`). Tiles are 16 by 16 pixels, a block of threads draws one tile, and a
thread one pixel (Kerbl et al. 2023). Features come in chunks of CHANNELS; a second
dimension of the grid has one block per chunk, which composites on its own. Gradients
are linear in the features, so the chunks' moments simply add up.

The backward pass avoids reductions between the lanes of a warp. For BATCH Gaussians at
a time, every pixel leaves its weight and its gradient in shared memory. Then 16 threads
per Gaussian, one per column of the tile, sum over the rows; and one thread per number
sums over the columns and adds the result to the Gaussian's: one atomic addition per
Gaussian, number and tile.

Shapes: G Gaussians, P (Gaussian, tile) pairs sorted by tile and depth, C map channels,
D >= C channels of the features, a multiple of CHANNELS. The simulator of numba-cuda
replaces the name `cuda` in this module.
"""

from __future__ import annotations

from numba import cuda, float32, int32

from hdr_nsff.fields.kernels import compositing
from hdr_nsff.fields.kernels.compositing import HALF, MIN_TRANSMITTANCE, ONE
from hdr_nsff.fields.kernels.cuda.device import device, device_functions
from hdr_nsff.fields.kernels.cuda.layout import BATCH, CHANNELS, ELLIPSE, PIXELS, TILE
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
NOTHING = (ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)  # of CHANNELS channels
NO_MOMENTS = (ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)

COMPOSITING = device_functions(compositing, fastmath=True)
full_alpha, cut_alpha = COMPOSITING["full_alpha"], COMPOSITING["cut_alpha"]


@device
def pixel_of(tile, thread, width):
    """Column and row of a thread's pixel in the picture."""
    tiles_x = (width + TILE - 1) // TILE
    x = tile % tiles_x * TILE + thread % TILE
    y = tile // tiles_x * TILE + thread // TILE
    return x, y


@device
def add_weighted(t, v, colors, j):
    """`t` of CHANNELS sums plus `v` times row `j` of `colors`."""
    return (
        t[0] + v * colors[j, 0],
        t[1] + v * colors[j, 1],
        t[2] + v * colors[j, 2],
        t[3] + v * colors[j, 3],
        t[4] + v * colors[j, 4],
        t[5] + v * colors[j, 5],
        t[6] + v * colors[j, 6],
        t[7] + v * colors[j, 7],
    )


@device
def alpha_before_cut(shapes, j, px, py):
    """Alpha of the Gaussian in row `j` of `shapes` at a pixel center."""
    dx, dy = px - shapes[j, 0], py - shapes[j, 1]
    return full_alpha(shapes[j, 5], shapes[j, 2], shapes[j, 3], shapes[j, 4], dx, dy)


def forward(starts, owners, ellipses, values, maps, alpha):
    """Composite a tile's Gaussians front to back into `maps` (C, H, W) and `alpha`.

    A block per tile and chunk of the features. `starts` (tiles + 1,) are where the
    tiles' lists of `owners` (P,) begin; `values` are the features (G, D).
    """
    shapes = cuda.shared.array((PIXELS, ELLIPSE), float32)
    colors = cuda.shared.array((PIXELS, CHANNELS), float32)
    tile, chunk, thread = cuda.blockIdx.x, cuda.blockIdx.y, cuda.threadIdx.x
    height, width = alpha.shape
    x, y = pixel_of(tile, thread, width)
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
                alpha_j = cut_alpha(alpha_before_cut(shapes, j, px, py))
                if alpha_j > ZERO:
                    v = alpha_j * left
                    left -= v
                    t = add_weighted(t, v, colors, j)
        first += PIXELS
    if inside:
        for d in range(CHANNELS):
            if channel + d < maps.shape[0]:
                maps[channel + d, y, x] = t[d]
        if chunk == 0:
            alpha[y, x] = ONE - left


@device
def load_slopes(
    x, y, chunk, thread, maps, alpha, grad_features, grad_depth, grad_alpha, slopes
):  # fmt: skip
    """Fill this thread's column of `slopes` with the gradients of its pixel's maps.

    Returns the gradient of alpha, and the sum of weight * value over all Gaussians that
    the pixel shows, where a value is the gradient times the features.
    """
    height, width = alpha.shape
    inside = x < width and y < height
    channel, depth_channel = chunk * CHANNELS, grad_features.shape[0]
    d_alpha = behind = ZERO
    if inside and chunk == 0:
        d_alpha = grad_alpha[y, x]
        behind = d_alpha * alpha[y, x]
    for d in range(CHANNELS):
        slope = ZERO
        if inside and channel + d <= depth_channel:
            if channel + d < depth_channel:
                slope = grad_features[channel + d, y, x]
            else:
                slope = grad_depth[y, x]
            behind += slope * maps[channel + d, y, x]
        slopes[d, thread] = slope
    return d_alpha, behind


@device
def load_gaussian(first, count, thread, channel, owners, ellipses, values, members, batch):
    """Load one number of one of `count` Gaussians into the shared memory of `batch`."""
    shapes, colors = batch
    member, number = thread // NUMBERS, thread % NUMBERS
    if member < count:
        g = owners[first + member]
        if number == 0:
            members[member] = g
        if number < ELLIPSE:
            shapes[member, number] = ellipses[g, number]
        else:
            colors[member, number - ELLIPSE] = values[g, channel + number - ELLIPSE]


@device
def pixel_gradient(j, px, py, left, behind, d_alpha, thread, slopes, batch):
    """A Gaussian's weight v at a pixel, u = dL / ds, and `left` and `behind` after it.

    `left` is the transmittance in front of it; `behind` the sum of weight * value from
    it on. `batch` are the shared shapes and colors, and `j` is its row there.
    """
    shapes, colors = batch
    full = alpha_before_cut(shapes, j, px, py)
    alpha_j = cut_alpha(full)
    v = u = ZERO
    if alpha_j > ZERO:
        value = d_alpha
        for d in range(CHANNELS):
            value += slopes[d, thread] * colors[j, d]
        v = alpha_j * left
        behind -= v * value
        if full == alpha_j:  # where alpha is cut off, it has no slope
            u = -(left * value - behind / (ONE - alpha_j)) * alpha_j
        left -= v
    return v, u, left, behind


@device
def sum_column(row, column, dx, y0, weights, moments, slopes):
    """Sums over a tile's column for the Gaussian in `row` of the batch.

    Its center is `dx` left of the column and `y0` below the tile's first row of pixel
    centers. Returns its six moments, and the gradients of its features.
    """
    t = NOTHING
    u0 = u1 = u2 = ZERO  # sums of u, u dy and u dy^2
    for n in range(TILE):
        p = n * TILE + column
        v, u = weights[row * STRIDE + p], moments[row * STRIDE + p]
        dy = float32(n) - y0
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
    return (u0, u0 * dx, u1, u0 * dx * dx, u1 * dx, u2), t


@device
def add_columns(thread, count, channel, members, columns, sums):
    """Sum one number of a Gaussian over the tile's `columns`, and add it to `sums`."""
    member, number = thread // NUMBERS, thread % NUMBERS
    if member < count:
        total = ZERO
        for n in range(TILE):
            total += columns[thread * COLUMNS + n]
        if total != ZERO:
            at = number if number < MOMENTS else channel + number
            cuda.atomic.add(sums, (members[member], at), total)


def backward(
    starts, owners, ellipses, values, maps, alpha, grad_features, grad_depth, grad_alpha, sums
):  # fmt: skip
    """Add every Gaussian's gradients to `sums` (G, MOMENTS + D).

    They are moments of u = dL / ds over its pixels, then its features, as those of the
    pairs in `compositing.backward`. Arguments are those of `forward`, its results and
    the gradients of these; z-depth is the last map.
    """
    batch = (
        cuda.shared.array((BATCH, ELLIPSE), float32),
        cuda.shared.array((BATCH, CHANNELS), float32),
    )
    members = cuda.shared.array(BATCH, int32)
    slopes = cuda.shared.array((CHANNELS, PIXELS), float32)  # gradients of the maps
    weights = cuda.shared.array(SLOTS, float32)
    moments = cuda.shared.array(SLOTS, float32)  # u, and then sums of columns
    tile, chunk, thread = cuda.blockIdx.x, cuda.blockIdx.y, cuda.threadIdx.x
    column, row = thread % TILE, thread // TILE
    x, y = pixel_of(tile, thread, alpha.shape[1])
    px, py = float32(x) + HALF, float32(y) + HALF
    left = ONE if x < alpha.shape[1] and y < alpha.shape[0] else ZERO  # transmittance
    channel = chunk * CHANNELS
    d_alpha, behind = load_slopes(
        x, y, chunk, thread, maps, alpha, grad_features, grad_depth, grad_alpha, slopes
    )
    first, last = starts[tile], starts[tile + 1]
    while first < last:
        if not cuda.syncthreads_or(1 if left >= MIN_TRANSMITTANCE else 0):
            break
        count = min(BATCH, last - first)
        load_gaussian(first, count, thread, channel, owners, ellipses, values, members, batch)
        cuda.syncthreads()
        for j in range(count):
            v = u = ZERO
            if left >= MIN_TRANSMITTANCE:
                v, u, left, behind = pixel_gradient(
                    j, px, py, left, behind, d_alpha, thread, slopes, batch
                )
            weights[j * STRIDE + thread] = v
            moments[j * STRIDE + thread] = u
        cuda.syncthreads()
        # from here on, 16 threads per Gaussian `row`, one for each column
        m, t = NO_MOMENTS, NOTHING
        if row < count:
            dx, y0 = px - batch[0][row, 0], batch[0][row, 1] - (py - float32(row))
            m, t = sum_column(row, column, dx, y0, weights, moments, slopes)
        cuda.syncthreads()
        if row < count:
            at = row * NUMBERS * COLUMNS + column
            for n in range(MOMENTS):
                moments[at + n * COLUMNS] = m[n]
            for d in range(CHANNELS):
                moments[at + (MOMENTS + d) * COLUMNS] = t[d]
        cuda.syncthreads()
        add_columns(thread, count, channel, members, moments, sums)
        first += BATCH
