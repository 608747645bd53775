"""Tracks of rigid bodies of known motion, seen by a camera at the origin."""

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.tracks import Tracks

TIMES = 14


def body(
    seed: int, start: np.ndarray, velocity: np.ndarray, spin: float, count: int = 120
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (count, TIMES, 3) of a turning, moving body; its rotations (TIMES, 3, 3)
    and positions (TIMES, 3).
    """
    local = np.random.default_rng(seed).uniform(-0.25, 0.25, (count, 3))
    rotations = Rotation.from_rotvec(np.outer(np.arange(TIMES) * spin, [0.3, 1.0, 0.2])).as_matrix()
    positions = start + np.outer(np.arange(TIMES), velocity)
    return np.einsum("tij,nj->nti", rotations, local) + positions, rotations, positions


def tracked(points: np.ndarray, noise: float = 0.0, seed: int = 0) -> Tracks:
    """Tracks of points (focal length 200 px), each over half of the time, with depth of
    relative `noise`.
    """
    rng = np.random.default_rng(seed)
    pixels = 200 * points[..., :2] / points[..., 2:] + 100
    points = points * (1 + noise * rng.standard_normal(points.shape[:2]))[..., None]
    first = rng.integers(0, TIMES // 2, len(points))[:, None]
    visible = (np.arange(TIMES) >= first) & (np.arange(TIMES) < first + TIMES // 2)
    hide = np.where(visible, 1.0, np.nan)[..., None]
    return Tracks(
        pixels * hide,
        points * hide,
        visible.astype(float),
        visible.astype(int),
        np.zeros(visible.shape, int),
        np.arange(float(TIMES)),
    )
