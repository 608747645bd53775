"""How far apart exposures are put when they alternate: what settles the factor that
recordings leave open.

Where no exposure is known, recordings tell how the steps between exposures compare, and
their size only up to a common factor (Grossberg and Nayar 2003: E^p explains them as
well as E). A typical curve gives a first guess of it (`response.typical_factor`), which
is a few per cent off for most cameras and 20 % for contrasty ones. People and cameras
bracket in whole stops, seldom in halves or thirds: the most likely factor by Bayes'
rule.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

USUAL = {
    1: 0.2,
    2: 0.36,
    3: 0.22,
    4: 0.04,
    5: 0.01,
    6: 0.01,
    7: 0.005,
    8: 0.005,
}  # whole stops and how often
HALVES, THIRDS = 0.02, 0.005  # how often a step is 0.5, 1.5, .. 4.5, and 1/3, 2/3, 4/3, .. 14/3
FACTOR = (
    -0.03,
    0.1,
)  # mean and standard deviation of the log of the factor that a typical curve is wrong by
TOLERANCE = 0.07  # stops: by how much measured steps differ from proportional ones
SMALLEST = 0.2  # stops: a smaller step is none


def likely_factor(ev: Sequence[float] | np.ndarray) -> float:
    """The factor that EVs (B,), measured with a typical curve, most likely have to be
    multiplied by; within [0.65, 1.5].

    Steps of [2.36, 2.35] stops are likelier two of 2 than anything else: 0.85. 1 where
    there is no step.
    """
    steps = np.diff(np.sort(np.asarray(ev, np.float64)))
    steps = steps[steps > SMALLEST]
    if not len(steps):
        return 1.0
    usual = usual_steps()
    sizes, chances = np.array(list(usual)), np.log(list(usual.values()))
    factors = np.geomspace(0.65, 1.5, 841)  # 0.1 % apart
    off = factors[:, None, None] * steps[:, None] - sizes  # (F, steps, sizes)
    chance = chances - (off / TOLERANCE) ** 2 / 2
    mean, deviation = FACTOR
    best = int(np.argmax(chance.max(-1).sum(-1) - ((np.log(factors) - mean) / deviation) ** 2 / 2))
    meant = sizes[chance[best].argmax(-1)]
    return float(steps @ meant / (steps @ steps))


def usual_steps() -> dict[float, float]:
    """Stops between neighboring exposures and how often they are chosen."""
    odd = [k / 3 for k in range(1, 15) if k % 3]
    return (
        {float(k): p for k, p in USUAL.items()}
        | {k + 0.5: HALVES for k in range(5)}
        | dict.fromkeys(odd, THIRDS)
    )
