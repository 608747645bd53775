"""The camera that makes footage: response curves, exposure, noise, 8 bits."""

import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.radiometry.recording import Noise, record, response_curve, vignette

GRAY = (1.0, 1.0, 1.0)
NAMES = ["film", "log", "gamma", "srgb"]


@pytest.mark.parametrize("name", NAMES)
def test_response_rises_from_zero_to_one(name: str) -> None:
    curve = response_curve(name)
    assert curve.y.shape == (3, 256)
    np.testing.assert_allclose(curve.y[:, [0, -1]], [[0, 1]] * 3, atol=1e-12)
    assert (np.diff(curve.y, axis=1) > 0).all() and (np.diff(curve.x) > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_response_and_its_inverse_cancel(name: str) -> None:
    exposure = np.random.default_rng(0).random((50, 3))
    curve = response_curve(name)
    np.testing.assert_allclose(curve.invert(curve.apply(exposure)), exposure, atol=1e-12)


def test_film_is_no_gamma_curve_and_differs_between_channels() -> None:
    """The local exponent d log y / d log x of a gamma curve is one number; film's
    changes by more than half of it.
    """
    curve = response_curve("film")
    slope = np.gradient(np.log(curve.y[:, 8:]), axis=1) / np.gradient(np.log(curve.x[8:]))
    assert (slope.max(1) / slope.min(1) > 1.5).all()
    assert np.abs(curve.y[0] - curve.y[2]).max() > 0.05


def test_one_stop_more_doubles_the_linear_value() -> None:
    radiance = np.full((4, 4, 3), 0.2)
    curve, rng = response_curve("film"), np.random.default_rng(0)
    dark, bright = (curve.invert(record(radiance, ev, GRAY, curve, None, rng)) for ev in (0.0, 1.0))
    np.testing.assert_allclose(bright / dark, 2.0, rtol=0.03)  # 8 bits: half a level of about 100


def test_white_balance_is_a_gain_per_channel_before_the_response() -> None:
    radiance = np.full((1, 1, 3), 0.25)
    curve = response_curve("gamma")
    rgb = record(radiance, 0.0, (1.0, 2.0, 4.0), curve, None, np.random.default_rng(0))
    # 0.25^(1/2.2) = 0.5325 -> 136/255; 0.5^(1/2.2) = 0.7297 -> 186/255; the third
    # channel saturates
    np.testing.assert_allclose(rgb[0, 0] * 255, [136, 186, 255], atol=1e-4)


def test_recorded_values_are_whole_levels_and_clip() -> None:
    radiance = np.geomspace(1e-5, 1e5, 300).reshape(10, 10, 3)
    rgb = record(radiance, 0.0, GRAY, response_curve("film"), Noise(), np.random.default_rng(0))
    assert rgb.dtype == np.float32 and rgb.min() >= 0 and rgb.max() == 1
    np.testing.assert_allclose(rgb * 255, np.rint(rgb * 255), atol=1e-4)


def test_noise_has_the_stated_variance_and_the_seed_repeats_it() -> None:
    """At exposure 0.24: read 1e-3, shot 1/6000: sqrt(1e-6 + 4e-5) = 0.0064."""
    radiance = np.full((200, 200, 3), 0.24)
    curve = response_curve("gamma")
    a, b = (record(radiance, 0.0, GRAY, curve, Noise(), np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert curve.invert(a).std() == pytest.approx(0.0064, rel=0.05)


def test_a_short_exposure_is_relatively_noisier() -> None:
    radiance = np.full((100, 100, 3), 0.5)
    curve, rng = response_curve("film"), np.random.default_rng(0)
    long, short = (
        curve.invert(record(radiance, ev, GRAY, curve, Noise(), rng)) for ev in (0.0, -4.0)
    )
    assert (
        short.std() / short.mean() > 3 * long.std() / long.mean()
    )  # shot noise alone: sqrt(16) = 4


def test_light_falls_off_by_the_fourth_power_of_the_cosine() -> None:
    """At 45 degrees from the axis cos^4 is 1/4; half the strength takes half as much
    away. On the axis all light passes.
    """
    K = np.array([[2.0, 0, 2.5], [0, 2.0, 0.5], [0, 0, 1]])
    assert vignette(1, 5, K, 1.0)[0, :, 0] == pytest.approx(
        [0.25, 0.64, 1.0, 0.64, 0.25]
    )  # tangents -1, -1/2, 0, 1/2, 1
    assert vignette(1, 5, K, 0.5)[0, 0, 0] == pytest.approx(0.625)
    assert (vignette(4, 4, K, 0.0) == 1).all()


def test_a_log_curve_gives_equal_ratios_equal_steps() -> None:
    """Well above 1/250: doubling adds ln 2 / ln 251."""
    values = response_curve("log").apply(np.full((3, 3), [[0.25], [0.5], [1.0]]))
    np.testing.assert_allclose(np.diff(values, axis=0), np.log(2) / np.log(251), rtol=0.02)


def test_unknown_response_is_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match="use film, log, gamma or srgb"):
        response_curve("kodak")
