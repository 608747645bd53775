"""Steps of bundle adjustment, against the whole system without elimination."""

from dataclasses import replace

import numpy as np
import pytest
from tumbling_body import TIMES, flat_problem, true_state

from hdr_nsff.priors.movers.bundle_steps import solve_damped


def test_a_step_solves_the_whole_system() -> None:
    """Poses and points in one matrix, with tracks short and long, early and late."""
    problem = flat_problem()
    lives = np.random.default_rng(1).integers(0, TIMES, (len(problem.visible), 2))
    times = np.arange(TIMES)
    ends = np.maximum(lives.min(1) + 2, lives.max(1))
    problem.visible &= (times >= lives.min(1)[:, None]) & (times <= ends[:, None])
    s = true_state(problem)
    s = replace(s, points=s.points + 0.1, translations=s.translations * 1.1)
    equations, damping = problem.normal_equations(s), 1e-2
    count, size = len(equations.points), len(equations.poses)
    couplings = equations.points_poses + np.einsum(
        "ni,p->nip", equations.by_size, equations.by_distance
    )
    whole = np.zeros((size + 3 * count, size + 3 * count))
    whole[:size, :size] = equations.poses
    whole[size:, :size] = couplings.reshape(-1, size)
    whole[:size, size:] = couplings.reshape(-1, size).T
    for n, block in enumerate(equations.points):
        rows = slice(size + 3 * n, size + 3 * n + 3)
        whole[rows, rows] = block
    whole[np.diag_indices(len(whole))] *= 1 + damping
    gradient = np.concatenate([equations.pose_gradient, equations.point_gradient.reshape(-1)])
    expected = np.linalg.solve(whole, -gradient)
    pose_step, point_step = solve_damped(equations, problem.visible, damping)
    found = np.concatenate([pose_step, point_step.reshape(-1)])
    assert found == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())
