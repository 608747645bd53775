"""AgX and Khronos PBR Neutral: closed forms, and what the curves promise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hdr_nsff.maths.tone_curves import agx, pbr_neutral

GRAY = np.geomspace(1e-4, 1e4, 200)[:, None].repeat(3, 1)


@pytest.mark.parametrize("curve", [agx, pbr_neutral])
def test_gray_rises_to_white_and_stays_gray(curve: Callable[[np.ndarray], np.ndarray]) -> None:
    shown = curve(GRAY)
    assert shown.min() >= 0 and shown.max() <= 1 and shown[-1].min() > 0.97
    assert (np.diff(shown[:, 0]) >= 0).all()
    np.testing.assert_allclose(shown, shown[:, :1].repeat(3, 1), atol=2e-3)


def test_pbr_neutral_keeps_colors_below_its_start() -> None:
    base = np.array([[0.7, 0.3, 0.2], [0.5, 0.5, 0.08]])
    np.testing.assert_allclose(pbr_neutral(base), base - 0.04)
    dark = np.array([[0.5, 0.3, 0.04]])  # the offset is x - 6.25 x^2 of the darkest channel
    np.testing.assert_allclose(pbr_neutral(dark), dark - (0.04 - 6.25 * 0.04**2))


def test_pbr_neutral_compresses_by_a_hyperbola_and_desaturates() -> None:
    peak = 3.96  # of red, once 0.04 are taken away
    new_peak = 1 - 0.24**2 / (peak + 0.24 - 0.76)
    gray = 1 - 1 / (0.15 * (peak - new_peak) + 1)
    red = pbr_neutral(np.array([4.0, 0.54, 0.54]))
    assert red[0] == pytest.approx(new_peak)
    assert red[1] == pytest.approx((1 - gray) * 0.5 * new_peak / peak + gray * new_peak)


def test_agx_is_its_polynomial_in_stops() -> None:
    """Mid gray, on gray, where both matrices do nothing."""
    x = (np.log2(0.18) + 12.47393) / 16.499999
    powers = [15.5 * x**6, -40.14 * x**5, 31.96 * x**4, -6.868 * x**3, 0.4298 * x**2, 0.1191 * x]
    expected = (sum(powers) - 0.00232) ** 2.2
    np.testing.assert_allclose(agx(np.full(3, 0.18)), expected, rtol=2e-3)
