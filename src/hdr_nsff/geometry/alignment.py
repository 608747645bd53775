"""Alignment of points and of trajectories: the nearest rotation, the similarity between
two worlds, how far the same cameras differ in them, and how a pose known in one is
carried over to the other. Poses are camera to world, OpenCV axes, (..., 3, 4) float64
numpy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

# share of the distance from the origin (or of 1 scene unit): points that spread less
# fix no scale (hand-chosen, far above float64 rounding)
MIN_SPREAD_SHARE = 1e-6


@dataclass(frozen=True)
class Similarity:
    """The map `x -> scale * rotation @ x + translation`."""

    scale: float
    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """The images (N, 3) of `points` (N, 3)."""
        return self.scale * points @ self.rotation.T + self.translation


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotations (..., 3, 3) nearest to `matrix` (..., 3, 3) in the Frobenius norm.

    Of the sum of `target source^T` over centered points, it is the rotation that best
    maps `source` to `target` (Kabsch 1976). It never mirrors.
    """
    u, _, vt = np.linalg.svd(matrix)
    sign = np.ones(matrix.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(u @ vt))
    return (u * sign[..., None, :]) @ vt


def umeyama(source: np.ndarray, target: np.ndarray) -> Similarity | None:
    """The least-squares similarity from points `source` (N, 3) to `target` (N, 3).

    Umeyama 1991, eq. 40 to 42. None where the points of either do not spread, so that
    no scale can be estimated.
    """
    if min(spread_share(source), spread_share(target)) < MIN_SPREAD_SHARE:
        return None
    a = source - source.mean(0)
    b = target - target.mean(0)
    variance = (a**2).sum() / len(a)
    covariance = b.T @ a / len(a)
    rotation = nearest_rotation(covariance)
    scale = float((rotation * covariance).sum() / variance)
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def spread_share(points: np.ndarray) -> float:
    """Standard deviation of `points` (N, 3) per largest coordinate (at least 1)."""
    variance = ((points - points.mean(0)) ** 2).sum() / len(points)
    return float(np.sqrt(variance) / max(1.0, np.abs(points).max()))


def pose_errors(true: np.ndarray, estimated: np.ndarray) -> dict[str, float]:
    """How far `estimated` poses (N, 3, 4) are from the `true` ones once aligned.

    `ate`: root mean square distance of the centers after the best similarity, in true
    units; `ate_share`: the same as a share of the true path's extent (both absent where
    the cameras do not spread); `rotation_degrees`: mean angle left after the best
    common rotation. That rotation comes from the rotations themselves, since centers on
    a line leave it open.
    """
    errors: dict[str, float] = {}
    centers = true[:, :, 3]
    fit = umeyama(centers, estimated[:, :, 3])
    if fit is not None:
        distance = np.linalg.norm(fit(centers) - estimated[:, :, 3], axis=-1) / fit.scale
        extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
        errors["ate"] = float(np.sqrt((distance**2).mean()))
        errors["ate_share"] = errors["ate"] / extent
    true_rotations = Rotation.from_matrix(true[:, :, :3])
    relative = Rotation.from_matrix(estimated[:, :, :3]) * true_rotations.inv()
    remaining = relative.mean().inv() * relative
    errors["rotation_degrees"] = float(np.degrees(remaining.magnitude()).mean())
    return errors


def scale_between(true: np.ndarray, estimated: np.ndarray) -> float | None:
    """Units of the `estimated` poses (N, 3, 4) per unit of the `true` ones.

    1 where both are the same (given poses: one world), None where the cameras do not
    spread.
    """
    if np.allclose(true, estimated):
        return 1.0
    fit = umeyama(true[:, :, 3], estimated[:, :, 3])
    return None if fit is None else fit.scale


def transfer_pose(
    anchor: np.ndarray, true_anchor: np.ndarray, true_view: np.ndarray, scale: float
) -> np.ndarray:
    """The pose (3, 4) relative to `anchor` that `true_view` has relative to
    `true_anchor`.

    All poses are (3, 4); `anchor` is the estimate of `true_anchor`. Lengths are
    multiplied by `scale`.
    """
    to_true_anchor = true_anchor[:, :3].T
    relative_rotation = to_true_anchor @ true_view[:, :3]
    relative_center = to_true_anchor @ (true_view[:, 3] - true_anchor[:, 3])
    rotation = anchor[:, :3] @ relative_rotation
    center = anchor[:, 3] + scale * anchor[:, :3] @ relative_center
    return np.concatenate([rotation, center[:, None]], 1)
