"""Numba kernels of the Gaussian rasterizer on the CPU: projected Gaussians to pictures,
and back by hand.

Alpha compositing front to back as in 3D Gaussian splatting (Kerbl et al. 2023); as in
gsplat (Ye et al. 2024), alpha below 1/255 counts as 0 and above 0.999 as 0.999. Every
tile keeps a flat list of the Gaussians that touch it, front to back. The backward pass
goes front to back too, with one scalar per pixel: what is still to come behind. Each
(Gaussian, tile) pair owns its place for gradients, and a Gaussian's pairs are added up
in a fixed order: no atomics, and the same result whatever the number of threads. The
plain-torch twin is `rasterize.dense`.

Shapes: G Gaussians, P (Gaussian, tile) pairs, D feature channels (`BLOCK`, or more in
pairs), C <= D map channels, pictures of (H, W). A tile's working memory is a flat
float32 array of planes, each with one number for every pixel of the tile.

Loops over the pixels of a tile are written so that LLVM vectorizes them: one flat
array, unsigned ranges, no library call, no maximum carried along, no error for a
division by zero. `FAST` lets it reorder sums; NaN and Inf stay what they are. What a
pixel does to the first BLOCK of channels is written out in `add_to_block`, `dot_block`
and `gather_block`: a loop inside would not be vectorized over pixels.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from hdr_nsff.core.jit import jit
from hdr_nsff.fields.kernels.footprint import ALPHA_MIN, MOMENTS
from hdr_nsff.fields.kernels.projection import TILE_X, TILE_Y, ZERO

PIXELS = TILE_X * TILE_Y  # of a tile
BLOCK = 8  # channels that the first pass over a Gaussian's pixels takes; others take 2

# where a tile's planes begin in its working memory
X = np.uint64(0 * PIXELS)  # pixel centers, in pixels
Y = np.uint64(1 * PIXELS)
LEFT = np.uint64(2 * PIXELS)  # transmittance that is left
WEIGHT = np.uint64(3 * PIXELS)  # alpha * transmittance of the current Gaussian
VALUE = np.uint64(4 * PIXELS)  # its features' dot product with the maps' gradients
GRAD_ALPHA = np.uint64(5 * PIXELS)  # gradient of the alpha map
BEHIND = np.uint64(6 * PIXELS)  # weight * value of all Gaussians behind
SUMS = np.uint64(7 * PIXELS)  # from here on: channels of the maps, or their gradients
PLANES = 7  # before SUMS
# from a channel's plane to the planes of the next channels of its block
PLANE_1, PLANE_2, PLANE_3, PLANE_4, PLANE_5, PLANE_6, PLANE_7 = (
    np.uint64(i * PIXELS) for i in range(1, BLOCK)
)
TWO_ROWS = np.uint64(2 * TILE_X)  # as many pixels as a vector has lanes
CACHE_LINE = 16  # float32
CHECK_EVERY = 16  # Gaussians after which a tile is tested for being opaque

ONE = np.float32(1)
HALF = np.float32(0.5)
HALF_PIXEL = np.float32(0.51)  # from a row's edge to its center, and room for rounding
EIGHTH = np.float32(0.125)
ALPHA_MAX = np.float32(0.999)  # alpha above counts as this
MIN_TRANSMITTANCE = np.float32(1e-4)  # a tile with less is finished (Kerbl et al. 2023)
# exp(-s) is cut to 0 here: exp(-6) < 1/255, so alpha is below the cut for opacities <=
# 1
MAX_EXPONENT = np.float32(6.0)
# coefficients 1 / n! of the exponential's Taylor series
TAYLOR_2, TAYLOR_3, TAYLOR_4, TAYLOR_5 = (np.float32(1 / n) for n in (2, 6, 24, 120))
FAST = {"contract", "reassoc", "nsz"}
NO_GRADIENT = (ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)  # of a block of channels


@jit(inline="always", fastmath=FAST)
def exp_minus(s):
    """exp(-s) for s in [0, MAX_EXPONENT], to 1e-5.

    A polynomial of s / 8, squared three times: it vectorizes, unlike a library call.
    """
    x = -s * EIGHTH
    y = ONE + x * (ONE + x * (TAYLOR_2 + x * (TAYLOR_3 + x * (TAYLOR_4 + x * TAYLOR_5))))
    y = y * y
    y = y * y
    return y * y


@jit(inline="always", fastmath=FAST)
def full_alpha(o, a, b, c, dx, dy):
    """Opacity `o` times exp(-s) at an offset from the center of a conic (a, b, c)."""
    e0, e1 = a * dx, b * dx + c * dy
    s = min(e0 * e0 + e1 * e1, MAX_EXPONENT)
    return o * exp_minus(s)


@jit(inline="always", fastmath=FAST)
def cut_alpha(full):
    """The alpha that is drawn: 0 below ALPHA_MIN, and at most ALPHA_MAX."""
    q = min(full, ALPHA_MAX)
    return q if q >= ALPHA_MIN else ZERO


@jit(nogil=True)
def bin_tiles(boxes, order, tiles_x, tiles_y):
    """List the Gaussians that touch each tile, front to back.

    `boxes` (G, 4) are tile boxes of `projection.project`, `order` (G,) is front to
    back. Returns `starts` (tiles + 1,), where each tile's list begins; `members` (P,),
    the Gaussian of every list entry; `places` (P,), the entry's own place for
    gradients; and `owned` (G + 1,), where each Gaussian's places begin.
    """
    count = boxes.shape[0]
    owned = np.zeros(count + 1, np.int64)
    starts = np.zeros(tiles_x * tiles_y + 1, np.int64)
    for g in range(count):
        columns, rows = boxes[g, 2] - boxes[g, 0], boxes[g, 3] - boxes[g, 1]
        owned[g + 1] = owned[g] + columns * rows
        for ty in range(boxes[g, 1], boxes[g, 3]):
            for tx in range(boxes[g, 0], boxes[g, 2]):
                starts[ty * tiles_x + tx + 1] += 1
    for t in range(tiles_x * tiles_y):
        starts[t + 1] += starts[t]
    end = starts[:-1].copy()  # of each tile's list so far
    members = np.empty(owned[count], np.int32)
    places = np.empty(owned[count], np.int32)
    for g in order:
        place = owned[g]
        for ty in range(boxes[g, 1], boxes[g, 3]):
            for tx in range(boxes[g, 0], boxes[g, 2]):
                t = ty * tiles_x + tx
                members[end[t]] = g
                places[end[t]] = place
                end[t] += 1
                place += 1
    return starts, members, places, owned


@jit()
def tile_planes(count, tile, tiles_x):
    """A tile's first column and row, and its working memory of `count` planes.

    X, Y and LEFT are filled, the others are 0. One flat array that starts at a cache
    line, with constant distances between planes: LLVM then need not test before every
    loop whether two planes overlap.
    """
    room = np.zeros(count * PIXELS + CACHE_LINE, np.float32)
    first = (CACHE_LINE - room.ctypes.data // 4 % CACHE_LINE) % CACHE_LINE
    z = room[first : first + count * PIXELS]
    x0, y0 = (tile % tiles_x) * TILE_X, (tile // tiles_x) * TILE_Y
    for i in range(PIXELS):
        p = np.uint64(i)
        z[X + p] = np.float32(x0 + i % TILE_X) + HALF
        z[Y + p] = np.float32(y0 + i // TILE_X) + HALF
        z[LEFT + p] = ONE
    return x0, y0, z


@jit()
def half_chord(radius, x):
    """Half of a circle's chord at a distance x from its center, at most its radius."""
    return math.sqrt(max((radius - x) * (radius + x), ZERO))


@jit()
def pixel_span(outline, left, top):
    """First and last + 1 of a tile's flat pixels between which a Gaussian shows.

    The tile's columns cut a slice out of its `footprint.outline`, which ends at the
    ellipse's own lowest and highest points, or where it comes nearest to them. `left`
    and `top` are the tile's edges, from the Gaussian's center.

    The span goes in pairs of rows: in unsigned numbers, or LLVM would not vectorize
    over them, and in whole vectors that it can recognize, or it would add a loop for
    what is left over.
    """
    half_width, slope, ratio, lowest = outline
    left, right = left + HALF, left + TILE_X - HALF  # its first and last pixels' centers
    if left > half_width or right < -half_width:
        return np.uint64(0), np.uint64(0)
    low, high = min(max(lowest, left), right), min(max(-lowest, left), right)
    below = slope * low + ratio * half_chord(half_width, low) - top
    above = slope * high - ratio * half_chord(half_width, high) - top
    first = max(math.ceil(above - HALF_PIXEL), 0) // 2
    last = (min(math.floor(below + HALF_PIXEL), TILE_Y) + 1) // 2
    start = np.uint64(first) * TWO_ROWS
    return start, start + np.uint64(max(last - first, 0)) * TWO_ROWS


@jit(inline="always", fastmath=FAST)
def is_opaque(z):
    """Whether nothing behind can be seen in any pixel of a tile."""
    most = ZERO
    for p in range(PIXELS):
        most = max(most, z[LEFT + np.uint64(p)])
    return most < MIN_TRANSMITTANCE


@jit()
def load_block(features, g):
    """The first BLOCK features of Gaussian `g`, of `features` (G, D)."""
    first = features[g, 0], features[g, 1], features[g, 2], features[g, 3]
    return (*first, features[g, 4], features[g, 5], features[g, 6], features[g, 7])


@jit()
def row_of(table, g):
    """Row g of a table (G, 4)."""
    return table[g, 0], table[g, 1], table[g, 2], table[g, 3]


@jit(inline="always")
def channel_plane(d):
    """Where the plane of channel `d` begins."""
    return SUMS + np.uint64(d * PIXELS)


@jit(inline="always")
def add_to_block(z, p, v, f):
    """Add `v` times the features `f` to a block of planes at pixel `p`.

    `p` lies in the block's first plane.
    """
    z[p] += f[0] * v
    z[p + PLANE_1] += f[1] * v
    z[p + PLANE_2] += f[2] * v
    z[p + PLANE_3] += f[3] * v
    z[p + PLANE_4] += f[4] * v
    z[p + PLANE_5] += f[5] * v
    z[p + PLANE_6] += f[6] * v
    z[p + PLANE_7] += f[7] * v


@jit(inline="always")
def dot_block(z, p, f):
    """Sum of the features `f` times a block of planes at the pixel."""
    first = f[0] * z[p] + f[1] * z[p + PLANE_1] + f[2] * z[p + PLANE_2] + f[3] * z[p + PLANE_3]
    return (
        first
        + f[4] * z[p + PLANE_4]
        + f[5] * z[p + PLANE_5]
        + f[6] * z[p + PLANE_6]
        + f[7] * z[p + PLANE_7]
    )


@jit(inline="always")
def gather_block(t, z, p, v):
    """The sums `t` plus `v` times a block of planes at the pixel."""
    return (
        t[0] + z[p] * v,
        t[1] + z[p + PLANE_1] * v,
        t[2] + z[p + PLANE_2] * v,
        t[3] + z[p + PLANE_3] * v,
        t[4] + z[p + PLANE_4] * v,
        t[5] + z[p + PLANE_5] * v,
        t[6] + z[p + PLANE_6] * v,
        t[7] + z[p + PLANE_7] * v,
    )


@jit(inline="always")
def add_moments(m, u, dx, dy):
    """The moments `m` plus those of `u` at an offset from the center."""
    ux, uy = u * dx, u * dy
    return m[0] + u, m[1] + ux, m[2] + uy, m[3] + ux * dx, m[4] + ux * dy, m[5] + uy * dy


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def forward(starts, members, centers, conics, opacities, features, outlines, maps, alpha):
    """Composite Gaussians front to back into `maps` and `alpha`.

    `maps` (C, H, W) take the first C channels of `features` (G, D); `alpha` is (H, W).
    `starts` and `members` come from `bin_tiles`; pixel `centers` (G, 2), `conics` (G,
    3) and `outlines` (G, 4) from `projection.project`; `opacities` are (G,).
    """
    height, width = alpha.shape
    channels = features.shape[1]
    tiles_x = (width + TILE_X - 1) // TILE_X
    for tile in numba.prange(len(starts) - 1):
        x0, y0, z = tile_planes(PLANES + channels, tile, tiles_x)
        for i in range(starts[tile], starts[tile + 1]):
            g = members[i]
            o = opacities[g]
            cx, cy = centers[g, 0], centers[g, 1]
            a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
            first, last = pixel_span(row_of(outlines, g), x0 - cx, y0 - cy)
            f = load_block(features, g)
            for p in range(first, last):
                dx, dy = z[X + p] - cx, z[Y + p] - cy
                q = cut_alpha(full_alpha(o, a, b, c, dx, dy))
                v = q * z[LEFT + p]
                z[WEIGHT + p] = v
                z[LEFT + p] -= v
                add_to_block(z, SUMS + p, v, f)
            for d in range(BLOCK, channels, 2):
                plane, f0, f1 = channel_plane(d), features[g, d], features[g, d + 1]
                for p in range(first, last):
                    v = z[WEIGHT + p]
                    z[plane + p] += f0 * v
                    z[plane + PLANE_1 + p] += f1 * v
            if i % CHECK_EVERY == 0 and is_opaque(z):
                break
        for y in range(min(TILE_Y, height - y0)):
            for x in range(min(TILE_X, width - x0)):
                here = np.uint64(y * TILE_X + x)
                alpha[y0 + y, x0 + x] = ONE - z[LEFT + here]
                for d in range(len(maps)):
                    maps[d, y0 + y, x0 + x] = z[channel_plane(d) + here]


@jit(inline="always", fastmath=FAST)
def read_gradients(x0, y0, maps, alpha, grad_maps, grad_alpha, z):
    """Fill a tile's planes for the backward pass.

    These are the gradients of its maps (SUMS) and of alpha (GRAD_ALPHA), and the sum of
    weight * value over all Gaussians (BEHIND).
    """
    height, width = alpha.shape
    for y in range(min(TILE_Y, height - y0)):
        for x in range(min(TILE_X, width - x0)):
            p = np.uint64(y * TILE_X + x)
            z[GRAD_ALPHA + p] = grad_alpha[y0 + y, x0 + x]
            z[BEHIND + p] = z[GRAD_ALPHA + p] * alpha[y0 + y, x0 + x]
            for d in range(len(maps)):
                grad = grad_maps[d, y0 + y, x0 + x]
                z[channel_plane(d) + p] = grad
                z[BEHIND + p] += grad * maps[d, y0 + y, x0 + x]


@jit()
def store_block(grad, t):
    """Store gradients `t` of the first BLOCK channels in `grad` (MOMENTS + D,)."""
    grad[MOMENTS] = t[0]
    grad[MOMENTS + 1] = t[1]
    grad[MOMENTS + 2] = t[2]
    grad[MOMENTS + 3] = t[3]
    grad[MOMENTS + 4] = t[4]
    grad[MOMENTS + 5] = t[5]
    grad[MOMENTS + 6] = t[6]
    grad[MOMENTS + 7] = t[7]


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def backward(
    starts,
    members,
    places,
    centers,
    conics,
    opacities,
    features,
    outlines,
    maps,
    alpha,
    grad_maps,
    grad_alpha,
    out,
):
    """Fill `out` (P, MOMENTS + D), the gradients of every (Gaussian, tile) pair.

    They are moments of u = dL / ds over the pair's pixels, then its features. With
    alpha = opacity * exp(-s), weights w_i = alpha_i T_i, and v_i what one unit of
    weight of Gaussian i adds to the loss, dL / d alpha_i = T_i v_i - (sum of w_j v_j
    behind i) / (1 - alpha_i). Arguments are those of `forward`, its results, their
    gradients, and `places` of `bin_tiles`.
    """
    channels = features.shape[1]
    tiles_x = (alpha.shape[1] + TILE_X - 1) // TILE_X
    for tile in numba.prange(len(starts) - 1):
        x0, y0, z = tile_planes(PLANES + channels, tile, tiles_x)
        read_gradients(x0, y0, maps, alpha, grad_maps, grad_alpha, z)
        done = False
        for i in range(starts[tile], starts[tile + 1]):
            g, grad = members[i], out[places[i]]
            if done:
                grad[:] = ZERO
                continue
            o = opacities[g]
            cx, cy = centers[g, 0], centers[g, 1]
            a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
            first, last = pixel_span(row_of(outlines, g), x0 - cx, y0 - cy)
            if channels > BLOCK:
                for p in range(first, last):
                    z[VALUE + p] = ZERO
            for d in range(BLOCK, channels, 2):
                plane, f0, f1 = channel_plane(d), features[g, d], features[g, d + 1]
                for p in range(first, last):
                    z[VALUE + p] += f0 * z[plane + p] + f1 * z[plane + PLANE_1 + p]
            f = load_block(features, g)
            t, m = NO_GRADIENT, NO_GRADIENT[:MOMENTS]
            for p in range(first, last):
                value = z[GRAD_ALPHA + p] + z[VALUE + p] + dot_block(z, SUMS + p, f)
                dx, dy = z[X + p] - cx, z[Y + p] - cy
                full = full_alpha(o, a, b, c, dx, dy)
                q = cut_alpha(full)
                left = z[LEFT + p]
                v = q * left
                behind = z[BEHIND + p] - v * value
                slope = left * value - behind / (ONE - q)  # dL / d alpha
                u = -slope * (q if full <= ALPHA_MAX else ZERO)
                z[WEIGHT + p] = v
                z[BEHIND + p] = behind
                z[LEFT + p] = left - v
                m, t = add_moments(m, u, dx, dy), gather_block(t, z, SUMS + p, v)
            grad[0], grad[1], grad[2], grad[3], grad[4], grad[5] = m
            store_block(grad, t)
            for d in range(BLOCK, channels, 2):
                plane, t0, t1 = channel_plane(d), ZERO, ZERO
                for p in range(first, last):
                    v = z[WEIGHT + p]
                    t0 += z[plane + p] * v
                    t1 += z[plane + PLANE_1 + p] * v
                grad[MOMENTS + d], grad[MOMENTS + d + 1] = t0, t1
            if i % CHECK_EVERY == 0:
                done = is_opaque(z)
