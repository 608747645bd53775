"""Estimates what the cameras of a clip do to radiance, from static points that several
exposures recorded (`debevec.py`).

Where static points do not suffice, curves are gamma 2.2 and exposures come from the
brightness of the frames, and `source` says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hdr_nsff.core.stack import LazyList
from hdr_nsff.radiometry.bracketing import FACTORS, StepScale, likely_scale, measured_scale
from hdr_nsff.radiometry.brightness import brightness_ev
from hdr_nsff.radiometry.debevec import (
    MAX_MISFIT,
    DebevecTuning,
    ResponseFit,
    ScaleEvidence,
    brackets_linked,
    debevec,
)
from hdr_nsff.radiometry.frame_exposures import (
    FrameExposuresTuning,
    drift_is_shared,
    drift_within_brackets,
    fit_curve_and_exposures,
    frame_log_exposures,
    is_determined,
    read_points,
)
from hdr_nsff.radiometry.response import Response, Source
from hdr_nsff.radiometry.sensor_noise import SensorNoiseTuning, noise_log_likelihood
from hdr_nsff.radiometry.static_samples import ResponseView, static_samples

GAMMA = 2.2  # of the fallback
NUM_KNOTS = 256
LEVEL_EV = 0.4  # frames this close in exposure count as one where noise is measured
SEED = 0  # of the choice of static points
DRIFTING_SHARE = 0.95  # quantile of the frames that has to drift for any to count
CHANGING_LIGHT = "light that changes in some brackets only is not taken for auto exposure"


@dataclass(frozen=True)
class ResponseTuning:
    """Evidence that the response needs (hand-chosen on rendered scenes)."""

    num_samples: int = 4000  # static points
    median_rounds: int = 20  # of the robust fit of white balance
    # stops from the darkest frame to the brightest that determine a curve, where frames
    # differ by drift alone (a GoPro's frames 0.2 stops apart gave a step from black to
    # white)
    min_range: float = 1.0
    # stops from a recorded 0.1 to 0.8; cameras take 5 to 7 (gamma 2.2 is 6.6)
    min_span: float = 2.0
    debevec: DebevecTuning = field(default_factory=DebevecTuning)
    noise: SensorNoiseTuning = field(default_factory=SensorNoiseTuning)
    frames: FrameExposuresTuning = field(default_factory=FrameExposuresTuning)


def estimate_response(
    views: Sequence[ResponseView],
    view_cameras: Sequence[int],
    ev: Sequence[float | None],
    reference: int,
    num_cameras: int,
    tuning: ResponseTuning = ResponseTuning(),
    lossless: bool = False,
    drift: np.ndarray | None = None,
    may_drift: bool = True,
) -> Response:
    """Response and exposures from recorded frames with depth and poses.

    `views` are the training frames, `view_cameras` their physical cameras; `ev` (B,)
    holds the known log2 exposures, None where unknown. `views` without a usable
    disparity (all 0) contribute brightness only. `lossless`: the frames were never
    compressed with loss, so that they show the noise of the sensor. Where single frames
    differ from their brackets, `drift` of the response is by how much; `drift` (V,) is
    given where it is known, and looked for only if exposures `may_drift`.
    """
    response = bracket_response(views, view_cameras, ev, reference, num_cameras, tuning, lossless)
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
    tuning: ResponseTuning = ResponseTuning(),
) -> Response:
    """The response where the exposures `ev` (B,) of brackets and the `drift` (V,) of
    frames are given; gamma 2.2 where points are too few.
    """
    response = replace(response, drift=drift)
    ordered = sorted(range(len(views)), key=lambda i: views[i].time)
    in_time = [views[i] for i in ordered]
    readings = read_points(in_time, np.random.default_rng(SEED), tuning.frames)
    if not is_determined(readings, len(views), tuning.frames):
        return response
    exposures = np.array([float(ev[v.bracket] or 0.0) for v in in_time]) + drift[ordered]
    if np.ptp(exposures) < tuning.min_range:
        return response
    samples = replace(readings.samples, offset=exposures[readings.frame])
    fit = debevec(samples, [0.0] * readings.frame.shape[1], 0, tuning.debevec)
    if problem := problem_of(fit.x, fit.y, fit.misfit, tuning):
        return replace(response, problem=problem)
    brackets = np.array([v.bracket for v in in_time])
    seen = frame_log_exposures(readings, fit.x, fit.y, brackets, tuning.frames)
    off = np.abs(seen - seen.mean() - exposures + exposures.mean())
    problem = ""
    if np.quantile(off, DRIFTING_SHARE) > tuning.frames.min_drift:
        problem = f"the pixels disagree with given exposures by up to {off.max():.2f} EV"
    return replace(
        response,
        x=fit.x,
        y=fit.y[None],
        source="static points",
        misfit=fit.misfit,
        num_points=len(readings.frame),
        guessed=False,
        problem=problem,
    )


def with_drift(
    response: Response,
    views: Sequence[ResponseView],
    ev: Sequence[float | None],
    reference: int,
    tuning: ResponseTuning = ResponseTuning(),
    lossless: bool = False,
) -> Response:
    """The response with the exposure of every frame, where these drift; else as it is.

    Without drift nothing new is learned, and the first estimate stays.
    """
    ordered = sorted(range(len(views)), key=lambda i: views[i].time)
    in_time = [views[i] for i in ordered]
    brackets = np.array([v.bracket for v in in_time])
    readings = read_points(in_time, np.random.default_rng(SEED), tuning.frames)
    if not is_determined(readings, len(views), tuning.frames):
        return response
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
    scale = drift_scale(in_time, x, y, exposures, found, ev, tuning, lossless)
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
    views: Sequence[ResponseView],
    x: np.ndarray,
    y: np.ndarray,
    exposures: np.ndarray,
    found: np.ndarray,
    ev: Sequence[float | None],
    tuning: ResponseTuning,
    lossless: bool,
) -> StepScale:
    """The common factor on the `exposures` (V,) of frames and the EVs `found` (B,) of
    brackets: from known ones, else from noise, curve and usual steps.
    """
    known = np.array([e is not None for e in ev])
    true = np.array([0.0 if e is None else e for e in ev])
    if np.abs(true[known]).max(initial=0.0) > 0:
        factor = float(true[known] @ found[known] / (found[known] @ found[known]))
        return StepScale(factor, factor, factor, factor)
    log_likelihood = None
    if lossless:
        levels = np.round((exposures - exposures.min()) / LEVEL_EV).astype(int)
        images = LazyList(lambda k: views[k].image, len(views))
        log_likelihood = noise_log_likelihood(
            images,
            levels.tolist(),
            x,
            y,
            exposures,
            FACTORS,
            tuning.noise,
        )
    if len(found) == 1:
        return measured_scale(log_likelihood, tuning.debevec.bracketing)
    return likely_scale(found, None, log_likelihood, tuning.debevec.bracketing)


def bracket_response(
    views: Sequence[ResponseView],
    view_cameras: Sequence[int],
    ev: Sequence[float | None],
    reference: int,
    num_cameras: int,
    tuning: ResponseTuning = ResponseTuning(),
    lossless: bool = False,
) -> Response:
    """The response where all frames of a bracket have one exposure."""
    brackets = {v.bracket for v in views}
    if len(brackets) == 1:
        return from_brightness(views, ev, reference, num_cameras, "one exposure", "")
    rng = np.random.default_rng(SEED)
    samples = static_samples(views, len(ev), tuning.num_samples, rng)
    if not brackets_linked(samples, brackets, tuning.debevec):
        problem = "too few static points seen in several exposures"
        return from_brightness(views, ev, reference, num_cameras, "brightness", problem)
    evidence = evidence_of_noise(views, tuning) if lossless else None
    fit = debevec(samples, ev, reference, tuning.debevec, evidence)
    if problem := problem_of(fit.x, fit.y, fit.misfit, tuning):
        return from_brightness(views, ev, reference, num_cameras, "brightness", problem)
    own = camera_fits(views, view_cameras, fit, reference, tuning) if num_cameras > 1 else {}
    y = np.stack([own[c].y if c in own else fit.y for c in range(num_cameras)])
    scale = fit.scale or StepScale(1.0, 1.0, 1.0, 1.0)
    return Response(
        x=fit.x,
        y=y,
        ev=fit.ev,
        white_balance=estimate_white_balance(views, view_cameras, fit.x, y, fit.ev, tuning),
        source="static points",
        misfit=fit.misfit,
        num_points=len(samples.rgb),
        guessed=fit.guessed,
        own_curves=tuple(sorted(own)),
        measured_scale=scale.measured / scale.factor,
        scale_low=scale.low / scale.factor,
        scale_high=scale.high / scale.factor,
    )


def problem_of(x: np.ndarray, y: np.ndarray, misfit: float, tuning: ResponseTuning) -> str:
    """Why curves `y` (3, K) over `x` (K,) are not to be believed; "" if they are."""
    if misfit >= MAX_MISFIT:
        return f"static points differ by {misfit:.2f} stops"
    span = curve_span(x, y)
    if span < tuning.min_span:
        return f"static points give a curve from black to white within {span:.1f} stops"
    return ""


def curve_span(x: np.ndarray, y: np.ndarray) -> float:
    """Stops of exposure from a recorded 0.1 to a recorded 0.8, of the shortest of the
    curves `y` (3, K) over `x` (K,).
    """
    ends = [np.interp([0.1, 0.8], channel, x) for channel in y]
    return min(float(np.log2(bright / max(dark, 1e-9))) for dark, bright in ends)


def evidence_of_noise(views: Sequence[ResponseView], tuning: ResponseTuning) -> ScaleEvidence:
    """What the noise of the recorded frames says of the common factor of all EVs."""
    images = LazyList(lambda k: views[k].image, len(views))
    brackets = [v.bracket for v in views]

    def evidence(x: np.ndarray, y: np.ndarray, ev: np.ndarray) -> np.ndarray | None:
        return noise_log_likelihood(images, brackets, x, y, ev[brackets], FACTORS, tuning.noise)

    return evidence


def camera_fits(
    views: Sequence[ResponseView],
    view_cameras: Sequence[int],
    fit: ResponseFit,
    reference: int,
    tuning: ResponseTuning,
) -> dict[int, ResponseFit]:
    """The own curve of every camera with enough static points, at the exposures of the
    common `fit`.
    """
    own = {}
    for camera in sorted(set(view_cameras)):
        mine = [v for v, c in zip(views, view_cameras, strict=True) if c == camera]
        rng = np.random.default_rng(SEED)
        samples = static_samples(mine, len(fit.ev), tuning.num_samples, rng)
        seen = {v.bracket for v in mine}
        if len(seen) > 1 and brackets_linked(samples, seen, tuning.debevec):
            camera_fit = debevec(samples, fit.ev.tolist(), reference, tuning.debevec)
            if camera_fit.misfit < MAX_MISFIT:
                own[camera] = camera_fit
    return own


def estimate_white_balance(
    views: Sequence[ResponseView],
    view_cameras: Sequence[int],
    x: np.ndarray,
    y: np.ndarray,
    ev: np.ndarray,
    tuning: ResponseTuning = ResponseTuning(),
) -> np.ndarray:
    """White balance (C, 3) in stops of every camera relative to camera 0.

    It comes from static points that several cameras recorded, through their curves `y`
    (C, 3, K) over `x` (K,).

    The robust fit of log exposure = log radiance of the point + white balance of the
    camera, by alternating medians; 0 for cameras that share too few points with others.
    """
    num_cameras, num_brackets = len(y), len(ev)
    white_balance = np.zeros((num_cameras, 3))
    if num_cameras == 1:
        return white_balance
    # One "bracket" per camera and exposure, so that the sampler keeps cameras apart.
    slots = [
        v.in_bracket(c * num_brackets + v.bracket) for v, c in zip(views, view_cameras, strict=True)
    ]
    count = num_cameras * num_brackets
    samples = static_samples(slots, count, tuning.num_samples, np.random.default_rng(SEED))
    camera = np.repeat(np.arange(num_cameras), num_brackets)  # (S,) of every slot
    for channel in range(3):
        valid = samples.valid[..., channel]
        exposure = np.stack(
            [np.interp(samples.rgb[:, s, channel], y[camera[s], channel], x) for s in range(count)],
            axis=1,
        )
        stops = np.log2(np.maximum(exposure, 1e-9)) - np.tile(ev, num_cameras)
        stops = np.where(valid & (exposure > 0), stops, np.nan)
        white_balance[:, channel] = alternating_medians(stops, camera, num_cameras, tuning)
    return white_balance


def alternating_medians(
    stops: np.ndarray,
    camera: np.ndarray,
    num_cameras: int,
    tuning: ResponseTuning = ResponseTuning(),
) -> np.ndarray:
    """Offsets (C,) of cameras, that of camera 0 being 0, in `stops` (P, S), NaN where
    unknown, of points seen in slots of a `camera` (S,).
    """
    offsets = np.zeros(num_cameras)
    several = np.array([len(set(camera[np.isfinite(row)])) > 1 for row in stops], bool)
    stops = stops[several]
    least = tuning.debevec.min_shared_points
    if len(stops) < least:
        return offsets
    for _ in range(tuning.median_rounds):
        radiance = np.nanmedian(stops - offsets[camera], axis=1, keepdims=True)
        left = stops - radiance
        for c in range(num_cameras):
            seen = left[:, camera == c]
            seen = seen[np.isfinite(seen)]
            offsets[c] = np.median(seen) if len(seen) >= least else 0.0
    return offsets - offsets[0]


def from_brightness(
    views: Sequence[ResponseView],
    ev: Sequence[float | None],
    reference: int,
    num_cameras: int,
    source: Source,
    problem: str,
) -> Response:
    """Gamma 2.2 curves; unknown exposures from the brightness of the frames."""
    images = LazyList(lambda k: views[k].image, len(views))
    guess = brightness_ev(images, [v.bracket for v in views], reference, len(ev))
    known = [g if e is None else e for g, e in zip(guess, ev, strict=True)]
    level = np.linspace(0, 1, NUM_KNOTS)
    return Response(
        x=level**GAMMA,
        y=np.tile(level, (num_cameras, 3, 1)),
        ev=np.array(known),
        white_balance=np.zeros((num_cameras, 3)),
        source=source,
        misfit=None,
        num_points=0,
        guessed=any(e is None for e in ev) and source == "brightness",
        own_curves=(),
        problem=problem,
    )
