"""Drift of exposure and white balance, from points that frames share."""

import itertools

import numpy as np
import pytest
from test_check import still_scene

from hdr_nsff.check.drift import DriftTuning, measure_drift, range_over_frames
from hdr_nsff.priors.poses.matching import detect_keypoints
from hdr_nsff.radiometry.exposure_cycle import Cycle

FRAMES = 6


def clip_with(gains: np.ndarray) -> np.ndarray:
    """The still scene (T, H, W, 3) through gains (T, 3), recorded by a gamma of 2.2."""
    scene = 0.5 * still_scene(0)
    return np.stack([np.clip(scene * g, 0, 1) ** (1 / 2.2) for g in gains]).astype(np.float32)


@pytest.mark.parametrize(("exposure", "color"), [(0.0, 0.0), (0.6, 0.0), (0.0, 0.5), (0.6, 0.5)])
def test_exposure_and_color_drift_apart(exposure: float, color: float) -> None:
    ramp = np.linspace(-0.5, 0.5, FRAMES)
    stops = exposure * ramp[:, None] + color * ramp[:, None] * np.array([1.0, 0.0, 0.0])
    video = clip_with(2.0**stops)
    keypoints = detect_keypoints(video, np.zeros(video.shape[:3], bool))
    one = Cycle(1, [0] * FRAMES, [0], [0.0], 0.0)
    found = measure_drift(video, one, keypoints)
    assert found.color_ev == pytest.approx(color, abs=0.05)
    if not color:  # red is a part of the brightness
        assert found.exposure_ev == pytest.approx(exposure, abs=0.05)


def test_pairs_that_contradict_each_other_show_no_drift() -> None:
    pairs = list(itertools.combinations(range(6), 2))
    steady = np.array([0.1 * (j - i) for i, j in pairs])
    assert range_over_frames(pairs, steady, DriftTuning()) == pytest.approx(2.2 * 0.5)
    noise = np.random.default_rng(0).normal(0, 1, len(pairs))
    assert range_over_frames(pairs, noise, DriftTuning()) == 0.0
    assert range_over_frames([], np.zeros(0), DriftTuning()) == 0.0
