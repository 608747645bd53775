"""The range that two frames of different exposure both recorded."""

import numpy as np

from hdr_nsff.radiometry.common_range import common_gray, recorded_range

H, W = 64, 96


def test_both_frames_are_limited_to_what_both_recorded():
    """Frame 0 holds grays 0.2 to 1, frame 1 only up to 0.5: in both, white is 0.5 and
    black is 0.2.
    """
    ramp = np.repeat(np.linspace(0.2, 1, W, dtype=np.float32)[None, :, None], H, 0).repeat(3, -1)
    video = np.stack([ramp, np.minimum(ramp, 0.5)])
    clipped = np.stack([np.zeros((H, W), bool), video[1, ..., 0] >= 0.5])
    ranges = [recorded_range(f, c) for f, c in zip(video, clipped, strict=True)]
    a, b = common_gray(video, ranges, 0, 1)
    assert np.abs(a.astype(int) - b).max() <= 1
    assert a.min() == 0 and a.max() == 255
