"""Fixed curves: known points, inverses, the display tone map; numpy and torch agree."""

import numpy as np
import pytest
import torch

from hdr_nsff.maths import color

LINEAR = np.linspace(0, 1, 101)


def test_srgb_decoding_undoes_encoding():
    encoded = color.srgb_encode(LINEAR)
    np.testing.assert_allclose(color.srgb_decode(encoded), LINEAR, atol=1e-6)
    assert encoded[0] == pytest.approx(0, abs=1e-9) and encoded[-1] == pytest.approx(1, abs=1e-6)
    assert (np.diff(encoded) > 0).all()


def test_reference_values_of_the_standards():
    assert color.srgb_encode(np.array(0.18)) == pytest.approx(0.4614, abs=1e-4)
    assert color.pu21_encode(np.array(100.0)) == pytest.approx(256, abs=1)
    assert color.mu_law(np.array(0.1), mu=50.0) == pytest.approx(np.log(6) / np.log(51))


def test_numpy_and_torch_agree():
    rgb = np.random.default_rng(0).gamma(0.5, 4.0, (20, 3))
    curves = (
        color.srgb_encode,
        color.mu_law,
        color.pu21_encode,
        color.display,
        color.luminance,
    )
    for curve in curves:
        from_torch = curve(torch.from_numpy(rgb)).numpy()
        np.testing.assert_allclose(from_torch, curve(rgb), rtol=1e-9, atol=1e-12)
    assert color.auto_exposure(torch.from_numpy(rgb)) == pytest.approx(color.auto_exposure(rgb))


def test_auto_exposure_brings_gray_to_the_key_also_with_a_lamp_in_view():
    room = np.full((1000, 3), 0.02)
    lamp = room.copy()
    lamp[:15] = 500.0  # 1.5 % of the pixels
    assert color.auto_exposure(room) == pytest.approx(0.18 / 0.02)
    assert color.auto_exposure(lamp) == pytest.approx(0.18 / 0.02)


def test_the_display_shows_five_decades_in_order_and_in_range():
    gray = np.geomspace(1e-3, 1e2, 60)[:, None].repeat(3, 1)
    shown = color.display(gray)
    assert shown.min() >= 0 and shown.max() <= 1
    below_white = gray[:, 0] < 40
    assert (np.diff(shown[below_white, 0]) > 0).all() and (shown[~below_white] > 0.999).all()


def test_bright_colors_lose_saturation_not_hue():
    red = np.array([[30.0, 3.0, 1.0]])
    shown = color.srgb_decode(color.display(red))[0]
    assert shown[0] == pytest.approx(1.0, abs=1e-6) and shown[0] > shown[1] > shown[2] > 0.1
    y, y_shown = color.luminance(red)[0], color.luminance(shown)
    assert y_shown == pytest.approx(y * (1 + y / 1600) / (1 + y), rel=1e-6)  # the curve's
    chroma, chroma_shown = red[0] - y, shown - y_shown
    np.testing.assert_allclose(chroma[1] / chroma[2], chroma_shown[1] / chroma_shown[2])


def test_black_stays_black():
    assert (color.display(np.zeros((2, 3))) == 0).all()
