"""The factor on all exposure steps that recordings leave open, from the steps that
people and cameras usually choose.

Where no exposure is known, recordings determine how the steps between exposures
compare, and their size only up to a common factor (Grossberg and Nayar 2003: E^p
explains them as well as E). A typical curve gives a first guess of it
(`debevec.typical_factor`), which is a few percent off for most cameras and 20 % for
contrasty ones. People and cameras bracket in whole stops, seldom in halves or thirds:
the most likely factor follows by Bayes' rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# share of neighboring exposures that are this many whole stops apart (hand-chosen from
# the brackets that cameras offer and that HDR data sets use)
WHOLE_STOPS = {1: 0.2, 2: 0.36, 3: 0.22, 4: 0.04, 5: 0.01, 6: 0.01, 7: 0.005, 8: 0.005}
# the same of each of 0.5, 1.5, .. 4.5 stops, and of each of 1/3, 2/3, .. 14/3 stops
HALF_STOP, THIRD_STOP = 0.02, 0.005
FACTORS = np.geomspace(0.65, 1.5, 841)  # candidates, 0.1 % apart


@dataclass(frozen=True)
class BracketingTuning:
    """How far off the measured steps may be.

    Hand-chosen on simulated cameras (gamma, sRGB, S-curve) and real video.
    """

    # the natural logarithm of the factor that a typical curve is off by
    mean_log_factor: float = -0.03
    log_factor_deviation: float = 0.1
    step_deviation_stops: float = 0.07  # of measured steps from proportional ones
    min_step_stops: float = 0.2  # smaller differences between exposures are no step


def likely_factor(
    ev: Sequence[float] | np.ndarray, tuning: BracketingTuning = BracketingTuning()
) -> float:
    """The factor that measured EVs (B,) most likely have to be multiplied by.

    The EVs are measured with a typical curve; the factor is about 1, and 1 where there
    is no step. Steps of [2.36, 2.35] stops are more likely two of 2 than anything else:
    0.85.
    """
    steps = np.diff(np.sort(np.asarray(ev, np.float64)))
    steps = steps[steps > tuning.min_step_stops]
    if not len(steps):
        return 1.0
    usual = usual_steps()
    sizes, log_prior = np.array(list(usual)), np.log(list(usual.values()))
    error = FACTORS[:, None, None] * steps[:, None] - sizes  # (factors, steps, sizes)
    log_chance = log_prior - (error / tuning.step_deviation_stops) ** 2 / 2
    deviation = (np.log(FACTORS) - tuning.mean_log_factor) / tuning.log_factor_deviation
    best = int(np.argmax(log_chance.max(-1).sum(-1) - deviation**2 / 2))
    intended = sizes[log_chance[best].argmax(-1)]
    return float(steps @ intended / (steps @ steps))


def usual_steps() -> dict[float, float]:
    """Stops between neighboring exposures, and how often they are chosen."""
    whole = {float(stops): share for stops, share in WHOLE_STOPS.items()}
    halves = {stops + 0.5: HALF_STOP for stops in range(5)}
    thirds = {k / 3: THIRD_STOP for k in range(1, 15) if k % 3}
    return whole | halves | thirds
