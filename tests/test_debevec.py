"""Debevec's least squares against simulated cameras: response and exposures come back,
outliers do not matter.
"""

from dataclasses import replace

import numpy as np
import pytest
from wall import EV, GAMMA22, S_CURVE, SRGB, X, record, rmse

from hdr_nsff.radiometry.debevec import brackets_linked, debevec, typical_factor
from hdr_nsff.radiometry.log_curve import HIGH, LOW, SATURATED, Top, log_exposures, response_of
from hdr_nsff.radiometry.samples import Samples
from hdr_nsff.radiometry.saturation import saturation


def points(curve, ev, num=700, outliers=0.0, seed=0):
    """Random points recorded at exposures `ev`; outliers change by a stop or so."""
    rng = np.random.default_rng(seed)
    radiance = 2 ** rng.uniform(-7, 3, (num, 1, 1)) * 2 ** rng.normal(0, 0.5, (num, 1, 3))
    exposure = radiance * 2.0 ** np.array(ev)[:, None]
    wrong = rng.random((num, len(ev), 1)) < outliers
    changed = exposure * 2 ** rng.normal(0, 1, exposure.shape)
    z = record(np.where(wrong, changed, exposure), curve, rng)
    return Samples(z, (z >= LOW) & (z <= HIGH), z >= SATURATED)


@pytest.mark.parametrize("outliers", [0.0, 0.1])
@pytest.mark.parametrize("curve", [GAMMA22, SRGB, S_CURVE], ids=["gamma", "srgb", "s-curve"])
def test_the_response_is_recovered_from_known_exposures(curve, outliers):
    fit = debevec(points(curve, EV, outliers=outliers), EV, reference=2)
    assert rmse(fit.x, fit.y, curve) < 0.02
    np.testing.assert_allclose(fit.ev, EV)
    assert not fit.guessed


def test_two_exposures_suffice():
    fit = debevec(points(S_CURVE, [0.0, 3.0]), [0.0, 3.0], reference=0)
    assert rmse(fit.x, fit.y, S_CURVE) < 0.02


def test_a_lamp_that_clips_below_white_is_no_shoulder():
    """A yellow lamp: red clips in both exposures, which the video records as 0.8 and
    0.93. Nothing else is as bright.
    """
    dim = points(GAMMA22, [-3.0, 0.0], num=1500)
    shown = dim.valid & (dim.rgb < 0.7)
    rng = np.random.default_rng(1)
    lamp = np.array([[0.8, 0.78, 0.1], [0.93, 0.96, 0.25]]) + rng.normal(0, 0.01, (100, 2, 3))
    rgb = np.concatenate([dim.rgb, lamp])
    valid = np.concatenate([shown, np.ones((100, 2, 3), bool)])
    fit = debevec(Samples(rgb, valid, np.zeros(valid.shape, bool)), [-3.0, 0.0], reference=1)
    for channel in fit.y:
        middle, bright = np.interp([0.5, 0.9], channel, fit.x)
        assert np.log2(bright / middle) == pytest.approx(2.2 * np.log2(0.9 / 0.5), abs=0.4)


def test_unknown_exposures_of_a_typical_camera_are_recovered():
    fit = debevec(points(SRGB, EV, outliers=0.05), [None, None, None], reference=2)
    assert fit.guessed
    np.testing.assert_allclose(fit.ev, EV, atol=0.15)
    assert rmse(fit.x, fit.y, SRGB) < 0.03


@pytest.mark.parametrize("curve", [GAMMA22, SRGB, S_CURVE], ids=["gamma", "srgb", "s-curve"])
@pytest.mark.parametrize(
    "ev", [EV, [-3.0, 0.0], [0.0, 1.0, 2.0]], ids=["2 stops", "3 stops", "1 stop"]
)
def test_unknown_exposures_in_whole_stops_are_recovered_for_any_curve(curve, ev):
    fit = debevec(points(curve, ev), [None] * len(ev), reference=len(ev) - 1)
    np.testing.assert_allclose(fit.ev, np.array(ev) - ev[-1], atol=0.08)
    assert rmse(fit.x, fit.y, curve) < 0.03


def test_ratios_of_unknown_exposures_are_measured_for_any_curve():
    ev = [-4.0, -1.0, 0.0]
    for curve in (GAMMA22, SRGB, S_CURVE):
        fit = debevec(points(curve, ev), [None, None, None], reference=2)
        assert fit.ev[1] / fit.ev[0] == pytest.approx(0.25, abs=0.02)


def test_one_known_exposure_fixes_the_factor():
    fit = debevec(points(S_CURVE, EV), [-4.0, None, 0.0], reference=2)
    assert not fit.guessed
    assert fit.ev[1] == pytest.approx(-2.0, abs=0.06)
    assert rmse(fit.x, fit.y, S_CURVE) < 0.02


def test_the_typical_factor_undoes_any_power_of_srgb():
    curves = np.zeros((3, 42))
    curves[:, 41] = 1.5  # G = 1.5 ln srgb^-1(z)
    assert typical_factor(curves) == pytest.approx(1 / 1.5)


def test_saturation_is_where_recordings_begin_to_saturate():
    """Linear camera, one channel: exposures 0.1 ... 0.4 read in the dark frame; two
    stops brighter, those above 0.25 saturate.
    """
    dark = np.linspace(0.1, 0.4, 301)[:, None]
    light = np.minimum(4 * dark, 1)
    rgb = np.stack([dark, light], 1).repeat(3, -1)  # (P, 2, 3)
    samples = Samples(rgb, (rgb > 0) & (rgb < 0.99), rgb >= 1)
    curves = np.zeros((3, 42))
    curves[:, 40] = 1.0  # G = ln z
    top = saturation(samples, curves, np.log([1.0, 4.0]))
    assert top.level == pytest.approx(0.0, abs=0.01) and (top.shown == 1).all()  # ln 1


def test_shadows_do_not_move_saturation():
    """As above, but points that fell into shadow before the brighter frame outnumber
    those that are just bright enough to saturate.
    """
    dark = np.concatenate(
        [np.linspace(0.05, 0.225, 300), np.linspace(0.23, 0.4, 30), np.linspace(0.278, 0.6, 40)]
    )[:, None]
    light = np.minimum(4 * dark, 1)
    light[300:330] = 0.3
    rgb = np.stack([dark, light], 1).repeat(3, -1)
    samples = Samples(rgb, rgb < 0.99, rgb >= 1)
    curves = np.zeros((3, 42))
    curves[:, 40] = 1.0
    top = saturation(samples, curves, np.log([1.0, 4.0]))
    assert top.level == pytest.approx(0.0, abs=0.01)


def test_a_channel_without_clipped_points_rises_as_the_others_do():
    """Of red, only what is recorded below 0.3 is seen. Grays must not get a color."""
    curve = np.stack([S_CURVE[2]] * 3)
    seen = points(curve, EV, num=3000)
    seen.valid[..., 0] &= seen.rgb[..., 0] < 0.3
    seen.saturated[..., 0] = False
    fit = debevec(seen, EV, reference=2)
    at = np.array([np.interp([0.5, 0.8], y, fit.x) for y in fit.y])
    np.testing.assert_allclose(np.log2(at / np.interp([0.5, 0.8], curve[0], X)), 0, atol=0.1)


def test_channels_that_clip_keep_their_own_curves():
    curves = np.zeros((3, 42))
    curves[:, 40] = [2.0, 2.2, 3.0]
    z = np.linspace(0.01, 0.99, 50)
    own = np.outer([2.0, 2.2, 3.0], np.log(z))
    np.testing.assert_allclose(log_exposures(z, curves, np.ones(3)), own)
    followed = log_exposures(z, curves, np.array([1.0, 1.0, 0.4]))
    np.testing.assert_allclose(followed[:2], own[:2])
    rise = np.where(z > 0.4, 2.2 * np.log(z / 0.4) + 3 * np.log(0.4), own[2])
    np.testing.assert_allclose(followed[2], rise)


def test_the_response_rises_even_where_the_fit_falls():
    curves = np.zeros((3, 42))
    curves[:, 20:30] = -3.0  # a deep dent in G
    curves[:, 40] = 2.2
    x, y = response_of(curves, Top(np.zeros(3), np.ones(3)))
    assert y[:, 0].tolist() == [0, 0, 0] and y[:, -1] == pytest.approx(1.0)
    assert (np.diff(y, axis=-1) >= 0).all() and len(x) == 256


def test_brackets_without_common_points_are_not_linked():
    samples = points(SRGB, EV)
    assert brackets_linked(samples, [0, 1, 2])
    samples.valid[:, 0] = False
    assert brackets_linked(samples, [1, 2]) and not brackets_linked(samples, [0, 1, 2])


def test_the_spread_between_frames_is_the_uncertainty_of_an_exposure():
    samples = points(SRGB, EV, num=2000)
    frame = np.arange(2000) % 10
    steady = debevec(replace(samples, frame=frame), [None] * 3, reference=2).scale
    drifting = samples.rgb * (1 + 0.15 * np.sin(frame))[:, None, None] ** [[[0], [1], [0]]]
    valid = samples.valid & (drifting < HIGH)
    unsteady = Samples(drifting, valid, samples.saturated, frame)
    fit = debevec(unsteady, [None] * 3, reference=2)
    assert steady.low < 1 < steady.high and fit.ev[1] == pytest.approx(-2, abs=0.2)
