"""The learned camera and the estimated poses against the true ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hdr_nsff.evaluation.targets import Target, trajectories
from hdr_nsff.geometry import alignment
from hdr_nsff.radiometry.recording import Curve
from hdr_nsff.scene.truth import Truth, scene_brackets
from hdr_nsff.training.run_folder import Run

POWERS = np.geomspace(0.25, 4, 385)  # tried for the response, 0.7 % apart


def camera_errors(run: Run, truth: Truth) -> dict[str, Any]:
    """The learned response and exposures against the true ones; empty where the true
    response is not known.

    `response_rmse`: root mean square error of the recorded value in [0, 1], over
    exposures evenly spaced in x^(1/2.2) and the three channels. The scale is fixed, for
    both curves reach 1 at exposure 1. Where exposures are learned, radiance is known up
    to a power p only: if E explains the clip through a curve g, then so does E^p
    through g(x^(1/p)) and exposures p times as far apart (in EV). That gauge is found
    in one of the two and taken out of the other, so that neither is compared with
    itself: `power`: what the learned exposures are of the true ones, least squares;
    `response_rmse_after_power`: the error once it is undone; `power_of_response`: at
    which the curves agree best (1 where exposures were given);
    `largest_step_error_after_power`: that of the exposures once this one is undone. EVs
    are relative to the reference bracket; steps lead from one exposure to the next
    brighter one.
    """
    if truth.response is None:
        return {}
    own = Curve(*(t.cpu().double().numpy() for t in run.tonemapper.curve(0)))
    at = np.linspace(0, 1, 256)[:, None].repeat(3, 1) ** 2.2  # (256, 3)
    true = truth.response.apply(at)

    def rmse(p: float) -> float:
        return float(np.sqrt(np.mean((own.apply(at**p) - true) ** 2)))

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
    return errors | {"true_response": {"x": at[thin, 0].tolist(), "y": true[thin].T.tolist()}}


def exposure_pairs(run: Run, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """True and learned EV of every bracket of the truth that the scene has, relative to
    its reference bracket.
    """
    ev = run.tonemapper.exposures().cpu().double().numpy()
    match = scene_brackets(truth, run.scene.manifest.frames, ev.tolist())
    reference = truth.reference_bracket
    true_ev, brackets = np.array(truth.bracket_ev, np.float64), sorted(match)
    return true_ev[brackets] - true_ev[reference], ev[[match[b] for b in brackets]] - ev[
        match[reference]
    ]


def trajectory_errors(run: Run, truth: Truth, targets: Sequence[Target]) -> dict[str, float]:
    """Errors of poses and of the focal length of the clip's first frame; empty where
    the truth has neither.
    """
    paths = trajectories(run, truth)
    errors = {} if paths is None else alignment.pose_errors(*paths)
    m, first = run.scene.manifest, run.scene.manifest.frames[0]
    if truth.K is not None and targets and first.K is not None:
        focal = (
            first.K[0][0] * targets[0].view.camera.width / m.width
        )  # at the size of the truth's pictures, which is that of its K
        errors |= {
            "focal": focal,
            "true_focal": truth.K[0][0],
            "focal_error": focal / truth.K[0][0] - 1,
        }
    return errors
