"""The exposure of every single frame, from static points: auto exposure, which follows
no cycle.

A static point p that frames t recorded as z gives ln E_p + e_t = G(z) per channel, with
G the log exposure of a recorded value (`debevec.py`). The log exposures e_t of all
frames are one robust linear least squares problem, the points' own radiance eliminated.
They are smooth in time only as far as no point says otherwise. Where exposures drift,
they determine the curve in turn: both are fitted in turns, from gamma 2.2 on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_matrix, identity
from scipy.sparse.linalg import spsolve

from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import LazyList
from hdr_nsff.geometry import pinhole
from hdr_nsff.maths.color import srgb_decode
from hdr_nsff.radiometry.debevec import MAD_TO_SIGMA, DebevecTuning, debevec
from hdr_nsff.radiometry.samples import Samples, empty_samples, joined
from hdr_nsff.radiometry.static_samples import (
    KEPT_PATCHES,
    ResponseView,
    StaticSamplesTuning,
    enter_readings,
    spread_over_levels,
    view_patches,
    visible_points,
)

SHOULDER_WIDTH = 0.1  # recorded value below white over which readings lose weight


@dataclass(frozen=True)
class FrameExposuresTuning:
    """How the exposures of single frames are estimated (hand-chosen on a re-exposed
    clip with 3 stops of drift).
    """

    num_samples: int = 6000  # static points
    # frames from that of a point to those it is read in
    reach: tuple[int, ...] = (-24, -12, -6, -3, -2, -1, 1, 2, 3, 6, 12, 24)
    rounds: int = 8  # of reweighting
    outlier_scale: float = 2.0  # standard deviations: of the Cauchy weights
    smoothness: float = 1e-3  # of second differences, share of the weight of a frame
    curve_rounds: int = 5  # of exposures and curve in turns
    min_readings: int = 30  # of a frame, for an exposure of its own
    # share of the frames of every bracket that need so many: the exposures of others,
    # nearly black or white, are smooth in time
    min_determined: float = 0.5
    # stops: drift of less than this (95 % of the frames) is none
    min_drift: float = 0.15
    # of the drift's root mean square: by how much a frame may differ from the ones
    # before and after it, of other brackets
    max_disagreement: float = 0.5


@dataclass(frozen=True)
class Readings:
    """Static points with what frames recorded of them."""

    samples: Samples  # (P, K, 3): one slot per frame that a point is read in
    frame: np.ndarray  # (P, K) position of that frame
    place: np.ndarray  # (P, 2) x, y in the frame that it is of, in [0, 1]


def read_points(
    views: Sequence[ResponseView],
    rng: np.random.Generator,
    tuning: FrameExposuresTuning = FrameExposuresTuning(),
    points: StaticSamplesTuning | None = None,
) -> Readings:
    """Static points of all `views`, in order of time, read in their neighbors."""
    points = points or StaticSamplesTuning()
    patches = LazyList(lambda k: view_patches(views[k], points), len(views), KEPT_PATCHES)
    per_view = max(1, tuning.num_samples // len(views))
    parts, frames, places = [], [], []
    for source, view in enumerate(track(views, "response: exposures", len(views))):
        pixels = spread_over_levels(view.image, patches[source].good, per_view, rng, points)
        depth = 1 / np.maximum(view.disparity[pixels[:, 1], pixels[:, 0]], 1e-9)
        world = pinhole.unproject(pixels + 0.5, depth, view.K, view.c2w)
        others = [source, *(source + k for k in tuning.reach)]
        samples = empty_samples(len(world), len(others), source)
        for slot, other in enumerate(others):
            if 0 <= other < len(views):
                seen = visible_points(views[other], patches[other], world, points)
                enter_readings(samples, slot, patches[other], *seen)
        parts.append(samples)
        frames.append(np.tile(np.clip(others, 0, len(views) - 1), (len(world), 1)))
        height, width = view.image.shape[:2]
        places.append((pixels + 0.5) / [width, height])
    return Readings(
        joined(parts, 1 + len(tuning.reach)),
        np.concatenate(frames),
        np.concatenate(places),
    )


def determined_frames(
    readings: Readings, num_frames: int, tuning: FrameExposuresTuning = FrameExposuresTuning()
) -> np.ndarray:
    """Which frames (T,) share enough points with others."""
    valid = readings.samples.valid.all(-1)
    valid = valid & (valid.sum(1, keepdims=True) >= 2)
    counts = np.bincount(readings.frame[valid], minlength=num_frames)
    return counts >= tuning.min_readings


def are_determined(
    readings: Readings,
    brackets: np.ndarray,
    tuning: FrameExposuresTuning = FrameExposuresTuning(),
) -> bool:
    """Whether enough frames of each of the `brackets` (T,) share points with others."""
    enough = determined_frames(readings, len(brackets), tuning)
    return all(enough[brackets == b].mean() >= tuning.min_determined for b in np.unique(brackets))


def frame_log_exposures(
    readings: Readings,
    x: np.ndarray,
    y: np.ndarray,
    brackets: np.ndarray,
    tuning: FrameExposuresTuning = FrameExposuresTuning(),
) -> np.ndarray:
    """The log2 exposure (T,) of every frame, mean 0, through the curves `y` (3, K) over
    `x` (K,). `brackets` (T,): exposures of one bracket are smooth in time.
    """
    z, valid = readings.samples.rgb, readings.samples.valid
    log_exposure = np.stack(
        [np.log2(np.maximum(np.interp(z[..., c], y[c], x), 1e-9)) for c in range(3)], -1
    )
    weight = np.where(valid, z**2 * np.clip((1 - z) / SHOULDER_WIDTH, 0, 1), 0.0)
    weight = np.where((weight > 0).sum(1, keepdims=True) >= 2, weight, 0.0)
    differences = second_differences(brackets)
    roughness = differences.T @ differences
    exposures, robust = np.zeros(len(brackets)), np.ones_like(weight)
    for _ in range(tuning.rounds):
        weights = weight * robust
        matrix, right = normal_equations(weights, log_exposure, readings.frame, len(brackets))
        scale = max(float(np.median(matrix.diagonal())), 1e-9)
        matrix = matrix + tuning.smoothness * scale * roughness
        # the mean is left open by all but this, and set to 0
        matrix = matrix + 1e-9 * scale * identity(len(brackets))
        exposures = spsolve(csc_matrix(matrix), right)
        exposures = exposures - exposures.mean()
        at_one = log_exposure - exposures[readings.frame][..., None]
        total = np.maximum(weights.sum(1, keepdims=True), 1e-12)
        radiance = (weights * at_one).sum(1, keepdims=True) / total
        residual = np.where(weight > 0, at_one - radiance, 0.0) * np.sqrt(weight)
        observed = np.abs(residual[weight > 0])
        noise = MAD_TO_SIGMA * float(np.median(observed)) + 1e-6 if observed.size else 1.0
        robust = 1 / (1 + (residual / (tuning.outlier_scale * noise)) ** 2)
    return exposures


def normal_equations(
    weights: np.ndarray, log_exposure: np.ndarray, frame: np.ndarray, num_frames: int
) -> tuple[csc_matrix, np.ndarray]:
    """The normal equations (T, T), (T,) of the frames' log exposures, the points' own
    radiance eliminated. Only frames that share a point are linked.

    `weights` and `log_exposure` (P, K, 3) of readings in `frame` (P, K).
    """
    total = np.maximum(weights.sum(1, keepdims=True), 1e-12)
    mean = (weights * log_exposure).sum(1, keepdims=True) / total
    target = (weights * (log_exposure - mean)).sum(-1)
    right = np.bincount(frame.ravel(), target.ravel(), num_frames)
    reach = int((frame.max(1) - frame.min(1)).max(initial=0))
    width = 2 * reach + 1
    band = np.zeros(num_frames * width)  # (T, width): row t holds columns t - reach on
    share = weights / np.sqrt(total)
    for a in range(frame.shape[1]):
        cells = frame[:, a, None] * width + frame - frame[:, a, None] + reach
        products = (share[:, a, None] * share).sum(-1)
        band -= np.bincount(cells.ravel(), products.ravel(), len(band))
    diagonal = np.arange(num_frames) * width + reach
    band[diagonal] += np.bincount(frame.ravel(), weights.sum(-1).ravel(), num_frames)
    cells = np.flatnonzero(band)
    rows = cells // width
    columns = rows + cells % width - reach
    return csc_matrix((band[cells], (rows, columns)), (num_frames, num_frames)), right


def second_differences(brackets: np.ndarray) -> csc_matrix:
    """The matrix (N, T) of second differences of frames of one bracket, in order."""
    triples = []
    for bracket in np.unique(brackets):
        own = np.flatnonzero(brackets == bracket)
        triples += list(zip(own, own[1:], own[2:], strict=False))
    columns = np.array(triples, int).reshape(-1, 3)
    rows = np.repeat(np.arange(len(columns)), 3)
    values = np.tile([1.0, -2.0, 1.0], len(columns))
    return csc_matrix((values, (rows, columns.ravel())), (len(columns), len(brackets)))


def drift_within_brackets(exposures: np.ndarray, brackets: np.ndarray) -> np.ndarray:
    """By how much the log2 exposures (T,) differ from the mean of their brackets."""
    drift = exposures.copy()
    for bracket in np.unique(brackets):
        drift[brackets == bracket] -= drift[brackets == bracket].mean()
    return drift


def drift_is_shared(
    drift: np.ndarray,
    brackets: np.ndarray,
    tuning: FrameExposuresTuning = FrameExposuresTuning(),
) -> bool:
    """Whether all brackets drift together, as auto exposure makes them: a `drift` (T,)
    of one bracket alone is that of the light in what this bracket shows.
    """
    if len(np.unique(brackets)) == 1 or len(drift) < 3:
        return True
    beside = (drift[:-2] + drift[2:]) / 2
    disagreement = np.sqrt(np.mean((drift[1:-1] - beside) ** 2))
    return bool(disagreement <= tuning.max_disagreement * np.sqrt(np.mean(drift**2)))


def steepness_factor(x: np.ndarray, y: np.ndarray, tuning: DebevecTuning) -> float:
    """The power of `x` (K,) that makes the mean of the curves `y` (3, K) as steep as
    sRGB over `mid_tones`, as `debevec.typical_factor`.
    """
    z = np.linspace(*tuning.mid_tones, 161)
    curves = [np.log(np.maximum(np.interp(z, channel, x), 1e-9)) for channel in y]
    mean_curve, srgb = np.mean(curves, axis=0), np.log(srgb_decode(z))
    mean_curve, srgb = mean_curve - mean_curve.mean(), srgb - srgb.mean()
    return float(mean_curve @ srgb / (mean_curve @ mean_curve))


def fit_curve_and_exposures(
    readings: Readings,
    x: np.ndarray,
    y: np.ndarray,
    brackets: np.ndarray,
    curve_tuning: DebevecTuning,
    tuning: FrameExposuresTuning = FrameExposuresTuning(),
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Curves y (3, 256) over x (256,), the log2 exposures (T,) of frames whose exposure
    drifts, mean 0, and the median misfit in stops. The common factor is that of a
    typical curve; `x`, `y` is the curve to begin with.
    """
    num_slots = readings.frame.shape[1]
    misfit = np.inf
    for _ in range(tuning.curve_rounds):
        exposures = frame_log_exposures(readings, x, y, brackets, tuning)
        samples = replace(readings.samples, offset=exposures[readings.frame])
        fit = debevec(samples, [0.0] * num_slots, 0, curve_tuning)
        factor = steepness_factor(fit.x, fit.y, curve_tuning)
        x = fit.x**factor
        y, misfit = fit.y, fit.misfit * factor
    exposures = frame_log_exposures(readings, x, y, brackets, tuning)
    return x, y, exposures, misfit
