"""The response of cameras whose brackets have one exposure each, from static points
that several brackets recorded (`debevec.py`).

Where static points do not suffice, curves are gamma 2.2 and exposures come from the
brightness of the frames, and `source` says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hdr_nsff.core.stack import LazyList
from hdr_nsff.radiometry.bracketing import FACTORS, StepScale
from hdr_nsff.radiometry.brightness import brightness_ev
from hdr_nsff.radiometry.debevec import (
    MAX_MISFIT,
    DebevecTuning,
    ResponseFit,
    ScaleEvidence,
    brackets_linked,
    debevec,
    shows_mid_tones,
)
from hdr_nsff.radiometry.frame_exposures import FrameExposuresTuning
from hdr_nsff.radiometry.moving_samples import FlowLinks, moving_samples
from hdr_nsff.radiometry.response import Response, Source
from hdr_nsff.radiometry.samples import joined
from hdr_nsff.radiometry.sensor_noise import SensorNoiseTuning, noise_log_likelihood
from hdr_nsff.radiometry.static_samples import ResponseView, static_samples

GAMMA = 2.2  # of the fallback
NUM_KNOTS = 256
SEED = 0  # of the choice of static points


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


def bracket_response(
    views: Sequence[ResponseView],
    view_cameras: Sequence[int],
    ev: Sequence[float | None],
    reference: int,
    num_cameras: int,
    tuning: ResponseTuning = ResponseTuning(),
    lossless: bool = False,
    links: FlowLinks | None = None,
) -> Response:
    """The response where all frames of a bracket have one exposure.

    Points on movers, followed along `links`, help where static ones do not link all
    brackets or do not show the mid-tones.
    """
    brackets = {v.bracket for v in views}
    if len(brackets) == 1:
        return from_brightness(views, ev, reference, num_cameras, "one exposure", "")
    rng = np.random.default_rng(SEED)
    samples = static_samples(views, len(ev), tuning.num_samples, rng)
    num_static = len(samples.rgb)
    suffices = brackets_linked(samples, brackets, tuning.debevec)
    if links is not None and not (suffices and shows_mid_tones(samples, tuning.debevec)):
        moving = moving_samples(views, links, len(ev), tuning.num_samples, rng)
        samples = joined([samples, moving], len(ev))
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
        num_moving=len(samples.rgb) - num_static,
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
