"""The learned camera and the estimated poses against the true ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hdr_nsff import alignment
from hdr_nsff.run import Run
from hdr_nsff.scores.targets import Target, match_brackets, trajectories
from hdr_nsff.truth import Truth


def camera_errors(run: Run, truth: Truth) -> dict[str, Any]:
    """The learned response and exposures against the true ones.

    `response_rmse`: recorded value, over exposures evenly spaced in x^(1/2.2). `power` p: where exposures are learned, radiance is known
    up to a power only; p is what the learned exposures are of the true ones, `response_rmse_after_power` the error once it is undone."""
    x, y = (t.cpu().double().numpy() for t in run.tonemapper.curve(0))
    at = np.linspace(0, 1, 256) ** 2.2
    true = np.stack([np.interp(at, truth.response_x, c) for c in truth.response_y])

    def rmse(p: float) -> float:
        return float(np.sqrt(np.mean((np.stack([np.interp(at**p, x, c) for c in y]) - true) ** 2)))

    ev = run.tonemapper.exposures().cpu().double().numpy()
    match = match_brackets(truth.bracket_ev, ev.tolist())
    reference = truth.reference_bracket
    known = np.array(truth.bracket_ev) - truth.bracket_ev[reference]
    learned = np.array([ev[match[b]] - ev[match[reference]] for b in range(len(known))])
    power = float(learned @ known / (known @ known)) if known.any() else 1.0
    power = power if power > 0 else 1.0
    thin = slice(None, None, 5)
    return {
        "response_rmse": rmse(1.0),
        "power": power,
        "response_rmse_after_power": rmse(power),
        "true_ev": [round(float(e), 4) for e in known],
        "learned_ev": [round(float(e), 4) for e in learned],
        "largest_ev_error": float(np.abs(learned - known).max()),
        "true_response": {"x": at[thin].tolist(), "y": true[:, thin].tolist()},
    }


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
