"""Numba kernels of the Gaussian rasterizer on the CPU: projected Gaussians to pictures,
and back by hand.

Every tile keeps a flat list of those that touch it, front to back. Alpha below 1/255
counts as nothing, above 0.999 as 0.999 (Kerbl et al. 2023). The backward pass goes
front to back too, with one scalar per pixel: what is still to come behind. Each
(Gaussian, tile) pair owns its place for gradients and a Gaussian's pairs are added up
in a fixed order: no atomics, and the same result whatever the number of threads. The
plain-torch twin is `rasterize.dense`.

Loops over the pixels of a tile are written so that LLVM vectorizes them: one flat
array, unsigned ranges, no library call, no maximum carried along, no error for a
division by zero. `FAST` lets it reorder sums; NaN and Inf stay what they are. What a
pixel's BLOCK of channels does stands in `mixed`, `poured` and `gathered`, written out,
for a loop inside would not be vectorized over pixels.
"""

from __future__ import annotations

import numba
import numpy as np

from hdr_nsff.core.jit import jit
from hdr_nsff.fields.kernels.projection import ALPHA_MIN, F0, MOMENTS, TILE_X, TILE_Y

PIXELS = TILE_X * TILE_Y
BLOCK = 8  # channels that one pass over a Gaussian's pixels takes; features come in multiples of it
X, Y, LEFT, WEIGHT, VALUE, GRAD_ALPHA, BEHIND, SUMS = (
    np.uint64(i * PIXELS) for i in range(8)
)  # a tile's planes of pixels
N1, N2, N3, N4, N5, N6, N7 = (np.uint64(i * PIXELS) for i in range(1, BLOCK))
OWN = 7  # planes before SUMS
TWO_ROWS = np.uint64(2 * TILE_X)  # as wide as a vector
LINE = 16  # float32 in a cache line
F1, HALF = np.float32(1), np.float32(0.5)
ALPHA_MAX = np.float32(0.999)
SPENT = np.float32(1e-4)  # transmittance below which a tile is finished
DEEPEST = np.float32(6.0)  # exponents beyond this are below the cut for every opacity <= 1
EIGHTH = np.float32(0.125)
E2, E3, E4, E5 = (np.float32(1 / n) for n in (2, 6, 24, 120))
FAST = {"contract", "reassoc", "nsz"}
NOTHING = (F0, F0, F0, F0, F0, F0, F0, F0)


@jit(inline="always", fastmath=FAST)
def exp_minus(s):
    """exp(-s) for s in [0, DEEPEST], to 1e-5: a polynomial of s / 8, squared three
    times; vectorizes, unlike a library call.
    """
    x = -s * EIGHTH
    y = F1 + x * (F1 + x * (E2 + x * (E3 + x * (E4 + x * E5))))
    y = y * y
    y = y * y
    return y * y


@jit(nogil=True)
def bin_tiles(boxes, order, tiles_x, tiles_y):
    """Lists of Gaussians per tile, front to back as `order` (G,) says.

    Returns `starts` (tiles + 1,), `members` (P,) the Gaussian of every list entry,
    `places` (P,) the entry's own place for gradients, and `owned` (G + 1,) where each
    Gaussian's places begin.
    """
    count = boxes.shape[0]
    owned = np.zeros(count + 1, np.int64)
    starts = np.zeros(tiles_x * tiles_y + 1, np.int64)
    for g in range(count):
        owned[g + 1] = owned[g] + (boxes[g, 2] - boxes[g, 0]) * (boxes[g, 3] - boxes[g, 1])
        for ty in range(boxes[g, 1], boxes[g, 3]):
            for tx in range(boxes[g, 0], boxes[g, 2]):
                starts[ty * tiles_x + tx + 1] += 1
    for t in range(tiles_x * tiles_y):
        starts[t + 1] += starts[t]
    at = starts[:-1].copy()
    members, places = np.empty(owned[count], np.int32), np.empty(owned[count], np.int32)
    for g in order:
        place = owned[g]
        for ty in range(boxes[g, 1], boxes[g, 3]):
            for tx in range(boxes[g, 0], boxes[g, 2]):
                t = ty * tiles_x + tx
                members[at[t]], places[at[t]] = g, place
                at[t] += 1
                place += 1
    return starts, members, places, owned


@jit()
def planes(count, tile, tiles_x):
    """A tile's first column and row, and `count` planes of PIXELS numbers in one flat
    array at the start of a cache line: X, Y and LEFT are filled, the others 0. One
    array with constant distances, for then LLVM need not ask before every loop whether
    two planes overlap.
    """
    room = np.zeros(count * PIXELS + LINE, np.float32)
    first = (LINE - room.ctypes.data // 4 % LINE) % LINE
    z = room[first : first + count * PIXELS]
    x0, y0 = (tile % tiles_x) * TILE_X, (tile // tiles_x) * TILE_Y
    for i in range(PIXELS):
        p = np.uint64(i)
        z[X + p], z[Y + p], z[LEFT + p] = (
            np.float32(x0 + i % TILE_X) + HALF,
            np.float32(y0 + i // TILE_X) + HALF,
            F1,
        )
    return x0, y0, z


@jit()
def span(rows, g, y0):
    """The flat pixels of a tile that a Gaussian's rows cover, in pairs of rows:
    unsigned, or LLVM would not vectorize over them, and in a way that it sees whole
    vectors, or it would look for what is left over.
    """
    first, last = max(rows[g, 0] - y0, 0) // 2, (min(rows[g, 1] - y0, TILE_Y) + 1) // 2
    start = np.uint64(first) * TWO_ROWS
    return start, start + np.uint64(max(last - first, 0)) * TWO_ROWS


@jit(inline="always", fastmath=FAST)
def spent(z):
    """Whether nothing behind can be seen any more."""
    most = F0
    for p in range(PIXELS):
        most = max(most, z[LEFT + np.uint64(p)])
    return most < SPENT


@jit()
def block(features, g, d):
    """BLOCK features of Gaussian `g` from channel `d` on."""
    first = features[g, d], features[g, d + 1], features[g, d + 2], features[g, d + 3]
    return (*first, features[g, d + 4], features[g, d + 5], features[g, d + 6], features[g, d + 7])


@jit(inline="always")
def plane(d):
    """Where the plane of channel `d` begins."""
    return SUMS + np.uint64(d * PIXELS)


@jit(inline="always")
def poured(z, p, v, f):
    """Add `v` times the features `f` to the BLOCK planes from the one on in which `p`
    is the pixel.
    """
    z[p] += f[0] * v
    z[p + N1] += f[1] * v
    z[p + N2] += f[2] * v
    z[p + N3] += f[3] * v
    z[p + N4] += f[4] * v
    z[p + N5] += f[5] * v
    z[p + N6] += f[6] * v
    z[p + N7] += f[7] * v


@jit(inline="always")
def mixed(z, p, f):
    """Sum of the features `f` times those planes at the pixel."""
    first = f[0] * z[p] + f[1] * z[p + N1] + f[2] * z[p + N2] + f[3] * z[p + N3]
    return first + f[4] * z[p + N4] + f[5] * z[p + N5] + f[6] * z[p + N6] + f[7] * z[p + N7]


@jit(inline="always")
def gathered(t, z, p, v):
    """The sums `t` plus `v` times those planes at the pixel."""
    first = t[0] + z[p] * v, t[1] + z[p + N1] * v, t[2] + z[p + N2] * v, t[3] + z[p + N3] * v
    return (
        *first,
        t[4] + z[p + N4] * v,
        t[5] + z[p + N5] * v,
        t[6] + z[p + N6] * v,
        t[7] + z[p + N7] * v,
    )


@jit(inline="always")
def moved(m, u, dx, dy):
    """The moments `m` plus those of `u` at an offset from the center."""
    ux, uy = u * dx, u * dy
    return m[0] + u, m[1] + ux, m[2] + uy, m[3] + ux * dx, m[4] + ux * dy, m[5] + uy * dy


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def forward(starts, members, centers, conics, opacities, features, rows, maps, alpha):
    """Composite features (G, D), D a multiple of BLOCK, into `maps` (C, H, W), the
    first C of them, and `alpha` (H, W).
    """
    height, width = alpha.shape
    channels = features.shape[1]
    tiles_x = (width + TILE_X - 1) // TILE_X
    for tile in numba.prange(len(starts) - 1):
        x0, y0, z = planes(OWN + channels, tile, tiles_x)
        for i in range(starts[tile], starts[tile + 1]):
            g = members[i]
            cx, cy, o = centers[g, 0], centers[g, 1], opacities[g]
            a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
            first, last = span(rows, g, y0)
            f = block(features, g, 0)
            for p in range(first, last):
                dx, dy = z[X + p] - cx, z[Y + p] - cy
                e0, e1 = a * dx, b * dx + c * dy
                s = min(e0 * e0 + e1 * e1, DEEPEST)
                q = min(o * exp_minus(s), ALPHA_MAX)
                q = q if q >= ALPHA_MIN else F0
                v = q * z[LEFT + p]
                z[WEIGHT + p] = v
                z[LEFT + p] -= v
                poured(z, SUMS + p, v, f)
            for d in range(BLOCK, channels, BLOCK):
                at, f = plane(d), block(features, g, d)
                for p in range(first, last):
                    poured(z, at + p, z[WEIGHT + p], f)
            if i % 16 == 0 and spent(z):
                break
        for y in range(min(TILE_Y, height - y0)):
            for x in range(min(TILE_X, width - x0)):
                here = np.uint64(y * TILE_X + x)
                alpha[y0 + y, x0 + x] = F1 - z[LEFT + here]
                for d in range(len(maps)):
                    maps[d, y0 + y, x0 + x] = z[plane(d) + here]


@jit(inline="always", fastmath=FAST)
def read_gradients(x0, y0, maps, alpha, grad_maps, grad_alpha, z):
    """Fill a tile's planes: gradients of its maps (SUMS), of alpha (GRAD_ALPHA), and
    the sum of weight * value (BEHIND).
    """
    height, width = alpha.shape
    for y in range(min(TILE_Y, height - y0)):
        for x in range(min(TILE_X, width - x0)):
            p = np.uint64(y * TILE_X + x)
            z[GRAD_ALPHA + p] = grad_alpha[y0 + y, x0 + x]
            z[BEHIND + p] = z[GRAD_ALPHA + p] * alpha[y0 + y, x0 + x]
            for d in range(len(maps)):
                grad = grad_maps[d, y0 + y, x0 + x]
                z[plane(d) + p] = grad
                z[BEHIND + p] += grad * maps[d, y0 + y, x0 + x]


@jit()
def tell(grad, d, t):
    """Write down the gradients `t` of the BLOCK channels from `d` on."""
    d += MOMENTS
    (
        grad[d],
        grad[d + 1],
        grad[d + 2],
        grad[d + 3],
        grad[d + 4],
        grad[d + 5],
        grad[d + 6],
        grad[d + 7],
    ) = t


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def backward(
    starts,
    members,
    places,
    centers,
    conics,
    opacities,
    features,
    rows,
    maps,
    alpha,
    grad_maps,
    grad_alpha,
    out,
):
    """Gradients `out` (P, MOMENTS + D) of every pair: moments of u = dL / ds over its
    pixels, then its features.
    """
    channels = features.shape[1]
    tiles_x = (alpha.shape[1] + TILE_X - 1) // TILE_X
    for tile in numba.prange(len(starts) - 1):
        x0, y0, z = planes(OWN + channels, tile, tiles_x)
        read_gradients(x0, y0, maps, alpha, grad_maps, grad_alpha, z)
        done = False
        for i in range(starts[tile], starts[tile + 1]):
            g, grad = members[i], out[places[i]]
            if done:
                grad[:] = F0
                continue
            cx, cy, o = centers[g, 0], centers[g, 1], opacities[g]
            a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
            first, last = span(rows, g, y0)
            if channels > BLOCK:
                for p in range(first, last):
                    z[VALUE + p] = F0
            for d in range(BLOCK, channels, BLOCK):
                at, f = plane(d), block(features, g, d)
                for p in range(first, last):
                    z[VALUE + p] += mixed(z, at + p, f)
            f, t, m = block(features, g, 0), NOTHING, NOTHING[:MOMENTS]
            for p in range(first, last):
                value = z[GRAD_ALPHA + p] + z[VALUE + p] + mixed(z, SUMS + p, f)
                dx, dy = z[X + p] - cx, z[Y + p] - cy
                e0, e1 = a * dx, b * dx + c * dy
                s = min(e0 * e0 + e1 * e1, DEEPEST)
                full = o * exp_minus(s)
                q = min(full, ALPHA_MAX)
                q = q if q >= ALPHA_MIN else F0
                left = z[LEFT + p]
                v = q * left
                behind = z[BEHIND + p] - v * value
                slope = left * value - behind / (F1 - q)  # dL / d alpha
                u = -slope * (q if full <= ALPHA_MAX else F0)
                z[WEIGHT + p], z[BEHIND + p], z[LEFT + p] = v, behind, left - v
                m, t = moved(m, u, dx, dy), gathered(t, z, SUMS + p, v)
            grad[0], grad[1], grad[2], grad[3], grad[4], grad[5] = m
            tell(grad, 0, t)
            for d in range(BLOCK, channels, BLOCK):
                at, t = plane(d), NOTHING
                for p in range(first, last):
                    t = gathered(t, z, at + p, z[WEIGHT + p])
                tell(grad, d, t)
            if i % 16 == 0:
                done = spent(z)
