"""PQ and HLG against the code values of BT.2100 and BT.2408, and back."""

from __future__ import annotations

import numpy as np
import pytest

from hdr_nsff.maths.hdr_signal import (
    KNEE_NITS,
    PEAK_NITS,
    Transfer,
    decode,
    display_light,
    encode,
    hlg_inverse_oetf,
    hlg_oetf,
    pq_encode,
    rec709_to_rec2020,
    roll_off,
    ycbcr_planes,
)

both = pytest.mark.parametrize("transfer", ["hlg", "pq"])


def test_pq_has_the_published_values() -> None:
    nits = np.array([0, 100, 203, 1000, 4000, 10000.0])
    published = [0, 0.5081, 0.5807, 0.7518, 0.9026, 1]
    np.testing.assert_allclose(pq_encode(nits), published, atol=6e-5)


def test_hlg_has_the_published_values() -> None:
    np.testing.assert_allclose(
        hlg_oetf(np.array([0, 1 / 12, 0.265, 1])), [0, 0.5, 0.75, 1], atol=1e-3
    )
    white = np.full(3, 203.0)  # on a display of 1000 nits
    np.testing.assert_allclose(encode(white, "hlg"), 0.75, atol=1e-3)
    np.testing.assert_allclose(encode(np.full(3, 1000.0), "hlg"), 1, atol=1e-6)


def test_hlg_is_smooth_where_its_two_parts_meet() -> None:
    around = hlg_oetf(1 / 12 + np.array([-1e-6, 0, 1e-6]))
    assert np.ptp(around) < 1e-5
    signal = np.linspace(0, 1, 50)
    np.testing.assert_allclose(hlg_oetf(hlg_inverse_oetf(signal)), signal, atol=1e-7)


@both
def test_light_survives_the_round_trip(transfer: Transfer) -> None:
    light = display_light(np.random.default_rng(0).uniform(0, 6, (500, 3)), 1.0, transfer)
    np.testing.assert_allclose(decode(encode(light, transfer), transfer), light, rtol=1e-5)


def test_primaries_change_by_the_matrix_of_bt_2087() -> None:
    published = [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
    np.testing.assert_allclose(rec709_to_rec2020(np.eye(3)).T, published, atol=1e-4)


@both
def test_diffuse_white_is_203_nits(transfer: Transfer) -> None:
    np.testing.assert_allclose(display_light(np.full(3, 0.5), 2.0, transfer), 203, rtol=1e-6)


def test_highlights_roll_off_without_a_corner_or_a_clip() -> None:
    nits = np.linspace(0, 50_000, 50_001)
    shown = roll_off(nits)
    slope = np.diff(shown)
    assert np.array_equal(shown[nits <= KNEE_NITS], nits[nits <= KNEE_NITS])
    assert (slope > 0).all() and shown.max() < PEAK_NITS
    assert np.abs(np.diff(slope)).max() < 0.005


@both
def test_saturated_lamps_keep_their_hue_and_stay_in_range(transfer: Transfer) -> None:
    lamps = np.random.default_rng(1).uniform(0, 1, (300, 3)) ** 4 * 1000
    lamps = np.concatenate([lamps, np.eye(3) * 1e4])
    light = display_light(lamps, 1.0, transfer)
    wanted = rec709_to_rec2020(lamps)
    hue = light / light.sum(-1, keepdims=True)
    np.testing.assert_allclose(hue, wanted / wanted.sum(-1, keepdims=True), atol=1e-9)
    np.testing.assert_allclose(
        decode(encode(light, transfer), transfer), light, rtol=1e-4, atol=1e-6
    )


def test_codes_are_those_of_limited_range() -> None:
    signal = np.zeros((2, 6, 3))
    signal[:, 2:4] = 1
    y, cb, cr = ycbcr_planes(signal)
    assert y[0].tolist() == [64, 64, 940, 940, 64, 64]
    assert (cb == 512).all() and (cr == 512).all()
    _, cb, cr = ycbcr_planes(np.broadcast_to([0.0, 0, 1], (2, 4, 3)))
    assert (cb == 960).all() and cr.shape == (1, 2)
