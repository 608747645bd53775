"""Estimates what the cameras of a clip do to radiance, from static points that several
exposures recorded: the response of brackets (`bracket_response.py`), and of single
frames where their exposure drifts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hdr_nsff.core.stack import LazyList
from hdr_nsff.radiometry.bracket_response import (
    GAMMA,
    NUM_KNOTS,
    SEED,
    ResponseTuning,
    bracket_response,
    problem_of,
)
from hdr_nsff.radiometry.bracketing import (
    FACTORS,
    BracketingTuning,
    StepScale,
    likely_scale,
    measured_scale,
)
from hdr_nsff.radiometry.debevec import debevec, shows_mid_tones
from hdr_nsff.radiometry.frame_exposures import (
    are_determined,
    determined_frames,
    drift_is_shared,
    drift_within_brackets,
    fit_curve_and_exposures,
    frame_log_exposures,
    read_points,
)
from hdr_nsff.radiometry.moving_samples import FlowLinks
from hdr_nsff.radiometry.response import Response
from hdr_nsff.radiometry.sensor_noise import noise_log_likelihood
from hdr_nsff.radiometry.static_samples import ResponseView

TUNING = ResponseTuning()
LEVEL_EV = 0.4  # frames this close in exposure count as one where noise is measured
DRIFTING_SHARE = 0.95  # quantile of the frames that has to drift for any to count
# by which the slope of a camera's curve may differ from that of gamma 2.2 (hand-chosen)
MAX_CURVE_FACTOR = 1.5
UNCHECKED = "too few static points to hold given exposures against the pixels"
CHANGING_LIGHT = "light that changes in some brackets only is not taken for auto exposure"
FEW_READINGS = "too few points show whether single frames are exposed differently"


def estimate_response(
    views: Sequence[ResponseView],
    view_cameras: Sequence[int],
    ev: Sequence[float | None],
    reference: int,
    num_cameras: int,
    tuning: ResponseTuning = TUNING,
    lossless: bool = False,
    drift: np.ndarray | None = None,
    may_drift: bool = True,
    links: FlowLinks | None = None,
) -> Response:
    """Response and exposures from recorded frames with depth and poses.

    `views` are the training frames, `view_cameras` their physical cameras; `ev` (B,)
    holds the known log2 exposures, None where unknown. `views` without a usable
    disparity (all 0) contribute brightness only. `lossless`: the frames were never
    compressed with loss, so that they show the noise of the sensor. Where single frames
    differ from their brackets, `drift` of the response is by how much; `drift` (V,) is
    given where it is known, and looked for only if exposures `may_drift`. `links`: flow
    between the views, which finds points on movers where static ones tell too little.
    """
    response = bracket_response(
        views, view_cameras, ev, reference, num_cameras, tuning, lossless, links
    )
    if num_cameras > 1:
        return response
    if drift is not None:
        return with_given_drift(response, views, ev, drift, tuning)
    if not may_drift:
        return response
    return with_drift(response, views, ev, reference, tuning, lossless)


def with_given_drift(
    response: Response,
    views: Sequence[ResponseView],
    ev: Sequence[float | None],
    drift: np.ndarray,
    tuning: ResponseTuning = TUNING,
) -> Response:
    """The response where the exposures `ev` (B,) of brackets and the `drift` (V,) of
    frames are given; gamma 2.2 where points are too few.
    """
    response = replace(response, drift=drift)
    ordered = sorted(range(len(views)), key=lambda i: views[i].time)
    in_time = [views[i] for i in ordered]
    readings = read_points(in_time, np.random.default_rng(SEED), tuning.frames)
    if not determined_frames(readings, len(views), tuning.frames).all():
        return replace(response, disagreement=UNCHECKED)
    exposures = np.array([float(ev[v.bracket] or 0.0) for v in in_time]) + drift[ordered]
    brackets = np.array([v.bracket for v in in_time])
    if np.ptp(exposures) < tuning.min_range:
        seen = frame_log_exposures(readings, response.x, response.y[0], brackets, tuning.frames)
        assumed = response.source != "static points"
        return replace(response, disagreement=disagreement(seen, exposures, tuning, assumed))
    samples = replace(readings.samples, offset=exposures[readings.frame])
    fit = debevec(samples, [0.0] * readings.frame.shape[1], 0, tuning.debevec)
    if problem := problem_of(fit.x, fit.y, fit.misfit, tuning):
        return replace(response, problem=problem)
    seen = frame_log_exposures(readings, fit.x, fit.y, brackets, tuning.frames)
    return replace(
        response,
        x=fit.x,
        y=fit.y[None],
        source="static points",
        misfit=fit.misfit,
        num_points=len(readings.frame),
        num_moving=0,
        guessed=False,
        problem="",
        disagreement=disagreement(seen, exposures, tuning),
    )


def disagreement(
    seen: np.ndarray, given: np.ndarray, tuning: ResponseTuning, assumed: bool = False
) -> str:
    """By how much `seen` log2 exposures (T,) of frames differ from `given` ones, in
    words; "" where hardly. An `assumed` curve stretches what is seen by a factor.
    """
    seen, given = seen - seen.mean(), given - given.mean()
    factor = 1.0
    if assumed:
        best = float(seen @ given) / max(float(given @ given), 1e-9)
        factor = float(np.clip(best, 1 / MAX_CURVE_FACTOR, MAX_CURVE_FACTOR))
    off = np.abs(seen - factor * given)
    if np.quantile(off, DRIFTING_SHARE) < tuning.frames.min_drift:
        return ""
    return f"the pixels disagree with given exposures by up to {off.max():.2f} EV"


def with_drift(
    response: Response,
    views: Sequence[ResponseView],
    ev: Sequence[float | None],
    reference: int,
    tuning: ResponseTuning = TUNING,
    lossless: bool = False,
) -> Response:
    """The response with the exposure of every frame, where these drift; else as it is.

    Without drift nothing new is learned, and the first estimate stays.
    """
    ordered = sorted(range(len(views)), key=lambda i: views[i].time)
    in_time = [views[i] for i in ordered]
    brackets = np.array([v.bracket for v in in_time])
    readings = read_points(in_time, np.random.default_rng(SEED), tuning.frames)
    if not are_determined(readings, brackets, tuning.frames):
        return response if response.problem else replace(response, problem=FEW_READINGS)
    exposures = frame_log_exposures(readings, response.x, response.y[0], brackets, tuning.frames)
    drift = drift_within_brackets(exposures, brackets)
    if np.quantile(np.abs(drift), DRIFTING_SHARE) < tuning.frames.min_drift:
        return response
    in_order = np.zeros(len(views))
    in_order[ordered] = drift
    if np.ptp(exposures) < tuning.min_range:
        return replace(response, drift=in_order)
    x, y, exposures, misfit = fit_curve_and_exposures(
        readings, response.x, response.y[0], brackets, tuning.debevec, tuning.frames
    )
    if problem := problem_of(x, y, misfit, tuning):
        return replace(response, problem=problem)
    drift = drift_within_brackets(exposures, brackets)
    if not drift_is_shared(drift, brackets, tuning.frames):
        return replace(response, problem=CHANGING_LIGHT)
    level = exposures - drift  # (V,) of the frame's bracket
    found = np.zeros(len(ev))
    for bracket in np.unique(brackets):
        found[bracket] = level[brackets == bracket][0]
    found = found - found[reference]
    bracketing = tuning.debevec.bracketing
    if not shows_mid_tones(readings.samples, tuning.debevec):
        bracketing = bracketing.without_mid_tones()
    likelihood = noise_of_frames(in_time, x, y, exposures, tuning) if lossless else None
    scale = drift_scale(found, ev, likelihood, bracketing)
    in_order[ordered] = drift * scale.factor
    knots = np.linspace(0, 1, NUM_KNOTS) ** GAMMA
    curves = np.stack([np.interp(knots, x**scale.factor, channel) for channel in y])
    return Response(
        x=knots,
        y=curves[None],
        ev=np.array([f * scale.factor if e is None else e for f, e in zip(found, ev, strict=True)]),
        white_balance=np.zeros((1, 3)),
        source="static points",
        misfit=misfit * scale.factor,
        num_points=len(readings.frame),
        guessed=len([e for e in ev if e is not None]) < 2,
        own_curves=(),
        measured_scale=scale.measured / scale.factor,
        scale_low=scale.low / scale.factor,
        scale_high=scale.high / scale.factor,
        drift=in_order,
    )


def drift_scale(
    found: np.ndarray,
    ev: Sequence[float | None],
    log_likelihood: np.ndarray | None,
    bracketing: BracketingTuning,
) -> StepScale:
    """The common factor on the exposures of all frames and the EVs `found` (B,) of
    brackets: from known ones, else from noise (the `log_likelihood` of every one of
    `FACTORS`), curve and usual steps.
    """
    known = np.array([e is not None for e in ev])
    true = np.array([0.0 if e is None else e for e in ev])
    if np.abs(true[known]).max(initial=0.0) > 0:
        factor = float(true[known] @ found[known] / (found[known] @ found[known]))
        return StepScale(factor, factor, factor, factor)
    if len(found) == 1:
        return measured_scale(log_likelihood, bracketing)
    return likely_scale(found, None, log_likelihood, bracketing)


def noise_of_frames(
    views: Sequence[ResponseView],
    x: np.ndarray,
    y: np.ndarray,
    exposures: np.ndarray,
    tuning: ResponseTuning,
) -> np.ndarray | None:
    """The log likelihood of every one of `FACTORS` on the `exposures` (V,) of frames,
    from the noise of their sensor; None where nothing follows.
    """
    levels = np.round((exposures - exposures.min()) / LEVEL_EV).astype(int)
    images = LazyList(lambda k: views[k].image, len(views))
    return noise_log_likelihood(images, levels.tolist(), x, y, exposures, FACTORS, tuning.noise)
