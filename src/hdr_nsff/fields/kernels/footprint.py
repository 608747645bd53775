"""One Gaussian into the picture of a camera, and its gradients back to the world: the
mathematics of the rasterizer's kernels, in scalars.

EWA splatting (Zwicker et al. 2001; Kerbl et al. 2023): a Gaussian of rotation R and
scales S, seen by a camera of rotation W, has the 2D covariance V V^T + blur with V = J
W R S, where J linearizes the projection at its mean. A projected Gaussian is a pixel
center, a conic, a z-depth, an opacity and D features. The conic (a, b, c) is the
inverse 2D covariance in factors: alpha = opacity * exp(-s) with s = (a dx)^2 + (b dx +
c dy)^2. Multiplied out, float32 would lose needles whose center is far away.

Everything is computed in float64 and in plain tuples, without arrays: numba compiles
these functions for the CPU (`projection.py`), and numba-cuda the same ones for NVIDIA
GPUs (`cuda/gaussian_kernels.py`). The plain-torch twin is `rasterize.project`.
"""

from __future__ import annotations

import math

import numpy as np

from hdr_nsff.core.jit import jit

# gradients of a pair before its features: sums over its pixels of u = dL / ds, u dx, u
# dy, u dx^2, u dx dy and u dy^2
MOMENTS = 6
ALPHA_MIN = np.float32(1 / 255)  # alpha below this counts as 0
# z-depth, in units of a scene's near depth: nothing nearer is drawn (gsplat's default)
NEAREST = 0.01
# pixels^2 added to 2D variances, so that no Gaussian falls between pixels (Kerbl et al.
# 2023)
BLUR = 0.3
# of half the picture: how far outside of it the projection is still linearized at the
# mean, and not at the edge (as in gsplat)
MARGIN = 0.3
MIN_LENGTH = 1e-12  # added to a quaternion's length, which may be 0
# sums may be reordered, division be multiplication; NaN and Inf stay what they are
FAST = {"contract", "reassoc", "nsz", "arcp"}


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def rotation(q):
    """The unit quaternion (w, x, y, z) of `q`, its rotation matrix, and q's length.

    The matrix is given row by row.
    """
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) + MIN_LENGTH
    w, x, y, z = q[0] / n, q[1] / n, q[2] / n, q[3] / n
    r = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return (w, x, y, z), r, n


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def clamp_ratio(x, z, low, high):
    """x, moved so that x / z lies within [low, high], and whether it was moved."""
    ratio = x / z
    if ratio < low:
        return z * low, True
    if ratio > high:
        return z * high, True
    return x, False


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def dot(a, b):
    """Dot product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def jacobian(k, held):
    """Entries 00, 02, 11 and 12 of J (2, 3), the linearized projection.

    It has intrinsics k and is linearized at the point of `held`; the other entries are
    0.
    """
    x, y, z, _, _ = held
    return k[0] / z, -k[0] * x / (z * z), k[1] / z, -k[1] * y / (z * z)


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def footprint(m, q, s, v, k, width, height):
    """A Gaussian of mean m, quaternion q and scales s in a camera's picture.

    The camera has world-to-camera matrix v, three rows of 4 numbers, and k = (fx, fy,
    cx, cy, nearest): its intrinsics, and the z-depth that is the nearest drawn.
    Returns the camera point t (3,); `held`, the point where the projection is
    linearized and whether its x and y are clamped; T = J W (2, 3); the triple of
    `rotation`; V = T R S (2, 3); and the 2D covariance V V^T + blur (xx, xy, yy).
    """
    t = (
        v[0][0] * m[0] + v[0][1] * m[1] + v[0][2] * m[2] + v[0][3],
        v[1][0] * m[0] + v[1][1] * m[1] + v[1][2] * m[2] + v[1][3],
        v[2][0] * m[0] + v[2][1] * m[1] + v[2][2] * m[2] + v[2][3],
    )
    fx, fy, cx, cy, nearest = k[0], k[1], k[2], k[3], k[4]
    z = t[2] if t[2] > nearest else nearest
    edge_x, edge_y = MARGIN * 0.5 * width / fx, MARGIN * 0.5 * height / fy
    x, held_x = clamp_ratio(t[0], z, -cx / fx - edge_x, (width - cx) / fx + edge_x)
    y, held_y = clamp_ratio(t[1], z, -cy / fy - edge_y, (height - cy) / fy + edge_y)
    held = (x, y, z, held_x, held_y)
    j00, j02, j11, j12 = jacobian(k, held)
    t0 = (
        j00 * v[0][0] + j02 * v[2][0],
        j00 * v[0][1] + j02 * v[2][1],
        j00 * v[0][2] + j02 * v[2][2],
    )
    t1 = (
        j11 * v[1][0] + j12 * v[2][0],
        j11 * v[1][1] + j12 * v[2][1],
        j11 * v[1][2] + j12 * v[2][2],
    )
    unit, r, n = rotation(q)
    column0 = (r[0][0], r[1][0], r[2][0])
    column1 = (r[0][1], r[1][1], r[2][1])
    column2 = (r[0][2], r[1][2], r[2][2])
    v0 = (dot(t0, column0) * s[0], dot(t0, column1) * s[1], dot(t0, column2) * s[2])
    v1 = (dot(t1, column0) * s[0], dot(t1, column1) * s[1], dot(t1, column2) * s[2])
    covariance = (dot(v0, v0) + BLUR, dot(v0, v1), dot(v1, v1) + BLUR)
    return t, held, (t0, t1), (unit, r, n), (v0, v1), covariance


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def reach_of(o):
    """Standard deviations at which the alpha of an opacity o falls below ALPHA_MIN."""
    return math.sqrt(2 * math.log(o * 255.0 + 1e-6)) if o * 255.0 > 1 else 0.0


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def outline(covariance, o):
    """The ellipse in pixels outside of which a Gaussian of opacity o shows nothing.

    It is dy = slope dx +- ratio sqrt(half_width^2 - dx^2) around the center. Returns
    half_width, slope, ratio, and the dx of its lowest point, where dy is largest.
    """
    xx, xy, yy = covariance
    half_width = reach_of(o) * math.sqrt(xx)
    ratio = math.sqrt(xx * yy - xy * xy) / xx
    return half_width, xy / xx, ratio, half_width * xy / math.sqrt(xx * yy)


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def ellipse(t, covariance, o, k, width, height):
    """What a Gaussian of camera point t (3,) and opacity o covers of the picture.

    `covariance` is its 2D one (xx, xy, yy), k that of `footprint`. Returns whether it
    shows at all, its pixel center (2,), its conic (3,), and its bounds in pixels: left,
    top, right, bottom.
    """
    xx, xy, yy = covariance
    hidden = False, (0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
    if not (t[2] > k[4] and ALPHA_MIN <= o < math.inf):
        return hidden  # behind, too faint, or not finite
    x, y = k[0] * t[0] / t[2] + k[2], k[1] * t[1] / t[2] + k[3]
    reach = reach_of(o)
    rx, ry = reach * math.sqrt(xx), reach * math.sqrt(yy)
    if not (x + rx > 0 and y + ry > 0 and x - rx < width and y - ry < height):
        return hidden  # outside, or not a number
    det = xx * yy - xy * xy
    if not det > 0:
        return hidden  # too long and thin for float64
    across = math.sqrt(0.5 * xx / det)
    conic = math.sqrt(0.5 / xx), -xy / xx * across, across
    left, right = max(x - rx, 0.0), min(x + rx, float(width))
    top, bottom = max(y - ry, 0.0), min(y + ry, float(height))
    return True, (x, y), conic, (left, top, right, bottom)


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def picture_gradient(covariance, u):
    """dL / d pixel center (2,) and dL / d covariance (xx, xy, yy), of the moments `u`.

    With Q the inverse of the 2D covariance, s = d^T Q d / 2 of an offset d: dL / dQ is
    half the second moments, and dL / d covariance = -Q (dL / dQ) Q.
    """
    xx, xy, yy = covariance
    det = xx * yy - xy * xy
    # Q = (a, b; b, c) in float64: needles thousands of pixels long need it
    a, b, c = yy / det, -xy / det, xx / det
    # rows of Q times the second moments
    p0, p1 = a * u[3] + b * u[4], a * u[4] + b * u[5]
    p2, p3 = b * u[3] + c * u[4], b * u[4] + c * u[5]
    d_covariance = (-0.5 * (p0 * a + p1 * b), -0.5 * (p0 * b + p1 * c), -0.5 * (p2 * b + p3 * c))
    d_center = (-(a * u[1] + b * u[2]), -(b * u[1] + c * u[2]))
    return d_center, d_covariance


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def shape_gradient(g, projection, spread, r, s):
    """From dL / d covariance to dL / dS (3,), dL / dR (3, 3) and dL / dT (2, 3).

    `g` is G = dL / d covariance (xx, xy, yy). The covariance is V V^T + blur with V = T
    M and M = R S, so that dV = 2 G V, dM = T^T dV and dT = dV M^T.
    """
    t0, t1 = projection
    v0, v1 = spread
    g00, g01, g11 = g
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
    e0 = (d0[0] * s[0], d0[1] * s[1], d0[2] * s[2])
    e1 = (d1[0] * s[0], d1[1] * s[1], d1[2] * s[2])
    d_projection = (
        (dot(e0, r[0]), dot(e0, r[1]), dot(e0, r[2])),
        (dot(e1, r[0]), dot(e1, r[1]), dot(e1, r[2])),
    )
    return d_scales, d_rotation, d_projection


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def point_gradient(center, d_projection, t, held, w2c, k):
    """dL / d camera point t (3,), through the pixel center and through J in T = J W.

    Given are dL / d pixel `center` (2,) and dL / dT (2, 3). J does not depend on x or y
    where they are held at the edge: there x / z is constant.
    """
    gx, gy = center
    dt0, dt1 = d_projection
    x, y, z, held_x, held_y = held
    fx, fy = k[0], k[1]
    w0, w1, w2 = w2c
    # dL / dJ = dL / dT W^T
    dj00, dj02 = dot(dt0, w0), dot(dt0, w2)
    dj11, dj12 = dot(dt1, w1), dot(dt1, w2)
    slope_x, slope_y = 1.0 if held_x else 2.0, 1.0 if held_y else 2.0
    dz = -(fx * dj00 + fy * dj11) / (z * z) - (fx * t[0] * gx + fy * t[1] * gy) / (z * z)
    dz += (fx * x * dj02 / (z * z * z)) * slope_x + (fy * y * dj12 / (z * z * z)) * slope_y
    dx = fx / z * gx - (0.0 if held_x else fx * dj02 / (z * z))
    dy = fy / z * gy - (0.0 if held_y else fy * dj12 / (z * z))
    return dx, dy, dz


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def quaternion_gradient(unit, n, dr):
    """dL / d quaternion (4,) before it was normalized, from dL / dR (3, 3).

    That is the unit quaternion's gradient without its part along it, over the length n.
    """
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
    return (
        (gw - along * w) / n,
        (gx - along * x) / n,
        (gy - along * y) / n,
        (gz - along * z) / n,
    )


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def pose_gradient(point, d_projection, m, j):
    """dL / d world-to-camera matrix, three rows of 4 numbers.

    It flows through the camera point `W m + t`, and through W in T = J W.
    """
    dx, dy, dz = point
    dt0, dt1 = d_projection
    j00, j02, j11, j12 = j
    return (
        (dx * m[0] + j00 * dt0[0], dx * m[1] + j00 * dt0[1], dx * m[2] + j00 * dt0[2], dx),
        (dy * m[0] + j11 * dt1[0], dy * m[1] + j11 * dt1[1], dy * m[2] + j11 * dt1[2], dy),
        (
            dz * m[0] + j02 * dt0[0] + j12 * dt1[0],
            dz * m[1] + j02 * dt0[1] + j12 * dt1[1],
            dz * m[2] + j02 * dt0[2] + j12 * dt1[2],
            dz,
        ),
    )


@jit(fastmath=FAST, error_model="numpy", forceinline=True)
def world_gradients(m, q, s, v, k, width, height, sums, d_depth):
    """Gradients of mean (3,), quaternion (4,) and scales (3,) of a Gaussian, and of v.

    Arguments as in `footprint`, the MOMENTS `sums`, and dL / d z-depth.
    """
    t, held, projection, (unit, r, n), spread, covariance = footprint(m, q, s, v, k, width, height)
    center, d_covariance = picture_gradient(covariance, sums)
    d_scales, d_rotation, d_projection = shape_gradient(d_covariance, projection, spread, r, s)
    dx, dy, dz = point_gradient(center, d_projection, t, held, v, k)
    dz += d_depth
    d_mean = (
        v[0][0] * dx + v[1][0] * dy + v[2][0] * dz,
        v[0][1] * dx + v[1][1] * dy + v[2][1] * dz,
        v[0][2] * dx + v[1][2] * dy + v[2][2] * dz,
    )
    d_view = pose_gradient((dx, dy, dz), d_projection, m, jacobian(k, held))
    return d_mean, quaternion_gradient(unit, n, d_rotation), d_scales, d_view
