"""Numba kernels of the Gaussian rasterizer on the CPU: world Gaussians to projected
ones and the tiles that they touch, and all of it backwards by hand.

The mathematics of one Gaussian stands in `footprint.py`, and `compositing.py` draws
what comes out. Shapes: G Gaussians, P (Gaussian, tile) pairs, D feature channels.
"""

from __future__ import annotations

import numba
import numpy as np

from hdr_nsff.core.jit import jit
from hdr_nsff.fields.kernels.footprint import (
    FAST,
    MOMENTS,
    ellipse,
    footprint,
    outline,
    world_gradients,
)

TILE_X, TILE_Y = 8, 32  # pixels
ZERO = np.float32(0)


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def gaussian(means, quaternions, scales, g):
    """Mean (3,), quaternion (4,) and scales (3,) of Gaussian `g` in float64."""
    mean = (float(means[g, 0]), float(means[g, 1]), float(means[g, 2]))
    w, x = float(quaternions[g, 0]), float(quaternions[g, 1])
    y, z = float(quaternions[g, 2]), float(quaternions[g, 3])
    scale = (float(scales[g, 0]), float(scales[g, 1]), float(scales[g, 2]))
    return mean, (w, x, y, z), scale


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def view_rows(w2c):
    """The three rows of a world-to-camera matrix (3, 4) as tuples."""
    return (
        (w2c[0, 0], w2c[0, 1], w2c[0, 2], w2c[0, 3]),
        (w2c[1, 0], w2c[1, 1], w2c[1, 2], w2c[1, 3]),
        (w2c[2, 0], w2c[2, 1], w2c[2, 2], w2c[2, 3]),
    )


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def project(
    means,
    quaternions,
    scales,
    opacities,
    w2c,
    k,
    width,
    height,
    centers,
    depths,
    conics,
    outlines,
    boxes,
):
    """Project world Gaussians into the picture of a camera.

    `w2c` is (3, 4), `k` that of `footprint`. `means` (G, 3) and `scales` (G, 3) are in
    scene units, `quaternions` (G, 4) w x y z of any length, `opacities` (G,) in [0, 1].
    Fills pixel `centers` (G, 2), z-`depths` (G,), `conics` (G, 3), `outlines` (G, 4)
    and tile `boxes` (G, 4: x0, y0, x1, y1). Boxes exclude their ends, and are empty
    where nothing shows.
    """
    tiles_x, tiles_y = (width + TILE_X - 1) // TILE_X, (height + TILE_Y - 1) // TILE_Y
    for g in numba.prange(means.shape[0]):
        m, q, s = gaussian(means, quaternions, scales, g)
        t, _, _, _, _, covariance = footprint(m, q, s, view_rows(w2c), k, width, height)
        shows, center, conic, (left, top, right, bottom) = ellipse(
            t, covariance, float(opacities[g]), k, width, height
        )
        depths[g] = t[2]
        centers[g, 0], centers[g, 1] = center
        conics[g, 0], conics[g, 1], conics[g, 2] = conic
        boxes[g, 0] = boxes[g, 1] = boxes[g, 2] = boxes[g, 3] = 0
        if not shows:
            continue
        edge = outline(covariance, float(opacities[g]))
        outlines[g, 0], outlines[g, 1], outlines[g, 2], outlines[g, 3] = edge
        boxes[g, 0], boxes[g, 1] = int(left) // TILE_X, int(top) // TILE_Y
        boxes[g, 2] = min(int(right) // TILE_X + 1, tiles_x)
        boxes[g, 3] = min(int(bottom) // TILE_Y + 1, tiles_y)


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def project_backward(
    means, quaternions, scales, opacities, w2c, k, width, height, owned, pairs,
    grad_means, grad_quaternions, grad_scales, grad_opacities, grad_features, grad_pose,
):  # fmt: skip
    """Add up the pairs' gradients and carry them back to the world.

    Arguments as in `project`; `owned` (G + 1,) are each Gaussian's pairs, `pairs` (P,
    MOMENTS + D) their gradients from `compositing.backward`. Fills the `grad_...` of
    means, quaternions, scales, opacities and features, shaped like those. The last
    feature is the z-depth. `grad_pose` is (G, 12), the gradient of `w2c` per Gaussian,
    or (0, 12) if it is not wanted.
    """
    channels = grad_features.shape[1]
    for g in numba.prange(means.shape[0]):
        first, last = owned[g], owned[g + 1]
        if first == last:
            grad_means[g, :] = ZERO
            grad_quaternions[g, :] = ZERO
            grad_scales[g, :] = ZERO
            grad_opacities[g] = ZERO
            grad_features[g, :] = ZERO
            if len(grad_pose):
                grad_pose[g, :] = ZERO
            continue
        for d in range(channels):
            total = ZERO
            for i in range(first, last):
                total += pairs[i, MOMENTS + d]
            grad_features[g, d] = total
        sums = sum_moments(pairs, first, last)
        grad_opacities[g] = -sums[0] / opacities[g]  # dL / do = dL / dalpha * alpha / o
        m, q, s = gaussian(means, quaternions, scales, g)
        d_depth = float(grad_features[g, channels - 1])
        d_mean, d_quaternion, d_scales, d_view = world_gradients(
            m, q, s, view_rows(w2c), k, width, height, sums, d_depth
        )
        grad_means[g, 0], grad_means[g, 1], grad_means[g, 2] = d_mean
        grad_scales[g, 0], grad_scales[g, 1], grad_scales[g, 2] = d_scales
        for j in range(4):
            grad_quaternions[g, j] = d_quaternion[j]
        if len(grad_pose):
            for j in range(4):
                grad_pose[g, j] = d_view[0][j]
                grad_pose[g, 4 + j] = d_view[1][j]
                grad_pose[g, 8 + j] = d_view[2][j]


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def sum_moments(pairs, first, last):
    """The MOMENTS of a Gaussian's pairs from `first` to `last`, added up in float64."""
    u0 = u1 = u2 = u3 = u4 = u5 = 0.0
    for i in range(first, last):
        u0 += pairs[i, 0]
        u1 += pairs[i, 1]
        u2 += pairs[i, 2]
        u3 += pairs[i, 3]
        u4 += pairs[i, 4]
        u5 += pairs[i, 5]
    return u0, u1, u2, u3, u4, u5
