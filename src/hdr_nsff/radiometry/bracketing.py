"""The factor on all exposure steps that recordings leave open, how well it is known,
and when the steps are taken to be usual ones.

Where no exposure is known, recordings determine how the steps between exposures
compare, and their size only up to a common factor (Grossberg and Nayar 2003: E^p
explains them as well as E). Three sources narrow it down:

- Most cameras are about equally steep between the mid-tones and the highlights
  (`debevec.typical_factor`): good to 10 %.
- The noise of a raw sensor grows with the light in a known way (`sensor_noise.py`):
  good to 4 to 13 %, where footage still shows that noise.
- People and cameras bracket in whole stops, seldom in halves or thirds.

The third source decides only where it agrees with the other two: measured steps move to
usual ones inside their 95 % interval if these are likely enough against all others.
Halves and thirds are chosen only where the interval leaves no other one, and inside
80 % where the noise was measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

# share of neighboring exposures that are this many whole stops apart (hand-chosen from
# the brackets that cameras offer and that HDR data sets use)
WHOLE_STOPS = {1: 0.2, 2: 0.36, 3: 0.22, 4: 0.04, 5: 0.01, 6: 0.01, 7: 0.005, 8: 0.005}
# the same of each of 0.5, 1.5, .. 4.5 stops, and of each of 1/3, 2/3, .. 14/3 stops
HALF_STOP, THIRD_STOP = 0.02, 0.005
FACTORS = np.geomspace(0.5, 2.0, 1401)  # candidates, 0.1 % apart
INTERVAL = (0.025, 0.975)  # quantiles: a 95 % interval
# the same inside which steps move to halves and thirds where noise was measured
NARROW_INTERVAL = (0.1, 0.9)


@dataclass(frozen=True)
class BracketingTuning:
    """How far off measured steps may be, and how common unusual steps are.

    The typical curve was compared with EXIF and nominal exposures: five still cameras
    need factors of 0.83 to 0.95, a video camera 0.99 to 1.11 (nine clips), gamma 2.2
    and sRGB 1.0, a contrasty film curve 0.81. A log curve needs 1.5.
    """

    # of the natural logarithm of the factor that a typical curve is off by
    mean_log_factor: float = -0.06
    log_factor_deviation: float = 0.1
    # the same of two exposures, which leave more of the curve open: one film curve
    # needs 0.73 to 0.85 on six clips (0.80 to 0.82 with three exposures)
    one_step_log_factor_deviation: float = 0.15
    odd_curve_share: float = 0.05  # of cameras whose curve is nothing like typical ones
    odd_log_factor_deviation: float = 0.35
    # stops: error of a measured step that more points do not reduce (still cameras)
    min_step_deviation: float = 0.04
    min_step_stops: float = 0.2  # smaller differences between exposures are no step
    # steps that are neither whole stops nor halves or thirds (hand-chosen): their
    # share, and the range that they come from
    unusual_share: float = 0.05
    unusual_range_stops: float = 4.0
    # of usual steps against all others, from which measured steps are moved to them
    min_chance: float = 0.4
    max_deviations: float = 2.0  # of a measured step from the usual one that it becomes

    def without_mid_tones(self) -> BracketingTuning:
        """The same where no point shows the curve's mid-tones: any curve may be odd."""
        odd = self.odd_log_factor_deviation
        return replace(self, log_factor_deviation=odd, one_step_log_factor_deviation=odd)


@dataclass(frozen=True)
class StepScale:
    """The common factor on measured EVs, and what is known of it."""

    factor: float  # to multiply measured EVs by
    measured: float  # the same without the knowledge of usual steps
    low: float  # of a 95 % interval without the knowledge of usual steps
    high: float

    @property
    def is_moved(self) -> bool:
        """Whether the steps were moved to usual ones."""
        return self.factor != self.measured


def likely_scale(
    ev: Sequence[float] | np.ndarray,
    deviations: Sequence[float] | np.ndarray | None = None,
    noise_log_likelihood: np.ndarray | None = None,
    tuning: BracketingTuning = BracketingTuning(),
) -> StepScale:
    """The factor that measured EVs (B,) most likely have to be multiplied by.

    The EVs are measured with a typical curve. `deviations` (B,) are the standard
    deviations of each, in stops, from points; `noise_log_likelihood` is that of each of
    `FACTORS`, from the noise of the sensor. Without a step the factor is 1.
    """
    order = np.argsort(ev)
    steps = np.diff(np.asarray(ev, np.float64)[order])
    variance = np.zeros(len(order))
    if deviations is not None:
        variance = np.asarray(deviations, np.float64)[order] ** 2
    step_deviations = np.sqrt(tuning.min_step_deviation**2 + variance[1:] + variance[:-1])
    is_step = steps > tuning.min_step_stops
    steps, step_deviations = steps[is_step], step_deviations[is_step]
    if not len(steps):
        return StepScale(1.0, 1.0, 1.0, 1.0)
    uncertain = tuning
    if len(steps) == 1:
        uncertain = replace(tuning, log_factor_deviation=tuning.one_step_log_factor_deviation)
    scale = measured_scale(noise_log_likelihood, uncertain)
    if noise_log_likelihood is not None:  # else no step moves farther than typical curves vary
        tuning = uncertain
    log_evidence = log_evidence_of_factor(noise_log_likelihood, tuning)
    evidence = np.exp(log_evidence)
    intended = usual_assignment(steps, step_deviations, log_evidence, tuning)
    if intended is not None:
        wide = noise_log_likelihood is None or are_whole(intended).all()
        limits = INTERVAL if wide else NARROW_INTERVAL
        lowest, highest = np.interp(limits, np.cumsum(evidence), FACTORS).tolist()
        factor = float(steps @ intended / (steps @ steps))
        off = np.abs(factor * steps - intended) / step_deviations
        agrees = lowest <= factor <= highest and off.max() <= tuning.max_deviations
        if agrees and are_distinct(intended, scale.low * steps, scale.high * steps):
            return replace(scale, factor=factor)
    return scale


def measured_scale(
    noise_log_likelihood: np.ndarray | None = None, tuning: BracketingTuning = BracketingTuning()
) -> StepScale:
    """The factor without any knowledge of usual steps, where there are none."""
    evidence = np.exp(log_evidence_of_factor(noise_log_likelihood, tuning))
    measured = float(np.exp(evidence @ np.log(FACTORS)))
    low, high = np.interp(INTERVAL, np.cumsum(evidence), FACTORS).tolist()
    return StepScale(measured, measured, low, high)


def log_evidence_of_factor(
    noise_log_likelihood: np.ndarray | None, tuning: BracketingTuning = BracketingTuning()
) -> np.ndarray:
    """The logarithm of the chance of each of `FACTORS`, from curves and noise."""
    log_evidence = curve_log_prior(tuning)
    if noise_log_likelihood is not None:
        log_evidence = log_evidence + noise_log_likelihood
    return log_evidence - logsumexp(log_evidence)


def are_distinct(intended: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether each intended step (S,) is of whole stops, or the only usual one between
    `low` and `high` (S,).

    Halves and thirds lie too close together for a wide interval to choose one.
    """
    sizes = np.array(list(usual_steps()))
    num_inside = ((sizes >= low[:, None]) & (sizes <= high[:, None])).sum(-1)
    return bool((are_whole(intended) | (num_inside == 1)).all())


def are_whole(steps: np.ndarray) -> np.ndarray:
    """Which of the `steps` (S,) are of whole stops."""
    return steps % 1 == 0


def curve_log_prior(tuning: BracketingTuning = BracketingTuning()) -> np.ndarray:
    """The logarithm of the chance of each of `FACTORS`, from typical curves, up to a
    constant.
    """
    log_factors = np.log(FACTORS)
    typical = log_normal(
        log_factors - tuning.mean_log_factor, np.array(tuning.log_factor_deviation)
    )
    odd = log_normal(log_factors, np.array(tuning.odd_log_factor_deviation))
    shares = np.log([1 - tuning.odd_curve_share, tuning.odd_curve_share])
    return logsumexp(np.stack([typical, odd], -1) + shares, axis=-1)


def usual_assignment(
    steps: np.ndarray,
    deviations: np.ndarray,
    log_evidence: np.ndarray,
    tuning: BracketingTuning = BracketingTuning(),
) -> np.ndarray | None:
    """The usual steps (S,) that measured `steps` (S,) with standard `deviations` (S,)
    stand for, by Bayes' rule; None where no such set is likely enough against all
    others and unusual steps.

    `log_evidence` is the logarithm of the chance of each of `FACTORS`.
    """
    usual = usual_steps()
    sizes, log_share = np.array(list(usual)), np.log(list(usual.values()))
    error = FACTORS[:, None, None] * steps[:, None] - sizes  # (factors, steps, sizes)
    log_chance = log_share + log_normal(error, deviations[:, None])
    chosen = np.unique(log_chance.argmax(-1), axis=0)  # (candidates, steps)
    log_shares = [log_evidence_of_unusual(steps, deviations, log_evidence, tuning)]
    for candidate in chosen:
        error = FACTORS[:, None] * steps - sizes[candidate]
        log_likelihood = log_evidence + log_normal(error, deviations).sum(-1)
        # equal steps are one choice of a photographer, not several
        log_prior = log_share[np.unique(candidate)].sum()
        log_shares.append(float(logsumexp(log_likelihood) + log_prior))
    log_chances = np.array(log_shares) - logsumexp(log_shares)
    best = int(np.argmax(log_chances[1:]))
    if np.exp(log_chances[1 + best]) < tuning.min_chance:
        return None
    return sizes[chosen[best]]


def log_evidence_of_unusual(
    steps: np.ndarray,
    deviations: np.ndarray,
    log_evidence: np.ndarray,
    tuning: BracketingTuning = BracketingTuning(),
) -> float:
    """The logarithm of the joint chance of unusual steps and of measuring `steps` (S,).

    Unusual steps are spread evenly over a range, and equal to each other or not.
    """
    log_density = -np.log(tuning.unusual_range_stops)
    different = len(steps) * log_density
    scaled = FACTORS[:, None] * steps
    weight = 1 / deviations**2
    common = (scaled @ weight / weight.sum())[:, None]
    log_likelihood = log_normal(scaled - common, deviations).sum(-1)
    width = 0.5 * np.log(2 * np.pi / weight.sum())  # of the common step, integrated over
    equal = log_density + width + logsumexp(log_evidence + log_likelihood)
    return float(np.log(tuning.unusual_share) + max(different, equal))


def log_normal(error: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """The logarithm of the normal density of an error."""
    return -((error / deviation) ** 2) / 2 - np.log(np.sqrt(2 * np.pi) * deviation)


def usual_steps() -> dict[float, float]:
    """Stops between neighboring exposures, and how often they are chosen."""
    whole = {float(stops): share for stops, share in WHOLE_STOPS.items()}
    halves = {stops + 0.5: HALF_STOP for stops in range(5)}
    thirds = {k / 3: THIRD_STOP for k in range(1, 15) if k % 3}
    return whole | halves | thirds
