"""How long a rolling shutter takes to read a frame, from the camera's own shake.

Row y of frame t is recorded at t + r (y / H - 1/2), with r the readout as a share of
the time between frames. What moves by d from one frame to the next then moves by
d + r (y / H - 1/2) a, with a the acceleration of the picture: steady motion shears all
frames alike, and only shake shows r. Every pair of frames gives a shear that no
rotation of the camera has, and a stretch that no zoom has. Both are regressed on the
acceleration, next to the velocity, which shears where depth grows with the row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.priors.poses.matching import PairMatches

# change of the velocity between two frames, from five motions between frames around
# them: differences of fourth order of the positions
ACCELERATION = np.array([1, -8, 0, 8, -1]) / 12


@dataclass(frozen=True)
class ShutterTuning:
    """When a readout counts as measured (hand-chosen on warped pictures)."""

    min_points: int = 40  # matches of a pair
    min_pairs: int = 15
    reweightings: int = 10
    outlier_scale: float = 2.0  # standard deviations: of the Cauchy weights
    max_error: float = 0.12  # standard error, share of a frame's time
    max_readout: float = 1.2  # no shutter takes longer than a frame's time


def measure_readout(
    following: list[PairMatches],
    size: tuple[int, int],
    portrait: bool = False,
    tuning: ShutterTuning = ShutterTuning(),
) -> tuple[float, float] | None:
    """The readout and its standard error, as shares of the time between frames; None
    where the camera's shake does not determine it.

    `following`: matches of each frame with the next, in pictures of `size` (height,
    width). The rows of a `portrait` are columns of the sensor, read in either order.
    """
    height, width = size
    length = width if portrait else height
    center = np.array([width, height]) / 2
    fits = [fit_affine(pair, center, portrait, tuning) for pair in following]
    rows, values = [], []
    for t in range(2, len(fits) - 2):
        around = [fit for fit in fits[t - 2 : t + 3] if fit is not None]
        if len(around) < 5:
            continue
        acceleration = ACCELERATION @ np.array([fit[0] for fit in around]) / length
        velocity = around[2][0] / length
        (xx, xy), (yx, yy) = around[2][1]
        rows.append([acceleration[0], velocity[0], 1, 0, 0])
        values.append(xy + yx)
        rows.append([acceleration[1], 0, 0, velocity[1], 1])
        values.append(yy - xx)
    if len(values) < 2 * tuning.min_pairs:
        return None
    readout, error = regress(np.array(rows), np.array(values), tuning)
    if portrait:
        readout = abs(readout)
    if error > tuning.max_error or not -2 * error <= readout <= tuning.max_readout:
        return None
    return max(readout, 0.0), error


def fit_affine(
    pair: PairMatches, center: np.ndarray, portrait: bool, tuning: ShutterTuning
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


def regress(design: np.ndarray, values: np.ndarray, tuning: ShutterTuning) -> tuple[float, float]:
    """The first coefficient of a robust regression of `values` (N,) on `design` (N, C),
    and its standard error.
    """
    weights = np.ones(len(values))
    for _ in range(tuning.reweightings):
        inverse = np.linalg.pinv(design.T @ (weights[:, None] * design))
        solution = inverse @ (design.T @ (weights * values))
        residual = values - design @ solution
        sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
        weights = 1 / (1 + (residual / (tuning.outlier_scale * sigma)) ** 2)
    # Cauchy weights leave about this much more variance than least squares
    error = sigma * float(np.sqrt(inverse[0, 0])) * 1.1
    return float(solution[0]), error
