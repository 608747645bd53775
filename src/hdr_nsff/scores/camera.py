"""The learned camera and the estimated poses against the true ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hdr_nsff import alignment
from hdr_nsff.run import Run
from hdr_nsff.scores.targets import Target, match_brackets, trajectories
from hdr_nsff.truth import Truth

POWERS = np.geomspace(0.25, 4, 385)  # tried for the response, 0.7 % apart


def camera_errors(run: Run, truth: Truth) -> dict[str, Any]:
    """The learned response and exposures against the true ones.

    `response_rmse`: root mean square error of the recorded value in [0, 1], over exposures evenly spaced in x^(1/2.2) and the three channels.
    The scale is fixed, for both curves reach 1 at exposure 1. Where exposures are learned, radiance is known up to a power p only: if E
    explains the clip through a curve g, then so does E^p through g(x^(1/p)) and exposures p times as far apart (in EV). That gauge is
    found in one of the two and taken out of the other, so that neither is compared with itself:
    `power`: what the learned exposures are of the true ones, least squares; `response_rmse_after_power`: the error once it is undone;
    `power_of_response`: at which the curves agree best (1 where exposures were given); `largest_step_error_after_power`: that of the exposures once this one is undone.
    EVs are relative to the reference bracket; steps lead from one exposure to the next brighter one."""
    x, y = (t.cpu().double().numpy() for t in run.tonemapper.curve(0))
    at = np.linspace(0, 1, 256) ** 2.2
    true = np.stack([np.interp(at, truth.response_x, c) for c in truth.response_y])

    def rmse(p: float) -> float:
        return float(np.sqrt(np.mean((np.stack([np.interp(at**p, x, c) for c in y]) - true) ** 2)))

    known, learned = exposure_pairs(run, truth)
    steps, found = (np.diff(ev[np.argsort(known, kind="stable")]) for ev in (known, learned))
    power = float(learned @ known / (known @ known)) if known.any() else 1.0
    power = power if power > 0 else 1.0
    of_response = 1.0 if run.scene.manifest.exposure_given else float(min(POWERS, key=rmse))
    errors: dict[str, Any] = {
        "response_rmse": rmse(1.0),
        "power": power,
        "response_rmse_after_power": rmse(power),
        "power_of_response": of_response,
        "true_ev": [round(float(e), 4) for e in known],
        "learned_ev": [round(float(e), 4) for e in learned],
        "largest_ev_error": float(np.abs(learned - known).max()),
    }
    if len(steps):
        errors |= {
            "true_ev_steps": [round(float(e), 4) for e in steps],
            "learned_ev_steps": [round(float(e), 4) for e in found],
            "largest_step_error": float(np.abs(found - steps).max()),
            "largest_step_error_after_power": float(np.abs(found / of_response - steps).max()),
        }
    thin = slice(None, None, 5)
    return errors | {"true_response": {"x": at[thin].tolist(), "y": true[:, thin].tolist()}}


def exposure_pairs(run: Run, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """True and learned EV of every bracket of the truth, relative to its reference bracket."""
    ev = run.tonemapper.exposures().cpu().double().numpy()
    match = match_brackets(truth.bracket_ev, ev.tolist())
    reference = truth.reference_bracket
    known = np.array(truth.bracket_ev) - truth.bracket_ev[reference]
    return known, np.array([ev[match[b]] - ev[match[reference]] for b in range(len(known))])


def trajectory_errors(run: Run, truth: Truth, targets: Sequence[Target]) -> dict[str, float]:
    """Errors of poses and focal length; empty where the truth has neither."""
    paths = trajectories(run, truth)
    errors = {} if paths is None else alignment.pose_errors(*paths)
    if truth.K is not None and targets:
        camera = targets[0].view.camera  # at the size of the truth's pictures, which is the size of its K
        errors |= {
            "focal": float(camera.K[0, 0]),
            "true_focal": truth.K[0][0],
            "focal_error": float(camera.K[0, 0]) / truth.K[0][0] - 1,
        }
    return errors
