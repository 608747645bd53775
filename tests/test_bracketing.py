"""The usual steps between exposures settle the common factor that recordings leave
open.
"""

import numpy as np
import pytest

from hdr_nsff.radiometry.bracketing import likely_factor, usual_steps


@pytest.mark.parametrize("measured, meant", [
    ([-2.36, 0, 2.35], [-2, 0, 2]),  # a contrasty film curve
    ([-3.66, 0, 3.51], [-3, 0, 3]),  # the same, three stops
    ([0, 1.92, 3.84], [0, 2, 4]),  # real video
    ([0, 2.88], [0, 3]),
    ([0, 1.07], [0, 1]),
    ([0, 1.18, 3.54], [0, 1, 3]),  # steps that differ
])  # fmt: skip
def test_whole_stops_are_found_behind_a_curve_that_is_not_typical(measured, meant):
    np.testing.assert_allclose(np.array(measured) * likely_factor(measured), meant, atol=0.08)


def test_a_half_step_measured_to_the_point_stays_one():
    assert likely_factor([0, 1.5]) == pytest.approx(1)
    assert likely_factor([0, 1 / 3, 2 / 3]) == pytest.approx(1)


def test_order_and_offset_do_not_change_the_factor():
    ev = np.array([-2.36, 0, 2.35])
    for other in (ev[::-1], ev[[1, 2, 0]], ev + 5, np.repeat(ev, 2)):
        assert likely_factor(other) == pytest.approx(likely_factor(ev))


@pytest.mark.parametrize("ev", [[0.0], [0.0, 0.0], [1.0, 1.1]])
def test_without_a_step_the_factor_is_one(ev):
    assert likely_factor(ev) == 1.0


def test_the_factor_stays_near_one_for_any_steps():
    for step in np.linspace(0.25, 20, 80):
        assert 0.3 < likely_factor([0, step]) < 2


def test_usual_steps_are_chances():
    chances = usual_steps()
    assert sum(chances.values()) == pytest.approx(1)
    assert min(chances.values()) > 0
    assert max(chances, key=chances.get) == 2
