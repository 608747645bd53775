"""A reversed solution of a tumbling body is recognized by perspective."""

import numpy as np
import pytest
from tumbling_body import (
    TIMES,
    flat_problem,
    points_of_state,
    relief_correlation,
    rotation_errors,
    true_state,
)

from hdr_nsff.priors.movers.depth_reversal import reverse_depth, undo_depth_reversals


@pytest.mark.parametrize("split", [8, 11, TIMES])
def test_a_reversed_solution_is_recognized_and_undone(split: int) -> None:
    problem = flat_problem()
    wrong, cost = problem.minimize(reverse_depth(problem, true_state(problem), split), 25)
    assert relief_correlation(points_of_state(wrong)).min() < 0  # steps alone do not escape
    right = undo_depth_reversals(problem, wrong, cost)
    assert relief_correlation(points_of_state(right)).min() > 0.99
    assert rotation_errors(right.rotations).max() < 0.3


def test_a_reversed_body_looks_nearly_the_same() -> None:
    problem = flat_problem()
    true = true_state(problem)
    mirrored = reverse_depth(problem, true, TIMES)
    assert np.linalg.det(mirrored.rotations) == pytest.approx(np.ones(TIMES))
    assert relief_correlation(points_of_state(mirrored)).max() < -0.9
    error = np.linalg.norm(problem.reproject(mirrored).error, axis=-1)[problem.visible]
    assert np.linalg.norm(problem.reproject(true).error, axis=-1).max() < 1e-9
    assert np.median(error) < 12  # px; it is 80 px wide
