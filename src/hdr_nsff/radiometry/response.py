"""What the cameras of a clip do to radiance: response curves, exposures, white balance.

`prepare` estimates them once (`estimate_response.py`) and writes them as
`response.json`. The tone mapper starts there, and flow is refined on frames brought to
one exposure through them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Source = Literal["static points", "brightness", "one exposure"]


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
    num_points: int  # points used
    guessed: bool  # the common factor of all `ev` is the likeliest one, not measured
    own_curves: tuple[int, ...]  # cameras with a curve of their own, of several cameras
    problem: str = ""  # why not from static points, in words
    num_moving: int = 0  # of these points, those on movers; not stored
    # what pixels say against given exposures of frames, in words; not stored
    disagreement: str = ""
    # where no exposure was known: the common factor that would turn all `ev` into what
    # the recordings alone say, and its 95 % interval; else 1
    measured_scale: float = 1.0
    scale_low: float = 1.0
    scale_high: float = 1.0
    # (V,) stops by which the views differ from their brackets, mean 0 over a bracket;
    # None: not at all. `prepare` writes it to the frames of scene.json.
    drift: np.ndarray | None = None

    @property
    def moved_stops(self) -> float:
        """By how much the widest range of exposures was moved to usual steps."""
        return abs(1 - self.measured_scale) * float(np.ptp(self.ev))
