"""How the picture as a whole moves from frame to frame, and how much it shakes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.priors.poses.matching import PairMatches

# change of the velocity between two frames, from five motions between frames around
# them: differences of fourth order of the positions
ACCELERATION = np.array([1, -8, 0, 8, -1]) / 12


@dataclass(frozen=True)
class AffineTuning:
    """How a motion is fitted to the matches of a pair (hand-chosen)."""

    min_points: int = 40  # matches of a pair
    min_pairs: int = 15  # of which the motion is known, to measure shake
    reweightings: int = 10
    outlier_scale: float = 2.0  # standard deviations: of the Cauchy weights


AFFINE = AffineTuning()
Motion = tuple[np.ndarray, np.ndarray]


def affine_motions(
    following: list[PairMatches],
    size: tuple[int, int],
    portrait: bool = False,
    tuning: AffineTuning = AFFINE,
) -> list[Motion | None]:
    """Of each pair of frames the motion (2,) px of the picture's center, its gradient
    (2, 2); None where too little matches.

    `following`: matches of each frame with the next, in pictures of `size` (height,
    width). Axes of a `portrait` change places.
    """
    height, width = size
    center = np.array([width, height]) / 2
    return [fit_affine(pair, center, portrait, tuning) for pair in following]


def measure_shake(
    motions: list[Motion | None], tuning: AffineTuning = AFFINE
) -> tuple[float, float] | None:
    """Shake and speed of the picture's center: its acceleration in px per frame squared
    (root mean square, robust) and its median velocity in px per frame.

    None where too few frames in a row match.
    """
    around = [motions[t - 2 : t + 3] for t in range(2, len(motions) - 2)]
    known = [[m[0] for m in five if m is not None] for five in around]
    centers = np.array([five for five in known if len(five) == 5])  # (N, 5, 2)
    if len(centers) < tuning.min_pairs:
        return None
    acceleration = np.einsum("k,nkc->nc", ACCELERATION, centers)
    # of a normal distribution, 1.4826 times the median is the root mean square
    shake = 1.4826 * np.linalg.norm(np.median(np.abs(acceleration), axis=0))
    return float(shake), float(np.median(np.linalg.norm(centers[:, 2], axis=1)))


def fit_affine(
    pair: PairMatches, center: np.ndarray, portrait: bool, tuning: AffineTuning
) -> tuple[np.ndarray, np.ndarray] | None:
    """The motion (2,) px of the picture's center in a pair of frames, and its gradient
    (2, 2), by robust least squares; None where too little matches.
    """
    if len(pair.p) < tuning.min_points:
        return None
    places, moved = pair.p - center, pair.q - pair.p
    if portrait:
        places, moved = places[:, ::-1], moved[:, ::-1]
    # centered between both frames, where motion has no part in the gradient
    places = places + moved / 2
    design = np.column_stack([places, np.ones(len(places))])
    weights = np.ones(len(places))
    solution = np.zeros((3, 2))
    for _ in range(tuning.reweightings):
        root = np.sqrt(weights)[:, None]
        solution = np.linalg.lstsq(design * root, moved * root, rcond=None)[0]
        residual = np.linalg.norm(moved - design @ solution, axis=1)
        scale = tuning.outlier_scale * max(float(np.median(residual)), 1e-3)
        weights = 1 / (1 + (residual / scale) ** 2)
    return solution[2], solution[:2].T
