"""The learned camera and the estimated poses against the true ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hdr_nsff.evaluation.targets import Target, trajectories
from hdr_nsff.geometry import alignment
from hdr_nsff.radiometry.recording import Curve
from hdr_nsff.scene.truth import Truth, as_exposed, scene_brackets
from hdr_nsff.training.run_folder import Run

POWERS = np.geomspace(0.25, 4, 385)  # candidates for the response, 0.7 % apart
RESPONSE_SAMPLES = 256  # exposures at which curves are compared
RESPONSE_STRIDE = 5  # metrics.json has every fifth sample of the true curve


def camera_errors(run: Run, truth: Truth) -> dict[str, Any]:
    """The learned response and exposures against the true ones.

    Empty where the true response is not known. `response_rmse`: root mean square error
    of the recorded value in [0, 1], over exposures evenly spaced in x^(1/2.2) and the
    three channels. The scale is fixed, because both curves reach 1 at exposure 1.

    Where exposures are learned, radiance is known up to a power p only: if E explains
    the clip through a curve g, then so does E^p through g(x^(1/p)) with exposures p
    times as far apart (in EV). This gauge is estimated from one of the two and removed
    from the other, so that neither is compared with itself:

    - `power`: learned exposures over true ones, by least squares;
    - `response_rmse_after_power`: the error of the response once `power` is undone;
    - `power_of_response`: the power at which the curves agree best (1 where exposures
      were given);
    - `largest_step_error_after_power`: the error of the exposures once that is undone.

    EVs are relative to the reference bracket; steps lead from one exposure to the next
    brighter one.
    """
    if truth.response is None:
        return {}
    own = Curve(*(t.cpu().double().numpy() for t in run.tonemapper.curve(0)))
    spaced = np.linspace(0, 1, RESPONSE_SAMPLES)[:, None].repeat(3, 1)
    exposures = spaced**2.2  # (256, 3)
    true = truth.response.apply(exposures)

    def rmse(power: float) -> float:
        return float(np.sqrt(np.mean((own.apply(exposures**power) - true) ** 2)))

    true_ev, learned_ev = exposure_pairs(run, truth)
    power = power_between(learned_ev, true_ev)
    power_of_response = 1.0
    if not run.scene.manifest.exposure_given:
        power_of_response = float(min(POWERS, key=rmse))
    errors: dict[str, Any] = {
        "response_rmse": rmse(1.0),
        "power": power,
        "response_rmse_after_power": rmse(power),
        "power_of_response": power_of_response,
        "true_ev": rounded(true_ev),
        "learned_ev": rounded(learned_ev),
        "largest_ev_error": float(np.abs(learned_ev - true_ev).max()),
    }
    errors |= step_errors(learned_ev, true_ev, power_of_response)
    shown = slice(None, None, RESPONSE_STRIDE)
    curve = {"x": exposures[shown, 0].tolist(), "y": true[shown].T.tolist()}
    return errors | {"true_response": curve}


def power_between(learned_ev: np.ndarray, true_ev: np.ndarray) -> float:
    """Learned exposures (B,) over true ones (B,), by least squares.

    1 where that is no positive number.
    """
    if not true_ev.any():
        return 1.0
    power = float(learned_ev @ true_ev / (true_ev @ true_ev))
    return power if power > 0 else 1.0


def step_errors(learned_ev: np.ndarray, true_ev: np.ndarray, power: float) -> dict[str, Any]:
    """Errors of the steps between exposures in EV, also once `power` is undone.

    Empty where there is one exposure.
    """
    order = np.argsort(true_ev, kind="stable")
    true_steps, learned_steps = np.diff(true_ev[order]), np.diff(learned_ev[order])
    if not len(true_steps):
        return {}
    return {
        "true_ev_steps": rounded(true_steps),
        "learned_ev_steps": rounded(learned_steps),
        "largest_step_error": float(np.abs(learned_steps - true_steps).max()),
        "largest_step_error_after_power": float(np.abs(learned_steps / power - true_steps).max()),
    }


def rounded(values: np.ndarray) -> list[float]:
    """Exposures with four digits."""
    return [round(float(value), 4) for value in values]


def exposure_pairs(run: Run, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """True and learned EV of every bracket that truth and scene have, (B,) each.

    Relative to the reference bracket of the truth.
    """
    ev = run.tonemapper.exposures().cpu().double().numpy()
    frames = run.scene.manifest.frames
    truth = as_exposed(truth, frames, ev.tolist())
    match = scene_brackets(truth, frames, ev.tolist())
    reference = truth.reference_bracket
    true_ev = np.array(truth.bracket_ev, np.float64)
    brackets = sorted(match)
    learned_ev = ev[[match[b] for b in brackets]]
    return true_ev[brackets] - true_ev[reference], learned_ev - ev[match[reference]]


def trajectory_errors(run: Run, truth: Truth, targets: Sequence[Target]) -> dict[str, float]:
    """Errors of poses and of the focal length of the clip's first frame.

    Empty where the truth has neither.
    """
    paths = trajectories(run, truth)
    errors = {} if paths is None else alignment.pose_errors(*paths)
    manifest = run.scene.manifest
    first = manifest.frames[0]
    if truth.K is not None and first.K is not None and targets:
        own_K = np.array(first.K)
        if first.camera_id in manifest.lens:
            own_K = manifest.lens[first.camera_id].lens().unzoomed(own_K)
        # At the size of the truth's pictures, which is that of its K.
        focal = float(own_K[0, 0]) * targets[0].view.camera.width / manifest.width
        true_focal = truth.K[0][0]
        errors |= {
            "focal": focal,
            "true_focal": true_focal,
            "focal_error": focal / true_focal - 1,
        }
    return errors
