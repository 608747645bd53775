"""A tumbling body in one moving camera: its true points, and its tracks at a depth that
is one distance per time.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.bundle import MoverShape, path_without_rotation
from hdr_nsff.priors.movers.bundle_problem import BundleProblem, BundleState, Cameras
from hdr_nsff.priors.movers.rigid_motion import fit_motion
from hdr_nsff.priors.movers.tracks import Tracks

TIMES, COUNT, FOCAL = 16, 90, 300.0
K = np.tile([[FOCAL, 0, 160], [0, FOCAL, 100], [0, 0, 1.0]], (TIMES, 1, 1))
EYES = np.stack(
    [0.06 * np.arange(TIMES), 0.02 * np.sin(np.arange(TIMES)), 0 * np.arange(TIMES)], -1
)
# radians; in the direction that a flat start takes for its mirror image
SPIN = np.outer(np.arange(TIMES) * -0.1, [0.3, 1.0, 0.2])
ROTATIONS = Rotation.from_rotvec(SPIN).as_matrix()
POSITIONS = np.array([0.1, 0.0, 3.0]) + np.outer(np.arange(TIMES), [0.04, 0.01, 0.01])
LOCAL = np.random.default_rng(0).uniform(-0.4, 0.4, (COUNT, 3))
TRUE = np.einsum("tij,nj->nti", ROTATIONS, LOCAL) + POSITIONS  # (COUNT, TIMES, 3)


def cameras_at(eyes: np.ndarray) -> Cameras:
    """Cameras at `eyes` (TIMES, 3) that look along +z."""
    c2w = np.concatenate([np.tile(np.eye(3), (TIMES, 1, 1)), eyes[..., None]], 2)
    return Cameras(K, c2w, np.arange(float(TIMES)))


CAMERAS = cameras_at(EYES)


def pixels_of(points: np.ndarray, eyes: np.ndarray = EYES) -> np.ndarray:
    """The pixels (N, T, 2) of points (N, T, 3)."""
    local = points - eyes
    return local[..., :2] / local[..., 2:] * FOCAL + [160, 100]


def tracked(
    pixels: np.ndarray,
    far: float = 1.0,
    lasting: int = 10,
    trust: float = 0.5,
    positions: np.ndarray = POSITIONS,
    eyes: np.ndarray = EYES,
) -> Tracks:
    """Tracks of `lasting` times each, at one depth per time that has the `trust`.

    That depth is `far` times the depth of the body's `positions` (TIMES, 3).
    """
    first = np.random.default_rng(1).integers(0, TIMES - lasting + 1, len(pixels))[:, None]
    visible = (np.arange(TIMES) >= first) & (np.arange(TIMES) < first + lasting)
    depth = far * (positions - eyes)[:, 2:]
    offsets = (pixels - [160, 100]) / FOCAL * depth
    depths = np.broadcast_to(depth, (*pixels.shape[:2], 1))
    points = np.concatenate([offsets, depths], -1) + eyes
    hide = np.where(visible, 1.0, np.nan)[..., None]
    return Tracks(
        pixels * hide,
        points * hide,
        trust * visible,
        visible.astype(int),
        np.zeros(visible.shape, int),
        np.arange(float(TIMES)),
    )


def flat_problem() -> BundleProblem:
    """The problem of the body's tracks, of which depth knows one distance per time."""
    tracks = tracked(pixels_of(TRUE))
    group = path_without_rotation(tracks, fit_motion(tracks, np.arange(COUNT)))
    return BundleProblem(tracks, group, CAMERAS)


def true_state(problem: BundleProblem) -> BundleState:
    """The true points and poses, relative to the group's center as the eyes are."""
    return BundleState(LOCAL, ROTATIONS, POSITIONS - EYES + problem.eyes)


def relief_correlation(points: np.ndarray, which: slice | np.ndarray = slice(None)) -> np.ndarray:
    """Correlation (TIMES,) of the z-depth of points (N, TIMES, 3) with the true one."""
    return np.array(
        [np.corrcoef(points[which, t, 2], TRUE[which, t, 2])[0, 1] for t in range(TIMES)]
    )


def points_of_shape(shape: MoverShape) -> np.ndarray:
    """World points (N, TIMES, 3)."""
    group = shape.group
    rotated = np.einsum("tij,nj->nti", group.rotations, shape.points - group.center)
    return rotated + group.center + group.translations


def points_of_state(state: BundleState) -> np.ndarray:
    """Points (N, TIMES, 3) relative to the group's center."""
    return np.einsum("tij,nj->nti", state.rotations, state.points) + state.translations


def rotation_errors(rotations: np.ndarray) -> np.ndarray:
    """Degrees (TIMES - 1,) by which steps of `rotations` miss the true ones."""
    steps, true = (r[1:] @ np.swapaxes(r[:-1], 1, 2) for r in (rotations, ROTATIONS))
    return np.degrees(Rotation.from_matrix(steps @ np.swapaxes(true, 1, 2)).magnitude())
