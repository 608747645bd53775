"""What the cameras of a clip do to radiance: response curves, exposures, white balance.

`prepare` estimates them once (`estimate_response`), from static points that several
exposures recorded (`debevec.py`), and writes them as `response.json`. The tone mapper
starts there, and flow is refined on frames brought to one exposure through them.
Where static points do not suffice, curves are gamma 2.2 and exposures come from the
brightness of the frames, and `source` says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hdr_nsff.radiometry.bracketing import FACTORS, StepScale
from hdr_nsff.radiometry.brightness import brightness_ev
from hdr_nsff.radiometry.debevec import (
    MAX_MISFIT,
    DebevecTuning,
    ResponseFit,
    ScaleEvidence,
    brackets_linked,
    debevec,
)
from hdr_nsff.radiometry.sensor_noise import SensorNoiseTuning, noise_log_likelihood
from hdr_nsff.radiometry.static_samples import ResponseView, static_samples

GAMMA = 2.2  # of the fallback
NUM_KNOTS = 256
SEED = 0  # of the choice of static points

Source = Literal["static points", "brightness", "one exposure"]


@dataclass(frozen=True)
class ResponseTuning:
    """Evidence that the response needs (hand-chosen on rendered scenes)."""

    num_samples: int = 4000  # static points
    median_rounds: int = 20  # of the robust fit of white balance
    debevec: DebevecTuning = field(default_factory=DebevecTuning)
    noise: SensorNoiseTuning = field(default_factory=SensorNoiseTuning)


@dataclass(frozen=True)
class Response:
    """Response and exposures of C cameras and B brackets.

    A camera c records `y[c](2**(ev[b] + white_balance[c]) * radiance)` in bracket b,
    per channel; radiance 1 saturates camera 0 at the reference exposure.
    """

    x: np.ndarray  # (256,) relative exposure in [0, 1], evenly spaced in x^(1/2.2)
    y: np.ndarray  # (C, 3, 256) recorded value in [0, 1], rising
    ev: np.ndarray  # (B,) stops, 0 at the reference bracket
    white_balance: np.ndarray  # (C, 3) stops, 0 for camera 0
    source: Source
    misfit: float | None  # median absolute error of a static point's exposure, in stops
    num_points: int  # static points used
    guessed: bool  # the common factor of all `ev` is the likeliest one, not measured
    own_curves: tuple[int, ...]  # cameras with a curve of their own, of several cameras
    problem: str = ""  # why not from static points, in words
    # where no exposure was known: the common factor that would turn all `ev` into what
    # the recordings alone say, and its 95 % interval; else 1
    measured_scale: float = 1.0
    scale_low: float = 1.0
    scale_high: float = 1.0

    @property
    def moved_stops(self) -> float:
        """By how much the widest range of exposures was moved to usual steps."""
        return abs(1 - self.measured_scale) * float(np.ptp(self.ev))


def estimate_response(
    views: Sequence[ResponseView],
    view_cameras: Sequence[int],
    ev: Sequence[float | None],
    reference: int,
    num_cameras: int,
    tuning: ResponseTuning = ResponseTuning(),
    lossless: bool = False,
) -> Response:
    """Response and exposures from recorded frames with depth and poses.

    `views` are the training frames, `view_cameras` their physical cameras; `ev` (B,)
    holds the known log2 exposures, None where unknown. `views` without a usable
    disparity (all 0) contribute brightness only. `lossless`: the frames were never
    compressed with loss, so that they show the noise of the sensor.
    """
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
    if fit.misfit >= MAX_MISFIT:
        problem = f"static points differ by {fit.misfit:.2f} stops"
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


def evidence_of_noise(views: Sequence[ResponseView], tuning: ResponseTuning) -> ScaleEvidence:
    """What the noise of the recorded frames says of the common factor of all EVs."""
    images, brackets = [v.image for v in views], [v.bracket for v in views]

    def evidence(x: np.ndarray, y: np.ndarray, ev: np.ndarray) -> np.ndarray | None:
        return noise_log_likelihood(images, brackets, x, y, ev, FACTORS, tuning.noise)

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
        replace(v, bracket=c * num_brackets + v.bracket)
        for v, c in zip(views, view_cameras, strict=True)
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
    guess = brightness_ev([v.image for v in views], [v.bracket for v in views], reference, len(ev))
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


def describe(response: Response, given_ev: Sequence[float | None]) -> str:
    """How the response was found, in one sentence."""
    steps = ", ".join(f"{e:+.2f}" for e in response.ev)
    match response.source:
        case "one exposure":
            return "gamma 2.2: a single exposure does not determine the response"
        case "brightness":
            how = "gamma 2.2"
            if response.problem:
                how += f" ({response.problem})"
            unknown = "unknown ones from the brightness of the frames"
        case "static points":
            how = f"{response.num_points} static points, misfit {response.misfit:.3f} stops"
            if len(response.y) > 1:
                curves = "one curve for all cameras"
                if response.own_curves:
                    curves = f"own curves for cameras {list(response.own_curves)}"
                how += f", {curves}"
            unknown = "unknown ones estimated with it"
            if response.guessed:
                unknown = describe_scale(response)
    if all(e is not None for e in given_ev):
        unknown = "as given"
    return f"{how}; EV {steps} ({unknown})"


def describe_scale(response: Response) -> str:
    """How well the common factor of guessed EVs is known, and whether it was moved."""
    span = float(np.ptp(response.ev))
    low, high = response.scale_low * span, response.scale_high * span
    measured = response.measured_scale * span
    interval = f"the recordings alone give {measured:.2f} from darkest to brightest"
    interval += f", {low:.2f} to {high:.2f} with 95 % confidence"
    if response.moved_stops > 0:
        interval += f"; moved by {response.moved_stops:.2f} to usual steps"
    return f"{interval}; give `--ev` if you know them"


def at_one_exposure(
    video: np.ndarray, brackets: np.ndarray, cameras: np.ndarray, response: Response
) -> np.ndarray:
    """`video` (T, H, W, 3) recorded in [0, 1] at one brightness, in [0, 1].

    Every pixel becomes the mean of what it would be in all brackets (T,) that its
    camera (T,) used, which keeps contrast wherever any of them has some.
    """
    result = np.empty(video.shape, np.float32)
    value = np.linspace(0, 1, 1025)  # recorded values that are tabulated
    for t, (own, camera) in enumerate(zip(brackets, cameras, strict=True)):
        used = np.unique(brackets[cameras == camera])
        for c in range(3):
            y = response.y[camera, c]
            exposure = np.interp(value, y, response.x)
            gains = [2.0 ** (response.ev[b] - response.ev[own]) for b in used]
            images = [np.interp(exposure * gain, response.x, y) for gain in gains]
            result[t, ..., c] = np.interp(video[t, ..., c], value, np.mean(images, axis=0))
    return result
