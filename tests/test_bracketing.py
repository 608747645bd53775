"""Measured steps move to usual ones only where the evidence agrees."""

import numpy as np
import pytest

from hdr_nsff.radiometry.bracketing import FACTORS, likely_scale, usual_steps


def known_to(deviation: float, factor: float = 1.0) -> np.ndarray:
    """Evidence of the sensor's noise for a factor, with this relative deviation."""
    return -((np.log(FACTORS / factor) / deviation) ** 2) / 2


@pytest.mark.parametrize("measured, meant", [
    ([0, 1.92, 3.84], [0, 2, 4]),  # real video
    ([0, 2.88], [0, 3]),
    ([0, 1.07], [0, 1]),
    ([-2.36, 0, 2.35], [-2, 0, 2]),  # a contrasty film curve
])  # fmt: skip
def test_whole_stops_are_found_behind_a_curve_that_is_not_typical(measured, meant):
    scale = likely_scale(measured)
    np.testing.assert_allclose(np.array(measured) * scale.factor, meant, atol=0.08)
    assert scale.is_moved and scale.low < scale.factor < scale.high


@pytest.mark.parametrize("true", [1.5, 1.7, 2.3, 2.4, 2.5])
def test_good_evidence_of_other_steps_is_not_overruled(true):
    evidence = known_to(0.03)
    assert likely_scale([-true, 0, true], None, evidence).factor == pytest.approx(1, abs=0.04)


def test_a_curve_alone_says_that_two_stops_may_be_something_else():
    scale = likely_scale([0.0, 2.36])
    assert scale.low * 2.36 < 2 and scale.high * 2.36 > 2.7


def test_whole_stops_outside_of_the_interval_are_not_chosen():
    scale = likely_scale([0.0, 1.75], None, known_to(0.03))
    assert not scale.is_moved and scale.high * 1.75 < 2


def test_whole_stops_need_the_whole_interval_and_halves_its_middle():
    evidence = known_to(0.05, 0.94)
    whole = likely_scale([-2.2, 0, 2.2], None, evidence)
    assert whole.factor * 2.2 == pytest.approx(2)
    half = likely_scale([-1.64, 0, 1.64], None, evidence)
    assert not half.is_moved and half.low * 1.64 < 1.5


def test_two_exposures_with_noise_leave_more_of_the_curve_open():
    evidence = known_to(0.12, 0.85)
    two, three = likely_scale([0, 3.7], None, evidence), likely_scale([0, 3.7, 7.4], None, evidence)
    assert two.high / two.low > three.high / three.low
    assert two.factor * 3.7 == pytest.approx(3)


def test_thirds_are_known_steps_where_the_interval_leaves_no_other_one():
    fine = likely_scale([0, 1.655, 3.31], None, known_to(0.01))
    assert fine.is_moved and fine.factor * 1.655 == pytest.approx(5 / 3, abs=0.002)
    coarse = likely_scale([0, 1.655, 3.31], None, known_to(0.1))
    assert coarse.factor == coarse.measured or coarse.factor * 1.655 == pytest.approx(2, abs=0.02)


def test_steps_in_no_usual_proportion_stay_as_measured():
    scale = likely_scale([-1.7, 0, 1.3], None, known_to(0.03))
    assert scale.factor == scale.measured == pytest.approx(1, abs=0.02)


def test_steps_that_points_disagree_on_are_not_held_against_usual_ones():
    measured = [0, 1.85, 4]
    assert not likely_scale(measured, None, known_to(0.03)).is_moved
    assert likely_scale(measured, [0.1, 0.1, 0.1], known_to(0.03)).is_moved


def test_more_evidence_makes_the_interval_narrower():
    with_noise = likely_scale([0.0, 2.0], None, known_to(0.03))
    without = likely_scale([0.0, 2.0])
    assert with_noise.high - with_noise.low < 0.5 * (without.high - without.low)


def test_evidence_of_the_noise_wins_against_a_curve_like_no_other():
    assert likely_scale([0.0, 1.6], None, known_to(0.03, 1.5)).measured == pytest.approx(
        1.5, abs=0.05
    )


def test_order_and_offset_do_not_change_the_factor():
    ev = np.array([-2.36, 0, 2.35])
    for other in (ev[::-1], ev[[1, 2, 0]], ev + 5, np.repeat(ev, 2)):
        assert likely_scale(other).factor == pytest.approx(likely_scale(ev).factor)


@pytest.mark.parametrize("ev", [[0.0], [0.0, 0.0], [1.0, 1.1]])
def test_without_a_step_the_factor_is_one(ev):
    assert likely_scale(ev).factor == 1.0


def test_the_factor_stays_near_one_for_any_steps():
    for step in np.linspace(0.25, 20, 80):
        assert 0.75 < likely_scale([0, step]).factor < 1.3


def test_two_exposures_are_known_less_well_and_move_no_farther_for_it():
    two, three = likely_scale([0.0, 4.0]), likely_scale([0.0, 2.0, 4.0])
    assert np.log(two.high / two.low) > 1.3 * np.log(three.high / three.low)
    assert 0.9 < two.factor < 1.1, "four stops do not become three"


def test_usual_steps_are_chances():
    chances = usual_steps()
    assert sum(chances.values()) == pytest.approx(1)
    assert min(chances.values()) > 0
    assert max(chances, key=chances.get) == 2
