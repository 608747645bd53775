"""The camera's response from static points seen in several exposures (Debevec and Malik
1997), before anything is trained.

Unknown is G, the log exposure of a recorded value (`log_curve.py`). The paper keeps G
itself smooth. We keep its part H smooth: the darks then fall back on a gamma curve, not
on a straight line. Every channel has its own G, the exposures are common. One linear
least squares problem is solved and reweighted a few times, against points that moved,
were hidden or fell into shadow.

With no exposure known, the recordings determine G and the log exposures only up to one
common factor: E^p explains them as well as E (Grossberg and Nayar 2003). That factor is
first chosen so that the curves are, on average, as steep as sRGB between the mid-tones
and the highlights. There cameras differ least: by 10 %, where over all mid-tones they
differ by 15 %. `bracketing.py` says how well the factor is known, and when the steps
are taken to be usual ones. The proportions of the steps are measured.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hdr_nsff.maths.color import srgb_decode
from hdr_nsff.radiometry.bracketing import BracketingTuning, StepScale, likely_scale
from hdr_nsff.radiometry.log_curve import (
    GAMMA,
    LN2,
    NODES,
    TYPICAL,
    UNKNOWNS,
    basis,
    response_of,
)
from hdr_nsff.radiometry.samples import Samples
from hdr_nsff.radiometry.saturation import SaturationTuning, own_tops, saturation

LEFT_OUT = 1e-6  # robust weight of a point that is far off: it may come back
MAD_TO_SIGMA = 1.48  # standard deviation of a normal distribution per median |deviation|
# stops: with a larger misfit the points are not the same points (hand-chosen on
# recorded clips)
MAX_MISFIT = 0.35


@dataclass(frozen=True)
class DebevecTuning:
    """Weights of the least squares, and what counts as enough evidence.

    Hand-chosen on simulated cameras (gamma, sRGB, S-curve; 8 bits, sensor noise, 10 %
    outliers) if no other origin is given.
    """

    iterations: int = 8  # of reweighting
    # recorded value below white over which the weight falls to 0: shoulders are flat
    shoulder_width: float = 0.1
    # weight of H's squared second differences: a floor, and per unit of data weight;
    # both times the variance of the points
    min_smoothness: float = 3e4
    smoothness: float = 300.0
    prior_weight: float = 30.0  # that pulls a and b to `TYPICAL`, times the same variance
    outlier_scale: float = 2.4  # standard deviations: of the Cauchy weights (Holland 1977)
    # a point whose misfit exceeds both is left out: video does not record light of a
    # strong color that clips as 1, and it would pass for a shoulder of several stops
    max_misfit: float = 0.5  # stops
    max_scales: float = 3.0  # of `outlier_scale`
    # points that two brackets must share to be linked
    min_shared_points: int = 60
    # recorded values over which the mean curve gets the steepness of sRGB (chosen on
    # still cameras with EXIF and on a video camera)
    mid_tones: tuple[float, float] = (0.4, 0.8)
    # share of linked values inside `mid_tones` from which the curve is known there: on
    # real clips, steps were off by factors of 2.1 and 0.8 with 0.001 and 0.04 of them,
    # and right with 0.08 and more
    min_mid_tones: float = 0.05
    saturation: SaturationTuning = field(default_factory=SaturationTuning)
    bracketing: BracketingTuning = field(default_factory=BracketingTuning)


@dataclass(frozen=True)
class ResponseFit:
    """A response curve and the exposures of the brackets."""

    x: np.ndarray  # (256,) exposure in [0, 1], even in x^(1/2.2)
    y: np.ndarray  # (3, 256) recorded value, rising from 0 to 1
    ev: np.ndarray  # (B,) log2 exposure, 0 at the reference bracket
    misfit: float  # median absolute misfit of a point's exposure, in stops
    # no exposure was known: the common factor of all of `ev` is the most likely one
    guessed: bool
    scale: StepScale | None = None  # what is known of that factor, where it is guessed


# Curves (3, K) over x (K,) and EVs (B,) -> log likelihood of every factor on the EVs
# (`bracketing.FACTORS`); None where nothing follows.
ScaleEvidence = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray | None]


@dataclass(frozen=True)
class Equations:
    """One channel's linear equations `design @ [H, a, b, log exposures] = target`, the
    points' own radiance eliminated by centering.
    """

    design: np.ndarray  # (P, B, unknowns)
    target: np.ndarray  # (P, B)
    # (P, B) inverse variance of an observation up to a factor, 0 where it is not valid
    weight: np.ndarray
    robust: np.ndarray  # (P, B) in (0, 1]: 1 / (1 + (residual / scale)^2), or `LEFT_OUT`

    def centered(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights (P, B), and design and target minus their weighted mean over every
        point's observations.
        """
        weight = self.weight * self.robust
        total = np.maximum(weight.sum(1, keepdims=True), 1e-12)
        mean_design = (weight[..., None] * self.design).sum(1, keepdims=True) / total[..., None]
        mean_target = (weight * self.target).sum(1, keepdims=True) / total
        return weight, self.design - mean_design, self.target - mean_target

    def residuals(self, solution: np.ndarray) -> np.ndarray:
        """Misfit (P, B) of log exposure; 0 where nothing was observed."""
        _, design, target = self.centered()
        return np.where(self.weight > 0, target - design @ solution, 0.0)


def debevec(
    samples: Samples,
    ev: Sequence[float | None],
    reference: int,
    tuning: DebevecTuning = DebevecTuning(),
    evidence: ScaleEvidence | None = None,
) -> ResponseFit:
    """Response and exposures from `samples`.

    `ev` (B,) holds the known log2 exposures, None for those to be estimated; bracket
    `reference` is 0 if unknown. Every bracket must share points with the others, see
    `brackets_linked`. Where no exposure is known, `evidence` may narrow down the common
    factor of all.
    """
    assert samples.valid.shape == samples.rgb.shape, (samples.valid.shape, samples.rgb.shape)
    assert samples.rgb.shape[1] == len(ev), (samples.rgb.shape, len(ev))
    log_exposure = np.array([0.0 if e is None else LN2 * e for e in ev])
    free = [b for b, e in enumerate(ev) if e is None and b != reference]
    guessed = len(free) > 0 and len(free) == len(ev) - 1
    if guessed:  # nothing but the reference is known: hold one bracket to fix the unit
        pivot = max(free, key=lambda b: num_shared_values(samples, b, reference))
        log_exposure[pivot] = LN2 * brightness_ratio(samples, pivot, reference)
        free.remove(pivot)
    equations = [
        channel_equations(samples.rgb[..., c], samples.valid[..., c], log_exposure, free, tuning)
        for c in range(3)
    ]
    if samples.offset is not None:
        equations = [replace(e, target=e.target + LN2 * samples.offset) for e in equations]
    log_exposure[free] = [LN2 * brightness_ratio(samples, b, reference) for b in free]
    curves = np.zeros((3, UNKNOWNS))
    curves[:, -2:] = TYPICAL  # a typical camera reveals the worst outliers
    equations, noise = reweight(equations, curves, log_exposure[free], tuning)
    for _ in range(tuning.iterations):
        curves, log_exposure[free] = solve(equations, noise, len(free), tuning)
        equations, noise = reweight(equations, curves, log_exposure[free], tuning)
    factor, scale = 1.0, None
    top = saturation(samples, curves, log_exposure, tuning.saturation)
    if guessed:
        factor = typical_factor(curves, tuning)
        noise_log_likelihood = None
        if evidence is not None:
            own = own_tops(curves, top)
            x, y = response_of(curves * factor, own.scaled(factor))
            noise_log_likelihood = evidence(x, y, log_exposure * factor / LN2)
        residuals = all_residuals(equations, curves, log_exposure[free])
        deviations = exposure_deviations(equations, residuals, samples.frame)
        bracketing = tuning.bracketing
        if not shows_mid_tones(samples, tuning):
            bracketing = bracketing.without_mid_tones()
        scale = likely_scale(
            log_exposure * factor / LN2,
            deviations * factor / LN2,
            noise_log_likelihood,
            bracketing,
        )
        factor *= scale.factor
    x, y = response_of(curves * factor, top.scaled(factor))
    misfit = median_misfit(equations, curves, log_exposure[free]) * factor / LN2
    return ResponseFit(x, y, log_exposure * factor / LN2, misfit, guessed, scale)


def shows_mid_tones(samples: Samples, tuning: DebevecTuning = DebevecTuning()) -> bool:
    """Whether enough values that two brackets recorded lie in the mid-tones, where the
    curve's steepness gives the common factor of all exposures.
    """
    linked = samples.valid & (samples.valid.sum(1, keepdims=True) >= 2)
    values = samples.rgb[linked]
    low, high = tuning.mid_tones
    inside = (values > low) & (values < high)
    return bool(inside.sum() > tuning.min_mid_tones * len(values))


def num_shared_values(samples: Samples, bracket: int, other: int) -> int:
    """How many values two brackets both recorded."""
    return int((samples.valid[:, bracket] & samples.valid[:, other]).sum())


def channel_equations(
    z: np.ndarray,
    valid: np.ndarray,
    log_exposure: np.ndarray,
    free: list[int],
    tuning: DebevecTuning = DebevecTuning(),
) -> Equations:
    """The equations G(z) - ln E - log exposure = 0 of one channel.

    `z`, `valid` (P, B); the `log_exposure` (B,) of the brackets in `free` is unknown.
    An observation weighs z^2, since ln z is as uncertain as 1 / z, and less towards
    white, where shoulders are flat.
    """
    num_brackets = z.shape[1]
    design = np.zeros((*z.shape, UNKNOWNS + len(free)))
    design[..., :UNKNOWNS] = basis(z)
    for k, b in enumerate(free):
        design[:, b, UNKNOWNS + k] = -1
    is_free = np.isin(np.arange(num_brackets), free)
    target = np.broadcast_to(np.where(is_free, 0.0, log_exposure), z.shape)
    seen_twice = valid & (valid.sum(1, keepdims=True) >= 2)
    weight = z**2 * np.clip((1 - z) / tuning.shoulder_width, 0, 1)
    weight = np.where(seen_twice, weight, 0.0)
    return Equations(design, target, weight, np.ones_like(weight))


def solve(
    equations: list[Equations],
    noise: float,
    num_free: int,
    tuning: DebevecTuning = DebevecTuning(),
) -> tuple[np.ndarray, np.ndarray]:
    """Curves (3, 42) and unknown log exposures (num_free,) that fit the equations.

    H is held smooth the more firmly, the noisier the points are (`noise`: standard
    deviation of a misfit of weight 1). Points are noisy on both sides of an equation,
    and no number of points averages that away.
    """
    size = 3 * UNKNOWNS + num_free
    matrix, right = np.zeros((size, size)), np.zeros(size)
    second_difference = np.diff(np.eye(NODES), 2, axis=0)
    curvature = np.einsum("ki,kj->ij", second_difference, second_difference)
    exposures = np.arange(3 * UNKNOWNS, size)
    for c, channel in enumerate(equations):
        weight, design, target = channel.centered()
        first = c * UNKNOWNS
        columns = np.concatenate([np.arange(first, first + UNKNOWNS), exposures])
        weighted = (weight[..., None] * design).reshape(-1, len(columns))
        matrix[np.ix_(columns, columns)] += weighted.T @ design.reshape(-1, len(columns))
        right[columns] += weighted.T @ target.reshape(-1)
        nodes = np.arange(first, first + NODES)
        smoothness = tuning.min_smoothness + tuning.smoothness * weight.sum()
        matrix[np.ix_(nodes, nodes)] += smoothness * noise**2 * curvature
        # H's mean is the unit of E, which is free: any value will do
        matrix[columns, columns] += 1e-6 + 1e-9 * weight.sum()
        gammas = [first + NODES, first + NODES + 1]  # a and b
        matrix[gammas, gammas] += tuning.prior_weight * noise**2
        right[gammas] += np.array(TYPICAL) * tuning.prior_weight * noise**2
    solution = np.linalg.solve(matrix, right)
    return solution[: 3 * UNKNOWNS].reshape(3, UNKNOWNS), solution[3 * UNKNOWNS :]


def all_residuals(
    equations: list[Equations], curves: np.ndarray, log_exposure: np.ndarray
) -> list[np.ndarray]:
    """Every channel's misfit (P, B)."""
    return [e.residuals(np.concatenate([curves[c], log_exposure])) for c, e in enumerate(equations)]


def median_misfit(
    equations: list[Equations], curves: np.ndarray, log_exposure: np.ndarray
) -> float:
    """Median absolute misfit of log exposure over all channels; 0 without points."""
    residuals = all_residuals(equations, curves, log_exposure)
    observed = np.concatenate([np.abs(r[r != 0]) for r in residuals])
    return float(np.median(observed)) if observed.size else 0.0


def exposure_deviations(
    equations: list[Equations], residuals: list[np.ndarray], frame: np.ndarray | None
) -> np.ndarray:
    """The standard deviation (B,) of every log exposure, from the spread between the
    points of single frames; 0 where it is unknown from which `frame` (P,) a point is.
    """
    num_brackets = equations[0].weight.shape[1]
    if frame is None or len(np.unique(frame)) < 2:
        return np.zeros(num_brackets)
    weight = np.stack([e.weight * e.robust for e in equations])  # (3, P, B)
    weighted = weight * np.stack(residuals)
    offsets = []
    for f in np.unique(frame):
        total = np.maximum(weight[:, frame == f].sum((0, 1)), 1e-12)
        # an offset between two exposures shows by half in the residuals of each
        offsets.append(2 * weighted[:, frame == f].sum((0, 1)) / total)
    return np.std(offsets, axis=0) / np.sqrt(len(offsets))


def reweight(
    equations: list[Equations],
    curves: np.ndarray,
    log_exposure: np.ndarray,
    tuning: DebevecTuning = DebevecTuning(),
) -> tuple[list[Equations], float]:
    """The equations with Cauchy weights from their misfits, without points that are far
    off, and the robust standard deviation of a misfit of weight 1.
    """
    residuals = all_residuals(equations, curves, log_exposure)
    scaled = [r * np.sqrt(e.weight) for e, r in zip(equations, residuals, strict=True)]
    observed = np.concatenate([s[s != 0] for s in scaled])
    noise = 0.05
    if observed.size:
        noise = MAD_TO_SIGMA * float(np.median(np.abs(observed))) + 1e-6
    scale = tuning.outlier_scale * noise
    reweighted = []
    for e, r, s in zip(equations, residuals, scaled, strict=True):
        far = (np.abs(r) > tuning.max_misfit * LN2) & (np.abs(s) > tuning.max_scales * scale)
        robust = np.where(far.any(1, keepdims=True), LEFT_OUT, 1 / (1 + (s / scale) ** 2))
        reweighted.append(replace(e, robust=robust))
    return reweighted, noise


def typical_factor(curves: np.ndarray, tuning: DebevecTuning = DebevecTuning()) -> float:
    """The factor on G that makes the mean of the curves (3, 42) as steep as sRGB over
    `mid_tones`, by least squares.
    """
    z = np.linspace(*tuning.mid_tones, 161)
    mean_curve = (basis(z) @ curves.T).mean(-1)
    srgb = np.log(srgb_decode(z))
    mean_curve, srgb = mean_curve - mean_curve.mean(), srgb - srgb.mean()
    return float(mean_curve @ srgb / (mean_curve @ mean_curve))


def brackets_linked(
    samples: Samples, brackets: Collection[int], tuning: DebevecTuning = DebevecTuning()
) -> bool:
    """Whether all of `brackets` are linked to each other, directly or through others,
    by at least `min_shared_points` points per link.
    """
    seen = samples.valid.all(-1).astype(np.float64)  # (P, B)
    shared = np.einsum("pi,pj->ij", seen, seen) >= tuning.min_shared_points
    reached = np.arange(len(shared)) == min(brackets)
    for _ in brackets:
        reached = reached | (shared & reached).any(1)
    return bool(reached[list(brackets)].all())


def brightness_ratio(samples: Samples, bracket: int, reference: int) -> float:
    """EV of `bracket` against `reference`: median log2 ratio of the values both record,
    through gamma 2.2; 0 where they share none.
    """
    both = samples.valid[:, bracket] & samples.valid[:, reference]
    ratio = np.log2(samples.rgb[:, bracket][both] / samples.rgb[:, reference][both])
    return GAMMA * float(np.median(ratio)) if ratio.size else 0.0
