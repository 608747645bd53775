"""The white balance of every frame, as a GoPro wrote it into its video."""

from __future__ import annotations

import numpy as np

from hdr_nsff.prepare.exposures import gopro_metadata
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry.frame_colors import FrameColorsTuning


def given_white_balance(work: Work) -> np.ndarray | None:
    """The white balance (T, 3) of all frames in stops, relative to their mean; None
    where nothing gives it, or it stays the same.

    Channels have the mean 0 in every frame, and frames in every channel. Read of one
    camera, unless `auto` asks for what the pixels show.
    """
    c = work.config
    several = work.manifest.num_cameras > 1 or work.manifest.num_tracks > 1
    if work.capture is not None or not work.footage.video or several:
        return None
    (written,) = gopro_metadata(work)
    if written is None or written.colors is None or "auto" in (c.exposures, c.ev):
        return None
    colors = written.colors[work.frame_numbers()]
    colors = colors - colors.mean(1, keepdims=True)
    colors = colors - colors.mean(0)
    drifts = np.abs(colors).max() >= FrameColorsTuning().min_drift
    return colors if drifts else None
