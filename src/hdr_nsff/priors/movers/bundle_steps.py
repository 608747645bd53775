"""The damped Gauss-Newton steps of bundle adjustment, with the points eliminated.

That is the Schur complement (Triggs et al., "Bundle adjustment: a modern synthesis",
1999): what remains to be solved is as large as the poses, however many points there
are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

TRACKS_TOGETHER = 16  # in one product of the Schur complement


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the Gauss-Newton approximation, and gradients of the cost.

    Point n and the poses share `points_poses[n]` and, since the size of a shape grows
    with its distance, the product of `by_size[n]` and `by_distance`.
    """

    poses: np.ndarray  # (6 T, 6 T); six unknowns a time: rotation vector, translation
    points: np.ndarray  # (N, 3, 3)
    points_poses: np.ndarray  # (N, 3, 6 T), 0 where not visible
    by_size: np.ndarray  # (N, 3)
    by_distance: np.ndarray  # (6 T,)
    pose_gradient: np.ndarray  # (6 T,)
    point_gradient: np.ndarray  # (N, 3)


def solve_damped(
    equations: NormalEquations, visible: np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """The steps (6 T,) of the poses and (N, 3) of the points, by the Schur complement.

    The diagonals grow by the share `damping`; `visible` (N, T) of the tracks.
    LinAlgError where the poses stay undetermined.
    """
    poses, points = equations.poses.copy(), equations.points.copy()
    size = len(poses)
    poses[np.diag_indices(size)] *= 1 + damping
    poses[np.diag_indices(size)] += 1e-9 * np.trace(poses) / size + 1e-12
    points[:, np.arange(3), np.arange(3)] *= 1 + damping

    inverse = np.linalg.inv(points)
    subtract_carried(poses, equations.points_poses, inverse, visible)
    couplings = equations.points_poses.reshape(-1, size)  # (3 N, 6 T)
    sizes, distance = equations.by_size, equations.by_distance
    solved_sizes = (inverse @ sizes[..., None])[..., 0]  # (N, 3)
    carried_sizes = solved_sizes.reshape(-1) @ couplings
    half = np.outer(carried_sizes + 0.5 * (sizes * solved_sizes).sum() * distance, distance)
    poses -= half + half.T
    solved = (inverse @ equations.point_gradient[..., None])[..., 0]  # (N, 3)
    carried = solved.reshape(-1) @ couplings + distance * (sizes * solved).sum()
    factor = cho_factor(poses, lower=True, overwrite_a=True, check_finite=False)
    pose_step = cho_solve(factor, carried - equations.pose_gradient, check_finite=False)
    remaining = equations.point_gradient + (couplings @ pose_step).reshape(-1, 3)
    remaining += sizes * (distance @ pose_step)
    return pose_step, -(inverse @ remaining[..., None])[..., 0]


def subtract_carried(
    poses: np.ndarray, points_poses: np.ndarray, inverse: np.ndarray, visible: np.ndarray
) -> None:
    """Subtract from `poses` (6 T, 6 T) what points carry from pose to pose: the sum of
    W_n^T P_n W_n, W_n of `points_poses` (N, 3, 6 T) and P_n of `inverse` (N, 3, 3).

    Tracks that start at about the same time go together, so that short ones cost only
    the times at which they are `visible` (N, T).
    """
    factors = np.swapaxes(np.linalg.cholesky(inverse), 1, 2)  # F_n, P_n = F_n^T F_n
    order = np.argsort(visible.argmax(1), kind="stable")
    for first in range(0, len(order), TRACKS_TOGETHER):
        chosen = order[first : first + TRACKS_TOGETHER]
        times = np.nonzero(visible[chosen].any(0))[0]
        if len(times):
            span = slice(6 * times[0], 6 * times[-1] + 6)
            carried = factors[chosen] @ points_poses[chosen, :, span]
            carried = carried.reshape(-1, carried.shape[2])
            # numpy makes half of the product of a matrix with itself, and mirrors it
            poses[span, span] -= carried.T @ carried
