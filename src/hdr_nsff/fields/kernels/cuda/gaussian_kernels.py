"""CUDA kernels with a thread per Gaussian: into the picture, its tiles, and backwards.

They call the CPU's functions for everything about one Gaussian (`footprint.py`), in
float64: compiled, `float` of a float32 is a float32. Shapes: G Gaussians, P (Gaussian,
tile) pairs. The simulator of numba-cuda replaces the name `cuda` in this module.
"""

from __future__ import annotations

import numpy as np
from numba import cuda, float64

from hdr_nsff.fields.kernels import footprint
from hdr_nsff.fields.kernels.cuda.device import device_functions, exact_device
from hdr_nsff.fields.kernels.cuda.layout import TILE
from hdr_nsff.fields.kernels.footprint import MOMENTS
from hdr_nsff.fields.kernels.projection import ZERO

FOOTPRINT = device_functions(footprint, fastmath=False)
footprint_of, ellipse_of = FOOTPRINT["footprint"], FOOTPRINT["ellipse"]
world_gradients = FOOTPRINT["world_gradients"]


@exact_device
def read_gaussian(g, means, quaternions, scales):
    """Mean, quaternion and scales of a Gaussian in float64."""
    m = (float64(means[g, 0]), float64(means[g, 1]), float64(means[g, 2]))
    q = (
        float64(quaternions[g, 0]),
        float64(quaternions[g, 1]),
        float64(quaternions[g, 2]),
        float64(quaternions[g, 3]),
    )
    return m, q, (float64(scales[g, 0]), float64(scales[g, 1]), float64(scales[g, 2]))


@exact_device
def read_camera(w2c, K, nearest):
    """World-to-camera matrix (3, 4), row by row, and (fx, fy, cx, cy, nearest)."""
    view = (
        (float64(w2c[0, 0]), float64(w2c[0, 1]), float64(w2c[0, 2]), float64(w2c[0, 3])),
        (float64(w2c[1, 0]), float64(w2c[1, 1]), float64(w2c[1, 2]), float64(w2c[1, 3])),
        (float64(w2c[2, 0]), float64(w2c[2, 1]), float64(w2c[2, 2]), float64(w2c[2, 3])),
    )
    fx, fy, cx, cy = float64(K[0, 0]), float64(K[1, 1]), float64(K[0, 2]), float64(K[1, 2])
    return view, (fx, fy, cx, cy, float64(nearest))


def project(
    means, quaternions, scales, opacities, features, w2c, K, width, height, nearest,
    ellipses, depths, values, boxes, counts,
):  # fmt: skip
    """Project world Gaussians, one thread each, as `projection.project` does.

    Fills `ellipses` (G, ELLIPSE), z-`depths` (G,), `values` (G, D) that are composited:
    the features, z-depth, and zeros; tile `boxes` (G, 4: x0, y0, x1, y1; ends excluded)
    and `counts` (G,), the number of tiles, 0 where nothing shows.
    """
    g = cuda.grid(1)
    if g >= means.shape[0]:
        return
    m, q, s = read_gaussian(g, means, quaternions, scales)
    view, k = read_camera(w2c, K, nearest)
    t, _, _, _, _, covariance = footprint_of(m, q, s, view, k, width, height)
    opacity = float64(opacities[g])
    shows, center, conic, bounds = ellipse_of(t, covariance, opacity, k, width, height)
    depths[g] = t[2]
    num_features = features.shape[1]
    for n in range(num_features):
        values[g, n] = features[g, n]
    values[g, num_features] = t[2]
    for n in range(num_features + 1, values.shape[1]):
        values[g, n] = ZERO
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


def order_pairs(keys, order, owners, starts, ordered):
    """Put the pairs in the order of their keys, and find where the tiles' lists start.

    A thread per pair and one more. `keys` (P,) are sorted, and `order` (P,) is where
    they were before. Fills `ordered` (P,), the `owners` (P,) in that order, and the
    tiles' `starts` (tiles + 1,).
    """
    i, count = cuda.grid(1), keys.shape[0]
    if i > count:
        return
    before = keys[i - 1] >> 32 if i > 0 else -1
    tile = starts.shape[0] - 1
    if i < count:
        tile = keys[i] >> 32
        ordered[i] = owners[order[i]]
    for t in range(before + 1, tile + 1):
        starts[t] = i


def project_backward(
    means, quaternions, scales, opacities, w2c, K, width, height, nearest, counts, sums,
    depth_channel, grad_means, grad_quaternions, grad_scales, grad_opacities, grad_view,
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
    m, q, s = read_gaussian(g, means, quaternions, scales)
    view, k = read_camera(w2c, K, nearest)
    u = (
        float64(sums[g, 0]),
        float64(sums[g, 1]),
        float64(sums[g, 2]),
        float64(sums[g, 3]),
        float64(sums[g, 4]),
        float64(sums[g, 5]),
    )
    grad_opacities[g] = -sums[g, 0] / opacities[g]  # dL / do = dL / dalpha * alpha / o
    d_depth = float64(sums[g, MOMENTS + depth_channel])
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
