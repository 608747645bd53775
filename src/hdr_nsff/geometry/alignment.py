"""Two trajectories of the same cameras, in two worlds: the similarity between them, how
far they differ, and how a pose known in the one is carried over to the other. Poses are
camera to world, OpenCV axes, (..., 3, 4) float64 numpy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# centers that spread less than this share of their distance from the origin (or of 1)
# fix no scale
FLAT = 1e-6


@dataclass(frozen=True)
class Similarity:
    """`scale * rotation @ x + translation`."""

    scale: float
    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) carried over."""
        return self.scale * points @ self.rotation.T + self.translation


def umeyama(source: np.ndarray, target: np.ndarray) -> Similarity | None:
    """The similarity that carries points `source` (N, 3) onto `target` (N, 3) with
    least squares (Umeyama 1991); None where the points of either do not spread, so that
    no scale can be told.
    """
    a, b = source - source.mean(0), target - target.mean(0)
    variance = (a**2).sum() / len(a)
    spread = [
        np.sqrt((x**2).sum() / len(x)) / max(1.0, np.abs(y).max())
        for x, y in ((a, source), (b, target))
    ]
    if min(spread) < FLAT:
        return None
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u * sign @ vt
    scale = float((d * sign).sum() / variance)
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to all of `rotations` (N, 3, 3) (chordal mean)."""
    u, _, vt = np.linalg.svd(rotations.sum(0))
    return u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def pose_errors(true: np.ndarray, estimated: np.ndarray) -> dict[str, float]:
    """How far `estimated` (N, 3, 4) is from `true` (N, 3, 4) once aligned.

    `ate`: root mean square distance of the centers after the best similarity, in true
    units; `ate_share`: the same as a share of the true path's extent (both absent where
    the cameras do not spread); `rotation_degrees`: mean angle left after the best
    common rotation (from the rotations themselves: centers along a line would not tell
    it).
    """
    errors: dict[str, float] = {}
    fit = umeyama(true[:, :, 3], estimated[:, :, 3])
    if fit is not None:
        distance = np.linalg.norm(fit(true[:, :, 3]) - estimated[:, :, 3], axis=-1) / fit.scale
        errors["ate"] = float(np.sqrt((distance**2).mean()))
        errors["ate_share"] = errors["ate"] / float(np.linalg.norm(np.ptp(true[:, :, 3], axis=0)))
    between = estimated[:, :, :3] @ true[:, :, :3].transpose(0, 2, 1)
    left = mean_rotation(between).T @ between
    cosine = np.clip((np.trace(left, axis1=1, axis2=2) - 1) / 2, -1, 1)
    errors["rotation_degrees"] = float(np.degrees(np.arccos(cosine)).mean())
    return errors


def scale_between(true: np.ndarray, estimated: np.ndarray) -> float | None:
    """Units of the `estimated` poses (N, 3, 4) per unit of the `true` ones; 1 where
    both are the same, None where the cameras do not spread.
    """
    if np.allclose(true, estimated):
        return 1.0  # given poses: one world
    fit = umeyama(true[:, :, 3], estimated[:, :, 3])
    return None if fit is None else fit.scale


def carry(
    anchor: np.ndarray, true_anchor: np.ndarray, true_view: np.ndarray, scale: float
) -> np.ndarray:
    """The pose (3, 4) that stands to the estimated `anchor` as `true_view` stands to
    `true_anchor`; lengths times `scale`.
    """
    turn = true_anchor[:, :3].T @ true_view[:, :3]
    step = true_anchor[:, :3].T @ (true_view[:, 3] - true_anchor[:, 3])
    return np.concatenate(
        [anchor[:, :3] @ turn, (anchor[:, 3] + scale * anchor[:, :3] @ step)[:, None]], 1
    )
