"""The robust rigid fit of two sets of points, compiled.

Groups are merged by thousands of such fits of a few hundred points each.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.jit import jit


@jit(inline="always")
def weighted_mean(points, weight):
    """The mean (3,) of `points` (N, 3) by their `weight` (N,)."""
    mean, total = np.zeros(3), 1e-12
    for n in range(points.shape[0]):
        total += weight[n]
        for i in range(3):
            mean[i] += weight[n] * points[n, i]
    return mean / total


@jit(inline="always")
def best_rotation(covariance):
    """The rotation (3, 3) of largest inner product with a `covariance` (3, 3) of target
    and source: the unit quaternion of Horn 1987, "Closed-form solution of absolute
    orientation using unit quaternions". It never mirrors.
    """
    c = covariance
    form = np.zeros((4, 4))
    form[0, 0] = c[0, 0] + c[1, 1] + c[2, 2]
    form[1, 1] = c[0, 0] - c[1, 1] - c[2, 2]
    form[2, 2] = c[1, 1] - c[0, 0] - c[2, 2]
    form[3, 3] = c[2, 2] - c[0, 0] - c[1, 1]
    form[1, 0] = c[2, 1] - c[1, 2]
    form[2, 0] = c[0, 2] - c[2, 0]
    form[3, 0] = c[1, 0] - c[0, 1]
    form[2, 1] = c[0, 1] + c[1, 0]
    form[3, 1] = c[0, 2] + c[2, 0]
    form[3, 2] = c[1, 2] + c[2, 1]
    w, x, y, z = np.linalg.eigh(form)[1][:, 3]  # reads the lower half; ascending
    rotation = np.empty((3, 3))
    rotation[0, 0] = 1 - 2 * (y * y + z * z)
    rotation[1, 1] = 1 - 2 * (x * x + z * z)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)
    rotation[0, 1], rotation[1, 0] = 2 * (x * y - z * w), 2 * (x * y + z * w)
    rotation[0, 2], rotation[2, 0] = 2 * (x * z + y * w), 2 * (x * z - y * w)
    rotation[1, 2], rotation[2, 1] = 2 * (y * z - x * w), 2 * (y * z + x * w)
    return rotation


@jit(nogil=True, error_model="numpy")
def fit_rigid(source, target, weight, rounds, min_rotation_points):
    """Rotation (3, 3) and translation (3,) with target = R source + translation.

    `source` and `target` are (N, 3), `weight` (N,), all contiguous. See
    `rigid_motion.fit_rigid`.
    """
    count = source.shape[0]
    rotation, translation = np.eye(3), np.zeros(3)
    residual, robust = np.empty(count), weight.copy()
    for _ in range(rounds):
        a, b = weighted_mean(source, robust), weighted_mean(target, robust)
        if count >= min_rotation_points:
            covariance = np.zeros((3, 3))
            for n in range(count):
                for i in range(3):
                    for j in range(3):
                        moved = robust[n] * (target[n, i] - b[i])
                        covariance[i, j] += moved * (source[n, j] - a[j])
            rotation = best_rotation(covariance)
        for i in range(3):
            turned = rotation[i, 0] * a[0] + rotation[i, 1] * a[1] + rotation[i, 2] * a[2]
            translation[i] = b[i] - turned
        for n in range(count):
            squared = 0.0
            for i in range(3):
                difference = translation[i] - target[n, i]
                for j in range(3):
                    difference += rotation[i, j] * source[n, j]
                squared += difference**2
            residual[n] = np.sqrt(squared)
        scale = np.median(residual) + 1e-9
        for n in range(count):
            robust[n] = weight[n] / (1 + (residual[n] / scale) ** 2)
    return rotation, translation
