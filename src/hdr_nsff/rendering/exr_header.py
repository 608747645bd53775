"""What the header of a rendered EXR says about its numbers: their unit, their primaries
and their white.

Radiance is in units of the learned camera, per channel: (1, 1, 1) is what saturates at
the reference exposure, not a gray. `--white-balance neutral` multiplies by the gains of
`ToneMapper.neutral`. Scaling channels moves the white of an RGB space and none of its
primaries, so the header can name the chromaticities of either. The pictures that the
camera records are taken for Rec. 709, where neutral is the white point D65.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from hdr_nsff.core.exr import REC709
from hdr_nsff.maths.hdr_signal import rgb_to_xyz
from hdr_nsff.training.run_folder import Run

WhiteBalance = Literal["camera", "neutral"]


def neutral_gains(run: Run, camera_id: int) -> np.ndarray:
    """Gains (3,) float32 that make mid gray neutral; their geometric mean is 1."""
    return run.tonemapper.neutral(camera_id).detach().cpu().numpy().astype(np.float32)


def balance(run: Run, radiance: np.ndarray, choice: WhiteBalance, camera_id: int) -> np.ndarray:
    """Radiance (..., 3) of the run in the chosen white balance."""
    if choice == "camera":
        return radiance
    return radiance * neutral_gains(run, camera_id)


def unbalance(run: Run, stored: np.ndarray, choice: WhiteBalance, camera_id: int) -> np.ndarray:
    """The inverse of `balance`."""
    if choice == "camera":
        return stored
    return stored / neutral_gains(run, camera_id)


def radiance_header(run: Run, choice: WhiteBalance, camera_id: int) -> dict[str, Any]:
    """EXR attributes of radiance in the chosen white balance; docs/formats.md#exr."""
    gains = neutral_gains(run, camera_id)
    identity = np.ones(3, np.float32)
    applied, missing = (identity, gains) if choice == "camera" else (gains, identity)
    brackets = " ".join(f"{ev:+.3f}" for ev in run.tonemapper.exposures().tolist())
    meaning = (
        "linear radiance; `exposure` is its EV relative to the reference bracket, where 1 "
        "saturates before `appliedWhiteBalance`; times `neutralWhiteBalance`, gray is "
        "neutral; bracketEV: the clip's"
    )
    return {
        "exposure": 0.0,
        "bracketEV": brackets,
        "appliedWhiteBalance": attribute(applied),
        "neutralWhiteBalance": attribute(missing),
        "chromaticities": (*REC709[:6], *white_of(missing)),
        "adoptedNeutral": REC709[6:],
        "comments": meaning,
    }


def attribute(gains: np.ndarray) -> str:
    """Three gains as text: EXR libraries differ in what vectors they read."""
    return " ".join(f"{gain:.6g}" for gain in gains.tolist())


def white_of(gains: np.ndarray) -> tuple[float, float]:
    """Chromaticity (x, y) of (1, 1, 1) in an RGB space that `gains` (3,) turn into
    linear Rec. 709.
    """
    x, y, z = rec709_to_xyz() @ gains.astype(np.float64)
    total = x + y + z
    return float(x / total), float(y / total)


def rec709_to_xyz() -> np.ndarray:
    """The matrix (3, 3) from linear Rec. 709 to CIE XYZ (SMPTE RP 177)."""
    return rgb_to_xyz(REC709)
