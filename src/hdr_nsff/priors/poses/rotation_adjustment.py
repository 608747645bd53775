"""The rotations of a camera that only turns, and its focal length, from matches.

They are those that explain the matches between near and far frames at once (Szeliski
and Shum 1997), so nothing drifts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from hdr_nsff.geometry import pinhole

MAD_TO_SIGMA = 1.48  # standard deviation of a normal distribution per median |deviation|
MIN_RAY_DEPTH = 1e-3  # of unit z-depth: rays closer to sideways project as if they had it
MAX_ITERATIONS = 40  # of Levenberg-Marquardt (hand-chosen)
# a point is matched about ten times over, and those errors are one error (hand-chosen)
MATCHES_PER_POINT = 10.0


@dataclass(frozen=True)
class RotationMatches:
    """Matches that rotations are fitted to, in pixels from the image center."""

    frames: np.ndarray  # (M, 2) frames i and j of each match
    p: np.ndarray  # (M, 2) in frame i
    q: np.ndarray  # (M, 2) in frame j


def rotate_pixels(
    rotations: np.ndarray, focal: float, frames: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where frame j sees points `p` (M, 2) of frame i, both in pixels from the image
    center, and their directions (M, 3) in frame j. `frames` (M, 2): i and j.
    """
    K = np.diag([focal, focal, 1.0])
    world = np.einsum("mij,mj->mi", rotations[frames[:, 0]], pinhole.camera_rays(p, K))
    local = np.einsum("mji,mj->mi", rotations[frames[:, 1]], world)
    return pinhole.to_pixels(local, K, MIN_RAY_DEPTH), local


@dataclass(frozen=True)
class RefinedRotations:
    """What `refine` found."""

    rotations: np.ndarray  # (T, 3, 3) camera to world
    focal: float  # pixels
    log_focal_deviation: float  # standard deviation of the logarithm of the focal length


def refine(
    rotations: np.ndarray,
    focal: float,
    matches: RotationMatches,
    free_focal: bool,
    max_iterations: int = MAX_ITERATIONS,
) -> RefinedRotations:
    """Rotations and focal length with the least `robust_cost` over all matches, by
    Levenberg-Marquardt from `rotations` (T, 3, 3) and `focal`.
    """
    damping, lowest = 1e-4, robust_cost(rotations, focal, matches)
    normal, right = normal_equations(rotations, focal, matches, free_focal)
    for _ in range(max_iterations):
        step = solve_damped(normal, damping, right)
        turns = Rotation.from_rotvec(step[:-1].reshape(-1, 3)).as_matrix()
        new_rotations = rotations @ turns
        new_focal = float(focal * np.exp(np.clip(step[-1], -0.3, 0.3)))
        cost = robust_cost(new_rotations, new_focal, matches)
        if cost >= lowest:
            damping *= 10
            if damping > 1e6:
                break
            continue
        damping /= 10
        rotations, focal = new_rotations, new_focal
        normal, right = normal_equations(rotations, focal, matches, free_focal)
        if lowest - cost < 1e-7 * lowest:
            break
        lowest = cost
    predicted, _ = rotate_pixels(rotations, focal, matches.frames, matches.p)
    error = MAD_TO_SIGMA * np.median(np.linalg.norm(predicted - matches.q, axis=1))
    of_focal = np.append(np.zeros(len(right) - 1), 1.0)  # the last column of the inverse
    log_focal_variance = solve_damped(normal, 0.0, of_focal)[-1] * MATCHES_PER_POINT
    return RefinedRotations(rotations, focal, float(error * np.sqrt(log_focal_variance)))


def solve_damped(normal: np.ndarray, damping: float, right: np.ndarray) -> np.ndarray:
    """The solution (N,) for `normal` (N, N), symmetric and positive definite, with its
    diagonal raised by the share `damping`, and `right` (N,).
    """
    damped = normal.copy()
    np.einsum("ii->i", damped)[:] *= 1 + damping  # a view of the diagonal
    factor = cho_factor(damped.T, overwrite_a=True)  # in the order of LAPACK, so no copy
    return np.asarray(cho_solve(factor, right))


def robust_cost(rotations: np.ndarray, focal: float, matches: RotationMatches) -> float:
    """The mean of log(1 + r^2) over all matches, r in pixels (Cauchy's loss, 1 px)."""
    predicted, _ = rotate_pixels(rotations, focal, matches.frames, matches.p)
    squared_error = np.sum((predicted - matches.q) ** 2, 1)
    return float(np.mean(np.log1p(squared_error)))


def normal_equations(
    rotations: np.ndarray, focal: float, matches: RotationMatches, free_focal: bool
) -> tuple[np.ndarray, np.ndarray]:
    """J^T W J (3T + 1, 3T + 1) and J^T W r (3T + 1) of the matches; unknowns are three
    turns per frame and the logarithm of the focal length.
    """
    count, frames = len(rotations), matches.frames
    predicted, rays = rotate_pixels(rotations, focal, frames, matches.p)
    residual = matches.q - predicted  # (M, 2)
    weight = 1 / (1 + np.sum(residual**2, 1))
    jacobian = rotate_pixels_jacobian(rotations, focal, frames, matches.p, rays)  # (M, 2, 7)
    of_focal = np.full((len(frames), 1), 3 * count)
    columns = np.concatenate(
        [3 * frames[:, :1] + np.arange(3), 3 * frames[:, 1:] + np.arange(3), of_focal], 1
    )
    normal, right = np.zeros((3 * count + 1,) * 2), np.zeros(3 * count + 1)
    products = np.einsum("mki,m,mkj->mij", jacobian, weight, jacobian)
    np.add.at(normal, (columns[:, :, None], columns[:, None, :]), products)
    np.add.at(right, columns, np.einsum("mki,m,mk->mi", jacobian, weight, residual))
    # holds the common turn, which is free, and frames without matches
    normal[np.diag_indices(3 * count)] += 1e-3 * focal**2
    normal[-1, -1] += 1.0 if free_focal else 1e18
    return normal, right


def rotate_pixels_jacobian(
    rotations: np.ndarray, focal: float, frames: np.ndarray, p: np.ndarray, rays: np.ndarray
) -> np.ndarray:
    """Derivatives (M, 2, 7) of `rotate_pixels`, which gave the directions `rays` (M,
    3).

    By a turn of frame i (3, right-hand perturbation), a turn of frame j (3), and the
    logarithm of the focal length (1).
    """
    depth = np.maximum(rays[:, 2], MIN_RAY_DEPTH)
    pixels_by_ray = np.zeros((len(p), 2, 3))
    pixels_by_ray[:, 0, 0] = pixels_by_ray[:, 1, 1] = focal / depth
    pixels_by_ray[:, :, 2] = -focal * rays[:, :2] / depth[:, None] ** 2
    first, second = rotations[frames[:, 0]], rotations[frames[:, 1]]
    relative = np.einsum("mki,mkj->mij", second, first)  # R_j^T R_i
    rays_in_i = pinhole.homogeneous(p / focal)
    by_i = -pixels_by_ray @ relative @ skew(rays_in_i)
    by_j = pixels_by_ray @ skew(rays)
    ray_by_focal = np.einsum("mij,mj->mi", relative[:, :, :2], -p / focal)
    by_focal = focal * rays[:, :2] / depth[:, None]
    by_focal += np.einsum("mki,mi->mk", pixels_by_ray, ray_by_focal)
    return np.concatenate([by_i, by_j, by_focal[:, :, None]], 2)


def skew(v: np.ndarray) -> np.ndarray:
    """Matrices (M, 3, 3) with `skew(v) @ w == np.cross(v, w)`."""
    m = np.zeros((len(v), 3, 3))
    m[:, 0, 1] = -v[:, 2]
    m[:, 0, 2] = v[:, 1]
    m[:, 1, 2] = -v[:, 0]
    return m - np.swapaxes(m, 1, 2)
