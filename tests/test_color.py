"""Fixed curves: known points, inverses, and the display tone map's promises; numpy and
torch give the same.
"""

import numpy as np
import pytest
import torch

from hdr_nsff.maths import color

LINEAR = np.linspace(0, 1, 101)


@pytest.mark.parametrize("encode, decode", [
    (color.srgb_encode, color.srgb_decode), (color.gamma_encode, color.gamma_decode), (color.hlg_encode, color.hlg_decode),
])  # fmt: skip
def test_decoding_undoes_encoding(encode, decode):
    encoded = encode(LINEAR)
    np.testing.assert_allclose(decode(encoded), LINEAR, atol=1e-6)
    assert encoded[0] == pytest.approx(0, abs=1e-9) and encoded[-1] == pytest.approx(1, abs=1e-6)
    assert (np.diff(encoded) > 0).all()


def test_pq_decoding_undoes_encoding():
    nits = np.geomspace(0.01, 10000, 50)
    np.testing.assert_allclose(color.pq_decode(color.pq_encode(nits)), nits, rtol=1e-6)


def test_known_points_of_the_standards():
    assert color.srgb_encode(np.array(0.18)) == pytest.approx(0.4614, abs=1e-4)
    assert color.pq_encode(np.array(100.0)) == pytest.approx(
        0.5081, abs=1e-4
    )  # BT.2100: 100 cd/m^2
    assert color.pq_encode(np.array(10000.0)) == pytest.approx(1.0)
    assert color.hlg_encode(np.array(1 / 12)) == pytest.approx(0.5)
    assert color.pu21_encode(np.array(100.0)) == pytest.approx(256, abs=1)
    assert color.mu_law(np.array(0.1), mu=50.0) == pytest.approx(np.log(6) / np.log(51))


def test_numpy_and_torch_agree():
    rgb = np.random.default_rng(0).gamma(0.5, 4.0, (20, 3))
    curves = (
        color.srgb_encode,
        color.mu_law,
        color.pq_encode,
        color.hlg_encode,
        color.pu21_encode,
        color.display,
        color.luminance,
    )
    for curve in curves:
        np.testing.assert_allclose(
            curve(torch.from_numpy(rgb)).numpy(), curve(rgb), rtol=1e-9, atol=1e-12
        )
    assert color.auto_exposure(torch.from_numpy(rgb)) == pytest.approx(color.auto_exposure(rgb))


def test_one_stop_doubles():
    np.testing.assert_allclose(color.scale_ev(LINEAR, 1.0), 2 * LINEAR)


def test_auto_exposure_brings_gray_to_the_key_whatever_lamp_is_in_view():
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
    y = color.luminance(red)[0]
    assert color.luminance(shown) == pytest.approx(
        y * (1 + y / 1600) / (1 + y), rel=1e-6
    )  # the curve's luminance is kept
    np.testing.assert_allclose(
        (red[0] - y)[1] / (red[0] - y)[2],
        (shown - color.luminance(shown))[1] / (shown - color.luminance(shown))[2],
    )


def test_black_stays_black():
    assert (color.display(np.zeros((2, 3))) == 0).all()
