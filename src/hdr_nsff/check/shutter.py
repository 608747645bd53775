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

from hdr_nsff.check.picture_motion import ACCELERATION, AFFINE, affine_motions
from hdr_nsff.priors.poses.matching import PairMatches


@dataclass(frozen=True)
class ShutterTuning:
    """When a readout counts as measured (hand-chosen on warped pictures)."""

    min_pairs: int = 15
    reweightings: int = AFFINE.reweightings
    outlier_scale: float = AFFINE.outlier_scale
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
    fits = affine_motions(following, size, portrait)
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
