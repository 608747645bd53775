"""Residuals and derivatives of the bundle problem of a tumbling body."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tumbling_body import (
    CAMERAS,
    COUNT,
    LOCAL,
    TIMES,
    TRUE,
    flat_problem,
    pixels_of,
    tracked,
    true_state,
)

from hdr_nsff.priors.movers.bundle import path_without_rotation
from hdr_nsff.priors.movers.bundle_problem import BundleProblem, BundleState
from hdr_nsff.priors.movers.rigid_motion import fit_motion
from hdr_nsff.priors.movers.tuning import BUNDLE_TUNING


def path_residuals(problem: BundleProblem, state: BundleState) -> np.ndarray:
    """The path's residuals (TIMES - 3, 3) of a state."""
    return problem.prior_residuals(state, problem.reproject(state).depth).path


def test_each_direction_of_a_path_has_its_own_smoothness() -> None:
    problem = flat_problem()
    s = true_state(problem)
    jerk = np.outer(0.2 * (-1.0) ** np.arange(TIMES), [0.6, 0.8, 0.0])
    jerky = replace(s, translations=s.translations + jerk)
    problem.fit_path_whitening(jerky)
    path = path_residuals(problem, jerky)
    assert path.shape == (TIMES - 3, 3)
    # along the line one standard deviation, across it nothing
    assert (path**2).mean(0).sum() == pytest.approx(1, abs=0.01)
    for across in (np.array([0.8, -0.6, 0.0]), np.array([0.0, 0.0, 1.0])):
        scale = np.linalg.norm(problem.path_whitening @ across)
        assert scale == pytest.approx(1 / BUNDLE_TUNING.path_sigma)


def test_the_terms_of_a_path_are_the_products_of_its_derivatives() -> None:
    problem, h = flat_problem(), 1e-6
    s = true_state(problem)
    noise = np.random.default_rng(0).normal(0, 0.05, s.translations.shape)
    s = replace(s, translations=s.translations + noise)
    problem.fit_path_whitening(s)
    path = path_residuals(problem, s)
    derivatives = np.empty((path.size, TIMES * 3))
    for k in range(TIMES * 3):
        moved = s.translations.copy()
        moved[k // 3, k % 3] += h
        change = path_residuals(problem, replace(s, translations=moved)) - path
        derivatives[:, k] = change.reshape(-1) / h
    matrix, gradient = problem.path_terms(s, path)
    products = derivatives.T @ derivatives
    np.testing.assert_allclose(matrix, products, atol=1e-3 * np.abs(products).max())
    slopes = (derivatives.T @ path.reshape(-1)).reshape(TIMES, 3)
    np.testing.assert_allclose(gradient, slopes, atol=1e-3 * np.abs(slopes).max())


def test_only_the_prior_of_distance_changes_with_scale() -> None:
    problem = flat_problem()
    true = true_state(problem)
    for factor in (0.7, 1.6):
        scaled = BundleState(
            true.points * factor,
            true.rotations,
            problem.eyes + factor * (true.translations - problem.eyes),
        )
        shapes = [
            s.points / problem.shape_sigma(replace(s, points=problem.middle + s.points))
            for s in (true, scaled)
        ]
        assert np.allclose(*shapes)
        assert np.allclose(problem.reproject(scaled).error, problem.reproject(true).error)
        # the path, straight in the world, shows the camera's shake at any other scale,
        # as a share of the distance
        path_true, path_scaled = (path_residuals(problem, s) for s in (true, scaled))
        shake = problem.third_differences @ problem.eyes @ problem.path_whitening
        expected = (1 / factor - 1) * shake / problem.distance(true)
        assert np.allclose(path_true, 0) and np.allclose(path_scaled, expected)


def numeric_jacobians(problem: BundleProblem, s: BundleState) -> tuple[np.ndarray, np.ndarray]:
    """Measured derivatives of errors by pose (N, T, 2, 6) and point (N, T, 2, 3)."""
    h, columns = 1e-6, []
    for k in range(9):
        ends = []
        for step in (h, -h):
            along = step * np.eye(3)[k % 3]
            turn = Rotation.from_rotvec(along).as_matrix() @ s.rotations
            moved = (
                replace(s, rotations=turn),
                replace(s, translations=s.translations + along),
                replace(s, points=s.points + along),
            )
            ends.append(problem.reproject(moved[k // 3]).error)
        columns.append((ends[0] - ends[1]) / (2 * h))
    jacobian = np.stack(columns, -1)
    return jacobian[..., :6], jacobian[..., 6:]


@pytest.mark.parametrize("offset", [0.1, 7.0], ids=["small", "large"])
def test_the_terms_are_those_of_weighted_least_squares(offset: float) -> None:
    problem = flat_problem()
    s = true_state(problem)
    problem.pixels = problem.pixels - np.array([offset, 0.0])
    by_pose, by_point = numeric_jacobians(problem, s)
    error = problem.reproject(s).error
    length = np.linalg.norm(error, axis=-1)
    sigma = problem.noise  # beyond one of it, Huber's weight falls as 1 / length
    weight = problem.visible * np.where(length < sigma, 1, sigma / np.maximum(length, 1e-9))
    weight = weight / sigma**2
    terms = problem.reprojection_terms(s)
    pairs = [
        (terms.pose_blocks, np.einsum("nt,ntij,ntik->tjk", weight, by_pose, by_pose)),
        (terms.points, np.einsum("nt,ntij,ntik->njk", weight, by_point, by_point)),
        (terms.points_poses, np.einsum("nt,ntij,ntik->nktj", weight, by_pose, by_point)),
        (terms.pose_gradient, np.einsum("nt,ntij,nti->tj", weight, by_pose, error)),
        (terms.point_gradient, np.einsum("nt,ntij,nti->nj", weight, by_point, error)),
    ]
    for found, expected in pairs:
        assert found == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())


def test_old_tracks_weigh_less() -> None:
    young = tracked(pixels_of(TRUE))
    old = replace(young, age=np.full(young.age.shape, 3))
    group = path_without_rotation(young, fit_motion(young, np.arange(COUNT)))
    blocks = []
    for problem in (BundleProblem(young, group, CAMERAS), BundleProblem(old, group, CAMERAS)):
        blocks.append(problem.reprojection_terms(true_state(problem)).pose_blocks)
    # the errors of three more steps have four times the variance
    assert blocks[0] == pytest.approx(4 * blocks[1])


def test_points_are_fitted_to_known_poses() -> None:
    problem = flat_problem()
    s = true_state(problem)
    found = problem.solve_points(replace(s, points=np.zeros_like(s.points)))
    assert np.abs(found.points - LOCAL).max() < 0.01
    assert np.array_equal(found.rotations, s.rotations)
    assert np.array_equal(found.translations, s.translations)


def test_steps_lower_the_cost() -> None:
    problem = flat_problem()
    identity = np.tile(np.eye(3), (TIMES, 1, 1))
    start = BundleState(problem.start, identity, np.zeros((TIMES, 3)))
    costs = [problem.minimize(start, k)[1] for k in (0, 1, 4, 25)]
    assert costs[0] == problem.cost(start)
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] < 0.05 * costs[0]


def test_a_solution_is_a_local_minimum() -> None:
    problem = flat_problem()
    best, cost = problem.minimize(true_state(problem), 60)
    rng = np.random.default_rng(0)
    for size in (1e-3, 1e-2):
        turn = Rotation.from_rotvec(size * rng.standard_normal((TIMES, 3))).as_matrix()
        away = rng.standard_normal((TIMES, 3)), rng.standard_normal((COUNT, 3))
        translations = best.translations + size * away[0]
        assert problem.cost(replace(best, rotations=turn @ best.rotations)) > cost
        assert problem.cost(replace(best, translations=translations)) > cost
        assert problem.cost(replace(best, points=best.points + size * away[1])) > cost


def test_trust_in_depth_is_trust_that_gives_its_standard_deviation() -> None:
    tuning = BUNDLE_TUNING
    for sigma in (tuning.trusted_depth_sigma, 0.1, tuning.depth_sigma):
        trust = float(tuning.trust_in_depth(np.array(sigma)))
        assert tuning.sigma_of_depth(trust) == pytest.approx(sigma)
    assert tuning.sigma_of_depth(0.0) == tuning.depth_sigma
    assert float(tuning.trust_in_depth(np.array(1.0))) == tuning.untrusted_confidence


def test_no_step_of_a_point_raises_its_cost() -> None:
    problem = flat_problem()
    true = true_state(problem)
    far = true.points + np.random.default_rng(0).normal(0, 2, true.points.shape)
    problem.points_on_rays = lambda state: far  # type: ignore[method-assign]
    middle = np.median(far, 0)
    costs = [problem.point_costs(replace(true, points=far), middle)]
    costs += [problem.point_costs(problem.solve_points(true, k), middle) for k in (1, 3, 9, 25)]
    assert (np.diff(costs, axis=0) <= 0).all()
    assert np.median(costs[-1]) < 1e-3 * np.median(costs[0])  # the others began behind cameras
