"""What `prepare` prints of a response."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hdr_nsff.radiometry.response import Response


def describe(response: Response, given_ev: Sequence[float | None]) -> str:
    """How the response was found, in one sentence."""
    text = describe_source(response, given_ev)
    if response.disagreement:
        text += f"; {response.disagreement}"
    return text


def describe_source(response: Response, given_ev: Sequence[float | None]) -> str:
    """The same, without what given exposures and pixels disagree in."""
    steps = ", ".join(f"{e:+.2f}" for e in response.ev)
    match response.source:
        case "one exposure":
            return f"gamma 2.2: {describe_one_exposure(response)}"
        case "brightness":
            how = "gamma 2.2"
            if response.problem:
                how += f" ({response.problem})"
            unknown = "unknown ones from the brightness of the frames"
        case "static points":
            how = f"{describe_points(response)}, misfit {response.misfit:.3f} stops"
            if response.problem:
                how += f", {response.problem}"
            if len(response.y) > 1:
                curves = "one curve for all cameras"
                if response.own_curves:
                    curves = f"own curves for cameras {list(response.own_curves)}"
                how += f", {curves}"
            unknown = "unknown ones estimated with it"
            if response.guessed:
                unknown = describe_scale(response)
    if all(e is not None for e in given_ev) and not response.guessed:
        unknown = "as given"
    return f"{how}; EV {steps} ({unknown}){describe_drift(response)}"


def describe_points(response: Response) -> str:
    """How many points the response is from."""
    if not response.num_moving:
        return f"{response.num_points} static points"
    num_static = response.num_points - response.num_moving
    return f"{num_static} static points and {response.num_moving} on movers"


def describe_one_exposure(response: Response) -> str:
    """Why a clip without brackets determines no response, and what it lacks."""
    why = response.problem
    if response.drift is None:
        text = (
            "a single exposure does not determine the response; "
            "light beyond its white is not recorded"
        )
        return f"{text}; {why}" if why else text
    if not why:
        span = np.ptp(response.drift)
        why = f"exposures within {span:.2f} stops do not determine the response"
    return why + describe_drift(response)


def describe_drift(response: Response) -> str:
    """By how much single frames differ from their brackets; nothing where none does."""
    if response.drift is None:
        return ""
    low, high = response.drift.min(), response.drift.max()
    return f"; single frames drift by {low:+.2f} to {high:+.2f} EV (auto exposure)"


def describe_scale(response: Response) -> str:
    """How well the common factor of guessed EVs is known, and whether it was moved."""
    span = float(np.ptp(response.ev))
    if response.drift is not None:
        span = max(span, float(np.ptp(response.drift)))
    low, high = response.scale_low * span, response.scale_high * span
    measured = response.measured_scale * span
    interval = f"the recordings alone give {measured:.2f} from darkest to brightest"
    interval += f", {low:.2f} to {high:.2f} with 95 % confidence"
    if response.moved_stops > 0:
        interval += f"; moved by {response.moved_stops:.2f} to usual steps"
    return f"{interval}; give `--ev` if you know them"
