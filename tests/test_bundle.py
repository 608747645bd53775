"""Shape and motion of a tumbling body from its tracks in one moving camera, of which
depth knew one distance only.
"""

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.bundle import (
    PATH_SIGMA,
    Cameras,
    Problem,
    Shape,
    State,
    adjust,
    without_turning,
)
from hdr_nsff.priors.movers.rigid_groups import Group, Tracks, fit

TIMES, COUNT, FOCAL = 16, 90, 300.0
K = np.tile([[FOCAL, 0, 160], [0, FOCAL, 100], [0, 0, 1.0]], (TIMES, 1, 1))
EYES = np.stack(
    [0.06 * np.arange(TIMES), 0.02 * np.sin(np.arange(TIMES)), 0 * np.arange(TIMES)], -1
)
CAMERAS = Cameras(K, np.concatenate([np.tile(np.eye(3), (TIMES, 1, 1)), EYES[..., None]], 2))
SPIN = np.outer(
    np.arange(TIMES) * -0.1, [0.3, 1.0, 0.2]
)  # radians; the way round that a flat start takes for its mirror image
ROTATIONS = Rotation.from_rotvec(SPIN).as_matrix()
PLACES = np.array([0.1, 0.0, 3.0]) + np.outer(np.arange(TIMES), [0.04, 0.01, 0.01])
LOCAL = np.random.default_rng(0).uniform(-0.4, 0.4, (COUNT, 3))
TRUE = np.einsum("tij,nj->nti", ROTATIONS, LOCAL) + PLACES  # (COUNT, TIMES, 3)


def pixels_of(points: np.ndarray) -> np.ndarray:
    """Where the cameras see points (N, T, 3): (N, T, 2)."""
    local = points - EYES
    return local[..., :2] / local[..., 2:] * FOCAL + [160, 100]


def tracked(pixels: np.ndarray, far: float = 1.0, lasting: int = 10, trust: float = 0.5) -> Tracks:
    """Tracks of `lasting` times each, put at one depth per time: `far` times that of
    the body's middle, which is trusted so much.
    """
    first = np.random.default_rng(1).integers(0, TIMES - lasting + 1, len(pixels))[:, None]
    seen = (np.arange(TIMES) >= first) & (np.arange(TIMES) < first + lasting)
    depth = far * (PLACES - EYES)[:, 2:]
    points = (
        np.concatenate(
            [(pixels - [160, 100]) / FOCAL * depth, np.broadcast_to(depth, (*pixels.shape[:2], 1))],
            -1,
        )
        + EYES
    )
    hide = np.where(seen, 1.0, np.nan)[..., None]
    return Tracks(
        pixels * hide, points * hide, trust * seen, seen.astype(int), np.zeros(seen.shape, int)
    )


@cache
def adjusted(far: float = 1.0) -> tuple[Tracks, Shape]:
    tracks = tracked(pixels_of(TRUE), far)
    return tracks, adjust(tracks, fit(tracks, np.arange(COUNT)), CAMERAS)


def flat_problem() -> Problem:
    """The body's tracks as depth alone gave them."""
    tracks = tracked(pixels_of(TRUE))
    return Problem(tracks, without_turning(tracks, fit(tracks, np.arange(COUNT))), CAMERAS)


def true_state(problem: Problem) -> State:
    return State(
        LOCAL, ROTATIONS, PLACES - EYES + problem.eye
    )  # shifts are counted from the group's center, as its eyes are


def likeness(points: np.ndarray, which: slice | np.ndarray = slice(None)) -> np.ndarray:
    """Correlation (TIMES,) of the z-depth of points (N, TIMES, 3) with the true one."""
    return np.array(
        [np.corrcoef(points[which, t, 2], TRUE[which, t, 2])[0, 1] for t in range(TIMES)]
    )


def of_shape(shape: Shape) -> np.ndarray:
    """(N, TIMES, 3)."""
    return np.stack([shape.at(t) for t in range(TIMES)], 1)


def of_state(s: State) -> np.ndarray:
    """(N, TIMES, 3) about the center, which likeness does not see."""
    return np.einsum("tij,nj->nti", s.rotations, s.points) + s.shifts


def wrong_steps(rotations: np.ndarray) -> np.ndarray:
    """Degrees (TIMES - 1,) by which turns from one time to the next miss the true ones."""
    steps, true = (r[1:] @ np.swapaxes(r[:-1], 1, 2) for r in (rotations, ROTATIONS))
    return np.degrees(Rotation.from_matrix(steps @ np.swapaxes(true, 1, 2)).magnitude())


def test_the_start_is_flat_and_does_not_turn() -> None:
    tracks, shape = adjusted()
    depth = tracks.points[..., 2] - EYES[:, 2]
    assert np.nanmax(abs(depth - (PLACES - EYES)[:, 2])) < 1e-12
    assert np.array_equal(
        without_turning(tracks, shape.group).rotations, np.tile(np.eye(3), (TIMES, 1, 1))
    )


def test_relief_and_turning_of_a_tumbling_body_are_found_from_a_flat_start() -> None:
    _, shape = adjusted()
    points = of_shape(shape)
    assert shape.error < 0.05 and likeness(points).min() > 0.99
    assert (
        wrong_steps(shape.group.rotations).max() < 0.3
    )  # of the 6.1 degrees that it turns from time to time
    assert np.abs(points - TRUE).max() < 0.03


@pytest.mark.parametrize("far", [0.8, 1.15])
def test_a_camera_that_shakes_tells_how_far_away_it_is_whatever_the_prior_says(far: float) -> None:
    _, shape = adjusted(far)
    points = of_shape(shape)
    assert likeness(points).min() > 0.99 and wrong_steps(shape.group.rotations).max() < 0.3
    assert np.allclose(points[..., 2].std(0) / TRUE[..., 2].std(0), 1, atol=0.03)
    assert np.allclose(
        (points - EYES)[..., 2].mean(0) / (TRUE - EYES)[..., 2].mean(0), 1, atol=0.03
    )


@pytest.mark.parametrize(
    "far", [0.75, 1.0, 1.4]
)  # with one smoothness for all directions: 0.86, 1.13, 1.57
def test_what_goes_to_and_fro_along_a_line_is_found_by_the_shake_across_it(
    far: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    jerk = np.outer(0.15 * np.sin(2.1 * np.arange(TIMES)), [1, 0, 0])  # more than the camera shakes
    true = TRUE + jerk
    monkeypatch.setattr(sys.modules[__name__], "PLACES", PLACES + jerk)
    tracks = tracked(pixels_of(true), far)
    points = of_shape(adjust(tracks, fit(tracks, np.arange(COUNT)), CAMERAS))
    assert np.median(
        (points - EYES)[..., 2].mean(0) / (true - EYES)[..., 2].mean(0)
    ) == pytest.approx(1, abs=0.11)


def test_every_direction_of_a_path_has_a_smoothness_of_its_own() -> None:
    problem = flat_problem()
    s = true_state(problem)
    jerky = replace(
        s, shifts=s.shifts + np.outer(0.2 * (-1.0) ** np.arange(TIMES), [0.6, 0.8, 0.0])
    )
    problem.roughened(jerky)
    path = problem.priors(jerky, problem.residuals(jerky)[2])[1]
    assert path.shape == (TIMES - 3, 3)
    assert (path**2).mean(0).sum() == pytest.approx(
        1, abs=0.01
    )  # along the line as much as it shows, across it nothing
    across = np.array([0.8, -0.6, 0.0]), np.array([0.0, 0.0, 1.0])
    assert all(
        np.linalg.norm(problem.path_scale @ a) == pytest.approx(1 / PATH_SIGMA) for a in across
    )


def test_slopes_of_the_path_are_its_derivatives() -> None:
    problem, h = flat_problem(), 1e-6
    s = true_state(problem)
    s = replace(s, shifts=s.shifts + np.random.default_rng(0).normal(0, 0.05, s.shifts.shape))
    problem.roughened(s)
    path = problem.priors(s, problem.residuals(s)[2])[1]
    slopes = problem.path_slopes(s, path)
    for t, axis in ((0, 0), (5, 1), (TIMES - 1, 2)):
        moved = s.shifts.copy()
        moved[t, axis] += h
        there = replace(s, shifts=moved)
        measured = (problem.priors(there, problem.residuals(there)[2])[1] - path) / h
        assert measured == pytest.approx(slopes[:, :, t, axis], abs=1e-3 * np.abs(slopes).max())


@pytest.mark.parametrize("far", [0.8, 1.15])
def test_depth_that_is_sure_of_itself_is_believed_against_the_path(far: float) -> None:
    tracks = tracked(pixels_of(TRUE), far, trust=1.0)
    points = of_shape(adjust(tracks, fit(tracks, np.arange(COUNT)), CAMERAS))
    assert np.median(
        (points - EYES)[..., 2].mean(0) / (TRUE - EYES)[..., 2].mean(0)
    ) == pytest.approx(far, abs=0.03)


def test_a_camera_that_moves_evenly_leaves_how_far_away_it_is_to_the_prior(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "EYES", np.outer(np.arange(TIMES), [0.06, 0.01, 0]))
    cameras = Cameras(K, np.concatenate([np.tile(np.eye(3), (TIMES, 1, 1)), EYES[..., None]], 2))
    tracks = tracked(pixels_of(TRUE), 1.15)
    points = of_shape(adjust(tracks, fit(tracks, np.arange(COUNT)), cameras))
    assert np.allclose(
        (points - EYES)[..., 2].mean(0) / (TRUE - EYES)[..., 2].mean(0), 1.15, atol=0.05
    )


def test_no_prior_but_the_one_on_distance_changes_with_scale() -> None:
    problem = flat_problem()
    for factor in (0.7, 1.6):
        state = true_state(problem)
        scaled = State(
            state.points * factor,
            state.rotations,
            problem.eye + factor * (state.shifts - problem.eye),
        )
        still = (
            replace(state, points=problem.middle + state.points),
            replace(scaled, points=problem.middle + scaled.points),
        )
        spreads = [(s.points - problem.middle) / problem.spread(s) for s in still]
        assert np.allclose(*spreads)
        assert np.allclose(problem.residuals(scaled)[0], problem.residuals(state)[0])
        # the path, straight in the world, shows the camera's shake at any other scale,
        # as a share of the distance
        paths = [problem.priors(s, problem.residuals(s)[2])[1] for s in (state, scaled)]
        shake = (
            (1 / factor - 1)
            * (problem.third @ problem.eye)
            @ problem.path_scale
            / problem.distance(state)
        )
        assert np.allclose(paths[0], 0) and np.allclose(paths[1], shake)


@pytest.mark.parametrize("split", [8, 11, TIMES])
def test_a_reversed_solution_is_recognized_and_undone(split: int) -> None:
    problem = flat_problem()
    wrong, cost = problem.solve(problem.reversed(true_state(problem), split), 25)
    assert likeness(of_state(wrong)).min() < 0  # the steps alone do not find out
    right = problem.unreversed(wrong, cost)
    assert likeness(of_state(right)).min() > 0.99 and wrong_steps(right.rotations).max() < 0.3


def test_a_reversed_body_looks_nearly_alike() -> None:
    problem = flat_problem()
    true = true_state(problem)
    mirrored = problem.reversed(true, TIMES)
    assert np.linalg.det(mirrored.rotations) == pytest.approx(np.ones(TIMES))
    assert likeness(of_state(mirrored)).max() < -0.9
    error = np.linalg.norm(problem.residuals(mirrored)[0], axis=-1)[problem.seen]
    assert np.linalg.norm(problem.residuals(true)[0], axis=-1).max() < 1e-9
    assert np.median(error) < 12  # px; it is 80 px wide


def test_slopes_are_the_derivatives_of_the_residuals() -> None:
    problem, h = flat_problem(), 1e-6
    s = true_state(problem)
    error, turned, local = problem.residuals(s)
    pose, point, _ = problem.slopes(error, turned, local, s)
    for k in range(3):
        step = h * np.eye(3)[k]
        turn = Rotation.from_rotvec(step).as_matrix()
        for moved, slope in (
            (replace(s, rotations=turn @ s.rotations), pose[..., k]),
            (replace(s, shifts=s.shifts + step), pose[..., 3 + k]),
            (replace(s, points=s.points + step), point[..., k]),
        ):
            measured = (problem.residuals(moved)[0] - error) / h
            assert np.abs(measured - slope)[problem.seen].max() < 1e-2  # of slopes of up to 100 px


def test_far_off_tracks_weigh_less() -> None:
    problem = flat_problem()
    s = true_state(problem)
    error, turned, local = problem.residuals(s)
    weight = problem.slopes(error + np.array([7.0, 0.0]), turned, local, s)[2][problem.seen]
    assert weight == pytest.approx(0.4 / 7.0 / 0.4**2)  # Huber beyond 0.4 px: 1 / length


def test_old_tracks_weigh_less() -> None:
    young = tracked(pixels_of(TRUE))
    old = replace(young, age=np.full(young.age.shape, 3))
    group = without_turning(young, fit(young, np.arange(COUNT)))
    weights = []
    for problem in (Problem(young, group, CAMERAS), Problem(old, group, CAMERAS)):
        s = true_state(problem)
        weights.append(problem.slopes(*problem.residuals(s), s)[2][problem.seen])
    assert weights[0] == pytest.approx(
        4 * weights[1]
    )  # the errors of three more steps have four times the variance


def test_points_are_placed_by_known_poses() -> None:
    problem = flat_problem()
    s = true_state(problem)
    found = problem.points_for(replace(s, points=np.zeros_like(s.points)))
    assert np.abs(found.points - LOCAL).max() < 0.01
    assert np.array_equal(found.rotations, s.rotations) and np.array_equal(found.shifts, s.shifts)


def test_a_step_lowers_the_cost() -> None:
    problem = flat_problem()
    start = State(problem.start, np.tile(np.eye(3), (TIMES, 1, 1)), np.zeros((TIMES, 3)))
    costs = [problem.solve(start, k)[1] for k in (0, 1, 4, 25)]
    assert (
        costs[0] == problem.cost(start)
        and costs == sorted(costs, reverse=True)
        and costs[-1] < 0.05 * costs[0]
    )


@pytest.mark.parametrize("spread", [20.0, 80.0])
def test_a_tenth_of_wrong_tracks_does_not_spoil_the_others(spread: float) -> None:
    rng, good = np.random.default_rng(5), np.arange(COUNT) >= COUNT // 10
    pixels = pixels_of(TRUE)
    pixels[~good] += rng.uniform(-spread, spread, (COUNT // 10, TIMES, 2))
    tracks = tracked(pixels)
    shape = adjust(tracks, fit(tracks, np.arange(COUNT)), CAMERAS)
    assert shape.error < 0.3 and likeness(of_shape(shape), good).min() > 0.98


def test_noisy_tracks_still_tell() -> None:
    tracks = tracked(pixels_of(TRUE) + np.random.default_rng(6).normal(0, 0.5, (COUNT, TIMES, 2)))
    shape = adjust(tracks, fit(tracks, np.arange(COUNT)), CAMERAS)
    assert (
        0.3 < 0.4 * shape.error < 0.7
    )  # half a pixel in x and y has a median length of 0.59; the unit is 0.4 pixels
    assert likeness(of_shape(shape)).min() > 0.98


def test_the_same_tracks_give_the_same_shape() -> None:
    tracks, shape = adjusted()
    again = adjust(tracks, fit(tracks, np.arange(COUNT)), CAMERAS)
    assert np.array_equal(shape.points, again.points) and np.array_equal(
        shape.group.rotations, again.group.rotations
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("lasting", [1, 2, 3])
def test_short_tracks_are_no_error(lasting: int) -> None:
    tracks = tracked(pixels_of(TRUE), lasting=lasting)
    shape = adjust(tracks, fit(tracks, np.arange(COUNT)), CAMERAS)
    assert (
        np.isfinite(shape.points).all() == (lasting > 1) and np.isfinite(shape.group.shifts).all()
    )
    assert np.isinf(shape.error) if lasting == 1 else shape.error < 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("times", [1, 2, 3, 4])
def test_few_times_are_no_error(times: int) -> None:
    full, some = tracked(pixels_of(TRUE)), slice(4, 4 + times)
    seen = (full.trust[:, some] > 0).any(1)
    tracks = Tracks(
        *(a[seen, some] for a in (full.pixels, full.points, full.trust, full.patch, full.age))
    )
    shape = adjust(tracks, fit(tracks, np.arange(seen.sum())), Cameras(K[some], CAMERAS.c2w[some]))
    assert np.isfinite(shape.group.rotations).all() and (
        np.isinf(shape.error) if times == 1 else shape.error < 1
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_group_of_hardly_any_tracks_has_no_shape(count: int) -> None:
    tracks, shape = adjusted()
    few: Group = replace(shape.group, members=np.arange(count))
    found = adjust(tracks, few, CAMERAS)
    assert (
        np.isinf(found.error) and found.points.shape == (count, 3) and np.isnan(found.points).all()
    )


def test_a_solution_is_the_lowest_place_around() -> None:
    problem = flat_problem()
    best, cost = problem.solve(true_state(problem), 60)
    rng = np.random.default_rng(0)
    for size in (1e-3, 1e-2):
        turn = Rotation.from_rotvec(size * rng.standard_normal((TIMES, 3))).as_matrix()
        away = rng.standard_normal((TIMES, 3)), rng.standard_normal((COUNT, 3))
        assert problem.cost(replace(best, rotations=turn @ best.rotations)) > cost
        assert problem.cost(replace(best, shifts=best.shifts + size * away[0])) > cost
        assert problem.cost(replace(best, points=best.points + size * away[1])) > cost


def test_times_at_which_nothing_is_seen_change_nothing() -> None:
    tracks, shape = adjusted()
    wider = [
        np.pad(v, ((0, 0), (3, 4), *(((0, 0),) * (v.ndim - 2))), mode="edge")
        for v in (tracks.pixels, tracks.points)
    ]
    never = [np.pad(v, ((0, 0), (3, 4))) for v in (tracks.trust, tracks.patch, tracks.age)]
    hidden = np.pad(np.zeros(TIMES, bool), (3, 4), constant_values=True)
    for v in wider:
        v[:, hidden] = np.nan
    cameras = Cameras(
        *(np.pad(v, ((3, 4), (0, 0), (0, 0)), mode="edge") for v in (CAMERAS.K, CAMERAS.c2w))
    )
    longer = Tracks(*wider, *never)
    found = adjust(longer, fit(longer, np.arange(COUNT)), cameras)
    inside = found.group.between(3, 3 + TIMES)
    np.testing.assert_allclose(of_shape(replace(found, group=inside)), of_shape(shape), atol=1e-3)
    steps = np.diff(found.group.shifts, axis=0)
    np.testing.assert_allclose(steps[:3], steps[[3] * 3], atol=1e-9)  # straight on
    np.testing.assert_allclose(steps[-4:], steps[[-5] * 4], atol=1e-9)
    assert found.group.rotations.shape == (TIMES + 7, 3, 3) and not found.group.known[hidden].any()
