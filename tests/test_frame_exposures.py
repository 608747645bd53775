"""The exposures of single frames come back from a wall in closed form."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from wall import S_CURVE, SRGB, X, wall_view

from hdr_nsff.radiometry import frame_exposures
from hdr_nsff.radiometry.debevec import DebevecTuning
from hdr_nsff.radiometry.estimate_response import estimate_response
from hdr_nsff.radiometry.frame_exposures import (
    Readings,
    drift_is_shared,
    drift_within_brackets,
    frame_log_exposures,
    normal_equations,
    read_points,
    second_differences,
    steepness_factor,
)
from hdr_nsff.radiometry.response_words import describe
from hdr_nsff.radiometry.samples import Samples
from hdr_nsff.radiometry.static_samples import ResponseView

NUM = 24


def drifting_views(
    curve: np.ndarray, drift: np.ndarray, cycle: tuple[int, ...]
) -> list[ResponseView]:
    """Views of the wall in brackets of `cycle`, each frame with a drift in stops."""
    rng = np.random.default_rng(0)
    views = []
    for t in range(NUM):
        # `wall_view` takes the bracket from its number: 0 to 2 are -4, -2 and 0 EV
        bracket = cycle[t % len(cycle)]
        view = wall_view(3 * t + bracket, curve, rng, shift=0.02, gain=2 ** drift[t])
        views.append(replace(view, bracket=cycle.index(bracket), time=float(t)))
    return views


def smooth_drift(stops: float) -> np.ndarray:
    return stops / 2 * np.sin(np.arange(NUM) / 4)


def test_auto_exposure_is_found_where_no_cycle_is():
    drift = smooth_drift(3.0)
    views = drifting_views(SRGB, drift, (1,))
    response = estimate_response(views, [0] * NUM, [None], reference=0, num_cameras=1)
    assert response.source == "static points" and response.drift is not None
    scale = response.drift @ (drift - drift.mean()) / (response.drift @ response.drift)
    assert response.scale_low < scale < response.scale_high
    error = np.abs(scale * response.drift - drift + drift.mean())
    assert np.median(error) < 0.05 and np.quantile(error, 0.95) < 0.15
    assert "auto exposure" in describe(response, [None])


def test_the_factor_of_dark_frames_is_less_certain():
    """Where no point shows the mid-tones, whose steepness gives it."""
    widths = []
    for gain in (0.0, -5.0):
        views = drifting_views(SRGB, smooth_drift(3.0) + gain, (1,))
        response = estimate_response(views, [0] * NUM, [None], reference=0, num_cameras=1)
        assert response.drift is not None
        widths.append(np.log(response.scale_high / response.scale_low))
    assert widths[1] > 1.5 * widths[0]


def test_frames_that_show_nothing_are_bridged():
    """A white frame has no points; its exposure lies between those beside it."""
    drift = smooth_drift(3.0)
    views = drifting_views(SRGB, drift, (1,))
    for t in (7, 15):
        views[t] = replace(views[t], image=np.ones_like(views[t].image))
    response = estimate_response(views, [0] * NUM, [None], reference=0, num_cameras=1)
    assert response.drift is not None and not response.problem
    scale = response.drift @ (drift - drift.mean()) / (response.drift @ response.drift)
    error = np.abs(scale * response.drift - drift + drift.mean())
    assert np.median(error) < 0.05 and error.max() < 0.3


def test_drift_that_too_few_frames_show_is_not_measured_and_that_is_said():
    views = drifting_views(SRGB, smooth_drift(3.0), (1,))
    for t in range(0, NUM, 3):
        for k in (t, t + 1):
            if k < NUM:
                views[k] = replace(views[k], image=np.ones_like(views[k].image))
    response = estimate_response(views, [0] * NUM, [None], reference=0, num_cameras=1)
    assert response.drift is None
    assert "exposed differently" in describe(response, [None])


def test_drift_on_top_of_alternation_is_found():
    drift = smooth_drift(1.0)
    views = drifting_views(S_CURVE, drift, (0, 2))
    response = estimate_response(views, [0] * NUM, [-4.0, 0.0], reference=1, num_cameras=1)
    assert response.ev.tolist() == [-4, 0] and response.drift is not None
    truth = drift_within_brackets(drift, np.arange(NUM) % 2)
    assert np.median(np.abs(response.drift - truth)) < 0.05
    assert response.drift[1::2].mean() == pytest.approx(0, abs=1e-9)  # the gauge
    listed = estimate_response(views, [0] * NUM, [-4.0, 0.0], 1, 1, may_drift=False)
    assert listed.drift is None


@pytest.mark.parametrize("cycle, ev", [((0, 1, 2), [None] * 3), ((1,), [None])])
def test_a_constant_clip_is_left_alone(cycle, ev):
    views = drifting_views(SRGB, np.zeros(NUM), cycle)
    response = estimate_response(views, [0] * NUM, ev, reference=len(ev) - 1, num_cameras=1)
    assert response.drift is None
    assert response.source == ("static points" if len(ev) > 1 else "one exposure")


def test_a_given_drift_is_kept_and_the_curve_fitted_to_it():
    drift = smooth_drift(3.0)
    views = drifting_views(S_CURVE, drift, (1,))
    response = estimate_response(views, [0] * NUM, [0.0], 0, 1, drift=drift)
    np.testing.assert_array_equal(response.drift, drift)
    assert response.source == "static points" and not response.problem


def test_views_with_a_given_drift_may_come_in_any_order():
    drift = smooth_drift(3.0)
    views = drifting_views(S_CURVE, drift, (1,))
    in_time = estimate_response(views, [0] * NUM, [0.0], 0, 1, drift=drift)
    order = np.random.default_rng(0).permutation(NUM)
    mixed = [views[i] for i in order]
    found = estimate_response(mixed, [0] * NUM, [0.0], 0, 1, drift=drift[order])
    np.testing.assert_array_equal(found.drift, drift[order])
    assert not found.problem and found.misfit == in_time.misfit
    np.testing.assert_array_equal(found.y, in_time.y)


@pytest.mark.parametrize("known", [True, False])
def test_little_drift_leaves_the_curve_alone(known):
    drift = smooth_drift(0.6)
    views = drifting_views(S_CURVE, drift, (1,))
    # as where tones are mapped locally: nothing becomes darker with less exposure
    still = drifting_views(S_CURVE, np.zeros(NUM), (1,))
    given = drift if known else None
    response = estimate_response(still if known else views, [0] * NUM, [0.0], 0, 1, drift=given)
    assert response.source == "one exposure"
    np.testing.assert_allclose(response.y[0, 0], response.x ** (1 / 2.2), atol=1e-9)
    assert "do not determine the response; single frames drift" in describe(response, [0.0])
    assert bool(response.disagreement) == known
    if known:
        np.testing.assert_array_equal(response.drift, drift)
        assert "the pixels disagree with given exposures" in describe(response, [0.0])
    else:
        assert np.abs(response.drift - drift + drift.mean()).max() < 0.25


@pytest.mark.parametrize("curve", [SRGB, S_CURVE])
def test_little_drift_that_is_given_agrees_through_an_assumed_curve(curve):
    drift = smooth_drift(0.8)
    views = drifting_views(curve, drift, (1,))
    found = estimate_response(views, [0] * NUM, [0.0], 0, 1, drift=drift)
    assert found.source == "one exposure" and not found.disagreement
    found = estimate_response(views, [0] * NUM, [0.0], 0, 1, drift=-drift)
    assert found.disagreement


def test_pixels_that_disagree_with_a_given_drift_are_reported():
    views = drifting_views(SRGB, smooth_drift(3.0), (1,))
    wrong = smooth_drift(3.0).copy()
    wrong[5:8] += 1.0
    response = estimate_response(views, [0] * NUM, [0.0], 0, 1, drift=wrong)
    assert "disagree" in response.disagreement and not response.problem
    assert response.disagreement in describe(response, [0.0])
    np.testing.assert_array_equal(response.drift, wrong)


def test_a_given_drift_that_nothing_can_be_held_against_is_named():
    drift = smooth_drift(3.0)
    views = [replace(v, disparity=0 * v.disparity) for v in drifting_views(SRGB, drift, (1,))]
    response = estimate_response(views, [0] * NUM, [0.0], 0, 1, drift=drift)
    np.testing.assert_array_equal(response.drift, drift)
    assert "too few static points to hold given exposures against" in describe(response, [0.0])


def test_exposures_are_the_offsets_between_readings():
    """Two frames that read the same points a stop apart, through a linear camera."""
    rgb = np.random.default_rng(0).uniform(0.1, 0.4, (200, 1, 3)) * [[[1.0]], [[2.0]]][1]
    rgb = np.concatenate([rgb / 2, rgb], 1)
    samples = Samples(rgb, np.ones(rgb.shape, bool), np.zeros(rgb.shape, bool))
    readings = Readings(samples, np.tile([0, 1], (200, 1)), np.zeros((200, 2)))
    x = np.linspace(0, 1, 9)
    found = frame_log_exposures(readings, x, np.tile(x, (3, 1)), np.zeros(2, int))
    np.testing.assert_allclose(found, [-0.5, 0.5], atol=1e-3)


def test_frames_of_one_bracket_are_smooth_in_time():
    rows = second_differences(np.array([0, 1, 0, 1, 0, 1])).toarray()
    assert rows.tolist() == [[1, 0, -2, 0, 1, 0], [0, 1, 0, -2, 0, 1]]
    assert second_differences(np.array([0, 1, 0, 1])).shape == (0, 4)


def test_the_normal_equations_are_those_of_all_readings():
    """Against the same with the radiance of every point as an unknown, eliminated by
    the Schur complement.
    """
    rng = np.random.default_rng(0)
    frame = np.clip(np.arange(9)[:, None] + [0, -3, 1, 2], 0, 8)
    weights, log_exposure = rng.uniform(0.1, 1, (2, 9, 4, 3))
    matrix, right = normal_equations(weights, log_exposure, frame, 9)
    dense, target = np.zeros((9, 9)), np.zeros(9)
    for point in range(9):
        for c in range(3):
            w, z = weights[point, :, c], log_exposure[point, :, c]
            of_frames = np.zeros((4, 9))
            of_frames[np.arange(4), frame[point]] = 1
            centered = of_frames - w @ of_frames / w.sum()
            dense += of_frames.T @ (w[:, None] * centered)
            target += of_frames.T @ (w * (z - w @ z / w.sum()))
    np.testing.assert_allclose(matrix.toarray(), dense, atol=1e-12)
    np.testing.assert_allclose(right, target, atol=1e-12)


@pytest.mark.parametrize("cycle", [(1,), (0, 1, 2)])
def test_exposures_are_those_of_a_dense_solve(cycle, monkeypatch):
    """In which a dense term holds the mean at 0."""
    views = drifting_views(S_CURVE, smooth_drift(1.0), cycle)
    readings = read_points(views, np.random.default_rng(0))
    brackets = np.arange(NUM) % len(cycle)
    found = frame_log_exposures(readings, X, S_CURVE, brackets)

    def dense_solve(matrix, right):
        scale = np.median(matrix.diagonal())
        return np.linalg.solve(matrix.toarray() + 1e-6 * scale, right)

    monkeypatch.setattr(frame_exposures, "spsolve", dense_solve)
    dense = frame_log_exposures(readings, X, S_CURVE, brackets)
    np.testing.assert_allclose(found, dense, atol=1e-7)
    assert found.mean() == pytest.approx(0, abs=1e-12)


def test_work_grows_with_the_frames_alone():
    """Of 6000 frames: a full matrix of them would take 288 MB."""
    count = 6000
    frame = np.clip(np.arange(count)[:, None] + [0, -24, 24], 0, count - 1)
    rng = np.random.default_rng(0)
    samples = Samples(
        rng.uniform(0.2, 0.8, (count, 3, 3)),
        np.ones((count, 3, 3), bool),
        np.zeros((count, 3, 3), bool),
    )
    tracemalloc.start()
    found = frame_log_exposures(
        Readings(samples, frame, np.zeros((count, 2))), X, S_CURVE, np.arange(count) % 2
    )
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.isfinite(found).all() and peak < 100e6


def test_points_are_read_in_their_own_frame_and_its_neighbors():
    views = drifting_views(SRGB, np.zeros(NUM), (2,))
    readings = read_points(views, np.random.default_rng(0))
    assert readings.samples.valid.any(-1)[:, 0].mean() > 0.6
    assert readings.frame.min() == 0 and readings.frame.max() == NUM - 1


def test_a_power_of_srgb_is_undone():
    x = np.linspace(0, 1, 2001) ** 2.2
    assert steepness_factor(x**1.5, SRGB, DebevecTuning()) == pytest.approx(1 / 1.5, rel=1e-3)


def test_light_in_one_bracket_is_not_auto_exposure():
    """A lamp that only the darkest bracket records unclipped fades out."""
    drift = np.zeros(NUM)
    drift[::3] = np.linspace(-1.5, 1.5, NUM // 3)
    brackets = np.arange(NUM) % 3
    assert not drift_is_shared(drift, brackets)
    assert drift_is_shared(smooth_drift(3.0), brackets)
    steps = drift_within_brackets(np.where(np.arange(NUM) < 10, 0.0, 1.0), brackets)
    assert drift_is_shared(steps, brackets)  # one jump of the exposure
    views = drifting_views(SRGB, drift, (0, 1, 2))
    response = estimate_response(views, [0] * NUM, [None] * 3, reference=2, num_cameras=1)
    assert response.drift is None and response.source == "static points"
    assert "not taken for auto exposure" in describe(response, [None] * 3)
