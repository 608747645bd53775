"""Reprojection of a mover's points and their normal equations, compiled.

The formulas of `bundle_problem.py`, one observation at a time: tracks are short, and
only what is visible costs time.
"""

from __future__ import annotations

import math

import numpy as np

from hdr_nsff.core.jit import jit


@jit(inline="always")
def to_local(point, rotation, shift, w2c, rotated, local):
    """Write R p to `rotated` (3,) and its camera coordinates to `local` (3,).

    `shift` (3,) is the translation less the camera's position.
    """
    for i in range(3):
        rotated[i] = (
            rotation[i, 0] * point[0] + rotation[i, 1] * point[1] + rotation[i, 2] * point[2]
        )
    x, y, z = rotated[0] + shift[0], rotated[1] + shift[1], rotated[2] + shift[2]
    for i in range(3):
        local[i] = w2c[i, 0] * x + w2c[i, 1] * y + w2c[i, 2] * z


@jit(inline="always")
def pixel_error(local, z, K, pixel):
    """The error (x, y) in pixels of a point `local` (3,) that projects at depth `z`."""
    x, y = local[0] / z, local[1] / z
    dx = K[0, 0] * x + K[0, 1] * y + K[0, 2] - pixel[0]
    dy = K[1, 0] * x + K[1, 1] * y + K[1, 2] - pixel[1]
    return dx, dy


@jit(nogil=True, error_model="numpy")
def reproject_points(
    points, rotations, shifts, w2c, K, pixels, noise, visible, min_depth, error, depth
):
    """Fill `error` (N, T, 2) px and `depth` (N, T) of visible points, 0 elsewhere."""
    rotated, local = np.empty(3), np.empty(3)
    for n in range(points.shape[0]):
        for t in range(rotations.shape[0]):
            if not visible[n, t]:
                error[n, t, 0] = error[n, t, 1] = depth[n, t] = 0.0
                continue
            to_local(points[n], rotations[t], shifts[t], w2c[t], rotated, local)
            z = max(local[2], min_depth)
            error[n, t, 0], error[n, t, 1] = pixel_error(local, z, K[t], pixels[n, t])
            depth[n, t] = local[2]


@jit(nogil=True, error_model="numpy")
def accumulate(
    points,
    rotations,
    shifts,
    w2c,
    K,
    pixels,
    noise,
    visible,
    min_depth,
    pose_blocks,
    point_blocks,
    points_poses,
    pose_gradient,
    point_gradient,
):
    """Add the Gauss-Newton terms of all reprojection errors, by Huber weights.

    To `pose_blocks` (T, 6, 6), `point_blocks` (N, 3, 3), `points_poses` (N, 3, T, 6),
    `pose_gradient` (T, 6) and `point_gradient` (N, 3). A pose is a rotation vector,
    then a translation.
    """
    rotated, local = np.empty(3), np.empty(3)
    by_local, by_world = np.zeros((2, 3)), np.empty((2, 3))
    by_pose, by_point = np.empty((2, 6)), np.empty((2, 3))
    for n in range(points.shape[0]):
        for t in range(rotations.shape[0]):
            if not visible[n, t]:
                continue
            to_local(points[n], rotations[t], shifts[t], w2c[t], rotated, local)
            z = max(local[2], min_depth)
            dx, dy = pixel_error(local, z, K[t], pixels[n, t])
            sigma = noise[n, t]
            weight = 1 / (max(math.hypot(dx, dy) / sigma, 1.0) * sigma**2)
            fx, fy = K[t, 0, 0], K[t, 1, 1]
            by_local[0, 0], by_local[0, 2] = fx / z, -fx * local[0] / z**2
            by_local[1, 1], by_local[1, 2] = fy / z, -fy * local[1] / z**2
            for i in range(2):
                for j in range(3):
                    by_world[i, j] = (
                        by_local[i, 0] * w2c[t, 0, j]
                        + by_local[i, 1] * w2c[t, 1, j]
                        + by_local[i, 2] * w2c[t, 2, j]
                    )
                row = by_world[i]
                by_pose[i, 0] = rotated[1] * row[2] - rotated[2] * row[1]
                by_pose[i, 1] = rotated[2] * row[0] - rotated[0] * row[2]
                by_pose[i, 2] = rotated[0] * row[1] - rotated[1] * row[0]
                for j in range(3):
                    by_pose[i, 3 + j] = row[j]
                    by_point[i, j] = (
                        row[0] * rotations[t, 0, j]
                        + row[1] * rotations[t, 1, j]
                        + row[2] * rotations[t, 2, j]
                    )
            for j in range(6):
                first, second = weight * by_pose[0, j], weight * by_pose[1, j]
                pose_gradient[t, j] += first * dx + second * dy
                for k in range(6):
                    pose_blocks[t, j, k] += first * by_pose[0, k] + second * by_pose[1, k]
                for k in range(3):
                    points_poses[n, k, t, j] += first * by_point[0, k] + second * by_point[1, k]
            for j in range(3):
                first, second = weight * by_point[0, j], weight * by_point[1, j]
                point_gradient[n, j] += first * dx + second * dy
                for k in range(3):
                    point_blocks[n, j, k] += first * by_point[0, k] + second * by_point[1, k]
