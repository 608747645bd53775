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
from hdr_nsff.priors.poses.estimate import PosesTuning, estimate_poses
from hdr_nsff.priors.poses.lens import lens_fit, shows_lens
from hdr_nsff.priors.poses.reconstruct import ReconstructionTuning
from hdr_nsff.priors.poses.view_matches import EarlierRounds

# frames that are mapped (of nine clips, 16 took up to twice as long and left a GoPro's
# lens unfound, and that of a camera that walks)
MAX_FRAMES = 12
# where the first mapping fails, others take minutes and find a lens of few frames
TUNING = PosesTuning(reconstruction=ReconstructionTuning(max_attempts=1))
# share of the frames that a lens must explain to be believed (hand-chosen: a globe that
# turns was mapped in part, with a lens that bent)
MIN_REGISTERED_SHARE = 0.9


def measure_lens(equalized: np.ndarray, clipped: np.ndarray, scale: float) -> LensFacts | None:
    """The distortion of frames at one brightness (T, H, W, 3); None where too few of
    them can be mapped, or a lens explains them better but none is found.

    `clipped` (T, H, W) bool holds no information; `scale` is the pixels of the clip per
    pixel of these.
    """
    chosen = spread_frames(len(equalized), MAX_FRAMES)
    earlier = EarlierRounds()
    with tempfile.TemporaryDirectory() as folder:
        try:
            poses = estimate_poses(
                equalized[chosen], None, Path(folder), clipped[chosen], tuning=TUNING,
                earlier=earlier, lens="auto",
            )  # fmt: skip
        except InputError:
            return None
    if poses.parallax != "full" or poses.registered.mean() < MIN_REGISTERED_SHARE:
        return None
    if not poses.lenses:
        fit = lens_fit(earlier)
        return LensFacts(0.0, 0.0, 0.0) if fit is None or not shows_lens(fit) else None
    lens = poses.lenses[0]
    k1, k2, _, _ = lens.distortion
    corner = scale * lens.max_displacement_px()
    return LensFacts(round(k1, 4), round(k2, 4), round(corner, 1))
