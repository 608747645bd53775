"""Numba kernels of the Gaussian rasterizer on the CPU: world Gaussians to projected
ones and the tiles that they touch, and all of it backwards by hand.

A projected Gaussian is a pixel center, a conic, a z-depth, an opacity and D features.
The conic is the inverse 2D covariance in factors, alpha = opacity * exp(-(a dx)^2 - (b
dx + c dy)^2): multiplied out, float32 would lose needles whose center is far away. The
plain-torch twin is `rasterize.project`; `compositing.py` draws what comes out.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from hdr_nsff.core.jit import jit

TILE_X, TILE_Y = 8, 32  # pixels
# gradients of a pair before its features: sums of u, u dx, u dy, u dx^2, u dx dy, u
# dy^2
MOMENTS = 6
F0 = np.float32(0)
ALPHA_MIN = np.float32(1 / 255)  # alpha below this counts as nothing
NEAREST = 0.01  # z-depth, scene units: nothing nearer is drawn
BLUR = 0.3  # pixels^2 added to 2D variances, so that no Gaussian falls between pixels
FAST = {
    "contract",
    "reassoc",
    "nsz",
    "arcp",
}  # sums may be reordered, division be multiplication; NaN and Inf stay what they are
# of half the picture: how far outside it the projection is still linearized where the
# Gaussian is
MARGIN = 0.3


@jit(fastmath=FAST, error_model="numpy")
def rotation(q):
    """Unit quaternion (w, x, y, z), its rotation matrix row by row, and the length it
    had.
    """
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) + 1e-12
    w, x, y, z = q[0] / n, q[1] / n, q[2] / n, q[3] / n
    r = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return (w, x, y, z), r, n


@jit(fastmath=FAST, error_model="numpy")
def limited(x, z, low, high):
    """x moved so that x / z lies within [low, high], and whether it had to be."""
    ratio = x / z
    if ratio < low:
        return z * low, True
    if ratio > high:
        return z * high, True
    return x, False


@jit(fastmath=FAST, error_model="numpy")
def dot(a, b):
    """Of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit(fastmath=FAST, error_model="numpy")
def gaussian(means, quaternions, scales, g):
    """Mean (3,), quaternion (4,) and scales (3,) of Gaussian `g` in float64."""
    return (
        (float(means[g, 0]), float(means[g, 1]), float(means[g, 2])),
        (
            float(quaternions[g, 0]),
            float(quaternions[g, 1]),
            float(quaternions[g, 2]),
            float(quaternions[g, 3]),
        ),
        (float(scales[g, 0]), float(scales[g, 1]), float(scales[g, 2])),
    )


@jit(fastmath=FAST, error_model="numpy")
def jacobian(k, held):
    """The entries 00, 02, 11, 12 of J (2, 3), the projection linearized at the point
    `held`; the others are 0.
    """
    x, y, z, _, _ = held
    return k[0] / z, -k[0] * x / (z * z), k[1] / z, -k[1] * y / (z * z)


@jit(fastmath=FAST, error_model="numpy")
def footprint(m, q, s, v, k, width, height):
    """A Gaussian in the picture: camera point t, the point where the projection is
    linearized and whether x and y are held there, T = J W (2, 3), the rotation R of
    `rotation`, V = T R S (2, 3), and the 2D covariance V V^T + blur (xx, xy, yy).
    """
    t = (
        v[0, 0] * m[0] + v[0, 1] * m[1] + v[0, 2] * m[2] + v[0, 3],
        v[1, 0] * m[0] + v[1, 1] * m[1] + v[1, 2] * m[2] + v[1, 3],
        v[2, 0] * m[0] + v[2, 1] * m[1] + v[2, 2] * m[2] + v[2, 3],
    )
    z = t[2] if t[2] > NEAREST else NEAREST
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    edge_x, edge_y = MARGIN * 0.5 * width / fx, MARGIN * 0.5 * height / fy
    x, held_x = limited(t[0], z, -cx / fx - edge_x, (width - cx) / fx + edge_x)
    y, held_y = limited(t[1], z, -cy / fy - edge_y, (height - cy) / fy + edge_y)
    held = (x, y, z, held_x, held_y)
    j00, j02, j11, j12 = jacobian(k, held)
    t0 = (
        j00 * v[0, 0] + j02 * v[2, 0],
        j00 * v[0, 1] + j02 * v[2, 1],
        j00 * v[0, 2] + j02 * v[2, 2],
    )
    t1 = (
        j11 * v[1, 0] + j12 * v[2, 0],
        j11 * v[1, 1] + j12 * v[2, 1],
        j11 * v[1, 2] + j12 * v[2, 2],
    )
    unit, r, n = rotation(q)
    c0, c1, c2 = (
        (r[0][0], r[1][0], r[2][0]),
        (r[0][1], r[1][1], r[2][1]),
        (r[0][2], r[1][2], r[2][2]),
    )  # columns
    v0 = (dot(t0, c0) * s[0], dot(t0, c1) * s[1], dot(t0, c2) * s[2])
    v1 = (dot(t1, c0) * s[0], dot(t1, c1) * s[1], dot(t1, c2) * s[2])
    return (
        t,
        held,
        (t0, t1),
        (unit, r, n),
        (v0, v1),
        (dot(v0, v0) + BLUR, dot(v0, v1), dot(v1, v1) + BLUR),
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
    rows,
    boxes,
):
    """Fill pixel `centers` (G, 2), z-`depths` (G,), `conics` (G, 3), pixel `rows` (G,
    2) and tile `boxes` (G, 4: x0, y0, x1, y1, ends excluded; empty where nothing shows)
    of world Gaussians seen by `w2c` (3, 4) and `k` = (fx, fy, cx, cy). Lengths in scene
    units.
    """
    tiles_x, tiles_y = (width + TILE_X - 1) // TILE_X, (height + TILE_Y - 1) // TILE_Y
    for g in numba.prange(means.shape[0]):
        m, q, s = gaussian(means, quaternions, scales, g)
        t, _, _, _, _, (xx, xy, yy) = footprint(m, q, s, w2c, k, width, height)
        depths[g] = t[2]
        boxes[g, 0] = boxes[g, 1] = boxes[g, 2] = boxes[g, 3] = 0
        rows[g, 0] = rows[g, 1] = 0
        centers[g, 0] = centers[g, 1] = conics[g, 0] = conics[g, 1] = conics[g, 2] = F0
        o = float(opacities[g])
        if not (t[2] > NEAREST and o >= ALPHA_MIN):
            continue  # behind, too faint, or not a number
        x, y = k[0] * t[0] / t[2] + k[2], k[1] * t[1] / t[2] + k[3]
        reach = math.sqrt(2 * math.log(o * 255.0 + 1e-6)) if o * 255.0 > 1 else 0.0
        rx, ry = reach * math.sqrt(xx), reach * math.sqrt(yy)
        if not (x + rx > 0 and y + ry > 0 and x - rx < width and y - ry < height):
            continue  # outside, or not a number
        det = xx * yy - xy * xy
        if not det > 0:
            continue  # too long and thin for float64
        centers[g, 0], centers[g, 1] = x, y
        across = math.sqrt(0.5 * xx / det)
        conics[g, 0], conics[g, 1], conics[g, 2] = math.sqrt(0.5 / xx), -xy / xx * across, across
        left, right, top, bottom = (
            max(x - rx, 0.0),
            min(x + rx, float(width)),
            max(y - ry, 0.0),
            min(y + ry, float(height)),
        )
        rows[g, 0], rows[g, 1] = int(top), math.ceil(bottom)
        boxes[g, 0], boxes[g, 1] = int(left) // TILE_X, int(top) // TILE_Y
        boxes[g, 2] = min(int(right) // TILE_X + 1, tiles_x)
        boxes[g, 3] = min(int(bottom) // TILE_Y + 1, tiles_y)


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def project_backward(
    means, quaternions, scales, opacities, w2c, k, width, height, owned, pairs,
    grad_means, grad_quaternions, grad_scales, grad_opacities, grad_features, grad_pose,
):  # fmt: skip
    """Add up the pairs' gradients and carry them to the world: everything `(G, ...)`;
    `grad_pose` (G, 12) per Gaussian, or (0, 12) if not wanted. The last feature is the
    z-depth.
    """
    channels = grad_features.shape[1]
    for g in numba.prange(means.shape[0]):
        first, last = owned[g], owned[g + 1]
        if first == last:
            grad_means[g, :], grad_quaternions[g, :], grad_scales[g, :], grad_features[g, :] = (
                F0,
                F0,
                F0,
                F0,
            )
            grad_opacities[g] = F0
            if len(grad_pose):
                grad_pose[g, :] = F0
            continue
        for d in range(channels):
            total = F0
            for i in range(first, last):
                total += pairs[i, MOMENTS + d]
            grad_features[g, d] = total
        sums = sum_moments(pairs, first, last)
        grad_opacities[g] = -sums[0] / opacities[g]
        m, q, s = gaussian(means, quaternions, scales, g)
        t, held, projection, (unit, r, n), spread, covariance = footprint(
            m, q, s, w2c, k, width, height
        )
        center, d_covariance = picture_gradient(covariance, sums)
        d_scales, d_rotation, d_projection = shape_gradient(d_covariance, projection, spread, r, s)
        grad_scales[g, 0], grad_scales[g, 1], grad_scales[g, 2] = d_scales
        quaternion_gradient(unit, n, d_rotation, grad_quaternions[g])
        dx, dy, dz = point_gradient(center, d_projection, t, held, w2c, k)
        dz += float(grad_features[g, channels - 1])
        for j in range(3):
            grad_means[g, j] = w2c[0, j] * dx + w2c[1, j] * dy + w2c[2, j] * dz
        if len(grad_pose):
            pose_gradient((dx, dy, dz), d_projection, m, jacobian(k, held), grad_pose[g])


@jit(fastmath=FAST, error_model="numpy")
def sum_moments(pairs, first, last):
    """The moments of a Gaussian's pairs, added up in float64."""
    u0 = u1 = u2 = u3 = u4 = u5 = 0.0
    for i in range(first, last):
        u0 += pairs[i, 0]
        u1 += pairs[i, 1]
        u2 += pairs[i, 2]
        u3 += pairs[i, 3]
        u4 += pairs[i, 4]
        u5 += pairs[i, 5]
    return u0, u1, u2, u3, u4, u5


@jit(fastmath=FAST, error_model="numpy")
def picture_gradient(covariance, u):
    """From the moments `u` to dL / d pixel center (2,) and dL / d 2D covariance (xx,
    xy, yy), with Q its inverse: -Q (dL / dQ) Q.
    """
    xx, xy, yy = covariance
    det = xx * yy - xy * xy
    a, b, c = yy / det, -xy / det, xx / det  # in float64: needles thousands of pixels long need it
    p0, p1, p2, p3 = (
        a * u[3] + b * u[4],
        a * u[4] + b * u[5],
        b * u[3] + c * u[4],
        b * u[4] + c * u[5],
    )  # dL / dQ: half the moments
    inner = (-0.5 * (p0 * a + p1 * b), -0.5 * (p0 * b + p1 * c), -0.5 * (p2 * b + p3 * c))
    return (-(a * u[1] + b * u[2]), -(b * u[1] + c * u[2])), inner


@jit(fastmath=FAST, error_model="numpy")
def shape_gradient(g, projection, spread, r, s):
    """From G = dL / d covariance to dL / dS (3,), dL / dR (3, 3) and dL / dT (2, 3).
    The covariance is V V^T + blur with V = T M and M = R S, so dV = 2 G V, dM = T^T dV,
    dT = dV M^T.
    """
    (t0, t1), (v0, v1), (g00, g01, g11) = projection, spread, g
    d0 = (
        2 * (g00 * v0[0] + g01 * v1[0]),
        2 * (g00 * v0[1] + g01 * v1[1]),
        2 * (g00 * v0[2] + g01 * v1[2]),
    )
    d1 = (
        2 * (g01 * v0[0] + g11 * v1[0]),
        2 * (g01 * v0[1] + g11 * v1[1]),
        2 * (g01 * v0[2] + g11 * v1[2]),
    )
    m0 = (
        t0[0] * d0[0] + t1[0] * d1[0],
        t0[0] * d0[1] + t1[0] * d1[1],
        t0[0] * d0[2] + t1[0] * d1[2],
    )
    m1 = (
        t0[1] * d0[0] + t1[1] * d1[0],
        t0[1] * d0[1] + t1[1] * d1[1],
        t0[1] * d0[2] + t1[1] * d1[2],
    )
    m2 = (
        t0[2] * d0[0] + t1[2] * d1[0],
        t0[2] * d0[1] + t1[2] * d1[1],
        t0[2] * d0[2] + t1[2] * d1[2],
    )
    d_scales = (
        m0[0] * r[0][0] + m1[0] * r[1][0] + m2[0] * r[2][0],
        m0[1] * r[0][1] + m1[1] * r[1][1] + m2[1] * r[2][1],
        m0[2] * r[0][2] + m1[2] * r[1][2] + m2[2] * r[2][2],
    )
    d_rotation = (
        (m0[0] * s[0], m0[1] * s[1], m0[2] * s[2]),
        (m1[0] * s[0], m1[1] * s[1], m1[2] * s[2]),
        (m2[0] * s[0], m2[1] * s[1], m2[2] * s[2]),
    )
    e0, e1 = (d0[0] * s[0], d0[1] * s[1], d0[2] * s[2]), (d1[0] * s[0], d1[1] * s[1], d1[2] * s[2])
    d_projection = (
        (dot(e0, r[0]), dot(e0, r[1]), dot(e0, r[2])),
        (dot(e1, r[0]), dot(e1, r[1]), dot(e1, r[2])),
    )
    return d_scales, d_rotation, d_projection


@jit(fastmath=FAST, error_model="numpy")
def point_gradient(center, d_projection, t, held, w2c, k):
    """dL / d camera point (3,), through the pixel center and through J in T = J W,
    which does not see x or y where they are held.
    """
    (gx, gy), (dt0, dt1), (x, y, z, held_x, held_y), (fx, fy) = (
        center,
        d_projection,
        held,
        (k[0], k[1]),
    )
    w0, w1, w2 = (
        (w2c[0, 0], w2c[0, 1], w2c[0, 2]),
        (w2c[1, 0], w2c[1, 1], w2c[1, 2]),
        (w2c[2, 0], w2c[2, 1], w2c[2, 2]),
    )
    dj00, dj02, dj11, dj12 = dot(dt0, w0), dot(dt0, w2), dot(dt1, w1), dot(dt1, w2)
    dz = -(fx * dj00 + fy * dj11) / (z * z) - (fx * t[0] * gx + fy * t[1] * gy) / (z * z)
    dz += (fx * x * dj02 / (z * z * z)) * (1.0 if held_x else 2.0) + (
        fy * y * dj12 / (z * z * z)
    ) * (1.0 if held_y else 2.0)
    dx = fx / z * gx - (0.0 if held_x else fx * dj02 / (z * z))
    dy = fy / z * gy - (0.0 if held_y else fy * dj12 / (z * z))
    return dx, dy, dz


@jit(fastmath=FAST, error_model="numpy")
def pose_gradient(point, d_projection, m, j, out):
    """dL / d world-to-camera `out` (12,), row by row: through the camera point `W m +
    t`, and through W in T = J W.
    """
    (dx, dy, dz), (dt0, dt1), (j00, j02, j11, j12) = point, d_projection, j
    for i in range(3):
        out[i] = dx * m[i] + j00 * dt0[i]
        out[4 + i] = dy * m[i] + j11 * dt1[i]
        out[8 + i] = dz * m[i] + j02 * dt0[i] + j12 * dt1[i]
    out[3], out[7], out[11] = dx, dy, dz


@jit(fastmath=FAST, error_model="numpy")
def quaternion_gradient(unit, n, dr, out):
    """From dL / dR (3, 3) to the quaternion before it was made a unit one."""
    w, x, y, z = unit
    gw = 2 * (x * (dr[2][1] - dr[1][2]) + y * (dr[0][2] - dr[2][0]) + z * (dr[1][0] - dr[0][1]))
    gx = 2 * (
        -2 * x * (dr[1][1] + dr[2][2])
        + y * (dr[0][1] + dr[1][0])
        + z * (dr[0][2] + dr[2][0])
        + w * (dr[2][1] - dr[1][2])
    )
    gy = 2 * (
        x * (dr[0][1] + dr[1][0])
        - 2 * y * (dr[0][0] + dr[2][2])
        + z * (dr[1][2] + dr[2][1])
        + w * (dr[0][2] - dr[2][0])
    )
    gz = 2 * (
        x * (dr[0][2] + dr[2][0])
        + y * (dr[1][2] + dr[2][1])
        - 2 * z * (dr[0][0] + dr[1][1])
        + w * (dr[1][0] - dr[0][1])
    )
    along = gw * w + gx * x + gy * y + gz * z
    out[0], out[1], out[2], out[3] = (
        (gw - along * w) / n,
        (gx - along * x) / n,
        (gy - along * y) / n,
        (gz - along * z) / n,
    )
