"""Differences at uneven times, in closed form."""

import numpy as np

from hdr_nsff.maths.differences import differences


def test_differences_vanish_on_polynomials_below_their_order_whatever_the_spacing() -> None:
    t = np.array([0, 1, 3, 4, 5, 7.0])
    known = np.ones(5, bool)
    assert differences(t, known, 3).shape == (3, 6)
    assert np.allclose(differences(t, known, 3) @ (2 - t + 0.3 * t**2), 0, atol=1e-9)
    assert np.allclose(differences(t, known, 2) @ (2 - t), 0, atol=1e-9)
    assert np.abs(differences(t, known, 3) @ t**3).min() > 1


def test_differences_at_even_times_are_the_usual_ones() -> None:
    known = np.ones(3, bool)
    assert np.allclose(differences(np.arange(4.0), known, 3), [[-1, 3, -3, 1]])
    assert np.allclose(differences(2 * np.arange(4.0), known, 2), [[1, -2, 1, 0], [0, 1, -2, 1]])


def test_differences_do_not_cross_an_unknown_step() -> None:
    t = np.arange(6.0)
    assert len(differences(t, np.array([1, 1, 0, 1, 1], bool), 3)) == 0
    assert len(differences(t, np.array([1, 1, 0, 1, 1], bool), 2)) == 2
