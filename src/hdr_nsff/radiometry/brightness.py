"""Exposures of brackets from the brightness of whole images, where nothing better is
known.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from hdr_nsff.radiometry.log_curve import GAMMA, HIGH, LOW


def brightness_ev(
    images: Sequence[np.ndarray], brackets: Sequence[int], reference: int, num_brackets: int
) -> list[float]:
    """EV of every bracket (B,) from the brightness of whole images alone.

    The quantiles of the gray levels are compared between brackets next to each other in
    brightness, where both are away from black and saturation, through gamma 2.2. Good
    to half a stop where all `images` (H, W, 3) show the same scene.
    """
    levels = {}
    for b in set(brackets):
        gray = [i.mean(-1).ravel() for i, j in zip(images, brackets, strict=True) if j == b]
        levels[b] = np.quantile(np.concatenate(gray), np.linspace(0.02, 0.98, 97))
    order = sorted(levels, key=lambda b: float(np.median(levels[b])))
    ev = {order[0]: 0.0}
    for dark, light in itertools.pairwise(order):
        both = (levels[dark] > LOW) & (levels[light] < HIGH)
        step = 1.0
        if both.any():
            ratio = np.log2(levels[light][both] / levels[dark][both]) * GAMMA
            step = float(np.median(ratio))
        ev[light] = ev[dark] + step
    reference_ev = ev.get(reference, 0.0)
    return [ev.get(b, reference_ev) - reference_ev for b in range(num_brackets)]
