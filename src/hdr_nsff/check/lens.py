"""How much the lens of a clip distorts, by structure from motion on a few frames, as
`prepare` finds it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from hdr_nsff.check.facts import LensFacts
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.stack import spread_frames
from hdr_nsff.priors.poses.estimate import estimate_poses

# frames that are mapped (hand-chosen: seconds, and enough for one lens)
MAX_FRAMES = 16


def measure_lens(equalized: np.ndarray, clipped: np.ndarray, scale: float) -> LensFacts | None:
    """The distortion of frames at one brightness (T, H, W, 3); None where too few of
    them can be mapped.

    `clipped` (T, H, W) bool holds no information; `scale` is the pixels of the clip per
    pixel of these.
    """
    chosen = spread_frames(len(equalized), MAX_FRAMES)
    with tempfile.TemporaryDirectory() as folder:
        try:
            poses = estimate_poses(
                equalized[chosen], None, Path(folder), clipped[chosen], lens="auto"
            )
        except InputError:
            return None
    if poses.parallax != "full":
        return None
    if not poses.lenses:
        return LensFacts(0.0, 0.0, 0.0)
    lens = poses.lenses[0]
    k1, k2, _, _ = lens.distortion
    corner = scale * lens.max_displacement_px()
    return LensFacts(round(k1, 4), round(k2, 4), round(corner, 1))
