"""Gain maps bring the HDR picture back, on a screen with enough headroom."""

import numpy as np

from hdr_nsff.maths.gain_map import OFFSET, apply_gain_map, make_gain_map


def test_the_whole_gain_brings_the_hdr_picture_back() -> None:
    rng = np.random.default_rng(0)
    sdr, hdr = rng.random((5, 7, 3)), 5 * rng.random((5, 7, 3))
    gains = make_gain_map(sdr, hdr, headroom=2.3)
    assert gains.codes.min() == 0 and gains.codes.max() == 1
    assert np.allclose(apply_gain_map(sdr, gains), hdr)
    assert np.allclose(apply_gain_map(sdr, gains, stops=0.0), sdr)


def test_half_the_headroom_applies_half_the_stops() -> None:
    sdr, hdr = np.full((1, 1, 3), 0.5), np.full((1, 1, 3), 2.0)
    gains = make_gain_map(sdr, hdr, headroom=2.0)
    expected = np.sqrt((0.5 + OFFSET) * (2.0 + OFFSET)) - OFFSET
    assert np.allclose(apply_gain_map(sdr, gains, stops=1.0), expected)


def test_equal_pictures_have_gain_1() -> None:
    sdr = np.random.default_rng(1).random((4, 4, 3))
    assert np.allclose(apply_gain_map(sdr, make_gain_map(sdr, sdr, 2.0)), sdr)
