"""The parts of the plane sweep: window means, the best views, and smoothness."""

import numpy as np
from posed_planes import H, W, oblique

from hdr_nsff.geometry.pinhole import pixel_centers
from hdr_nsff.priors.depth.plane_sweep import (
    LEFT_OUT,
    OUTSIDE,
    PlaneSweepTuning,
    aggregate,
    box,
    correlation_cost,
    mean_of_lowest,
    warp,
)

TUNING = PlaneSweepTuning()


def test_box_is_the_mean_over_the_window_inside_the_image():
    image, result = np.arange(12, dtype=np.float32).reshape(3, 4), np.empty((3, 4), np.float32)
    box(image, 1, result)
    assert np.isclose(result[0, 0], (0 + 1 + 4 + 5) / 4)
    assert np.isclose(result[1, 1], 5)


def test_a_frame_is_read_where_a_turned_camera_sees_the_pixels():
    """Its gray values grow evenly, so that they are exact between pixels."""
    clip, centers = oblique(2), pixel_centers(H, W)
    world = clip.unproject(0, centers.reshape(-1, 2), np.full(H * W, 0.25))
    seen = clip.project(1, world)[0].reshape(H, W, 2)
    inside = ((seen >= 0.5) & (seen <= [W - 0.5, H - 0.5])).all(-1)
    assert 0.5 < inside.mean() < 0.95
    gray, marks = (centers @ [1.0, 3.0]).astype(np.float32), np.zeros((H, W), np.uint8)
    warped, met = np.empty_like(gray), np.empty_like(marks)
    warp(gray, marks, *clip.transfer(0, 1), np.float32(0.25), warped, met)
    np.testing.assert_array_equal(met, np.where(inside, 0, OUTSIDE))
    np.testing.assert_allclose(warped[inside], (seen @ [1.0, 3.0])[inside], atol=0.01)


def test_the_cost_is_one_minus_the_correlation_of_windows():
    """Against numpy's correlation of each window, those at the borders too."""
    rng, noise = np.random.default_rng(0), TUNING.noise_variance
    gray, other = rng.random((2, 9, 11)).astype(np.float32)
    mean, square, cost = np.empty((3, 9, 11), np.float32)
    box(gray, 2, mean)
    box(gray * gray, 2, square)
    correlation_cost(gray, mean, square, other, 2, noise, cost)
    for y in range(9):
        for x in range(11):
            window = np.s_[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            (a, c), (_, b) = np.cov(gray[window].ravel(), other[window].ravel(), bias=True)
            expected = 1 - c / np.sqrt((a + noise) * (b + noise))
            assert np.isclose(cost[y, x], expected, atol=1e-4)


def test_only_the_best_three_quarters_of_the_views_count():
    """All of the first pixel, three of the second, none of the third."""
    costs = np.array([[0.9, 0.1, 0.3, 0.2], [0.8, LEFT_OUT, 0.2, 0.5], [LEFT_OUT] * 4], np.float32)
    mean = np.empty(3, np.float32)
    mean_of_lowest(np.ascontiguousarray(costs.T), TUNING.best_view_share, mean)
    np.testing.assert_allclose(mean, [0.2, 0.5, 1.0])


def test_matching_is_smooth_where_all_costs_are_equal():
    """One pixel matches at candidate 3 alone; all others follow."""
    costs = np.full((5, 5, 6), 0.5, np.float32)
    costs[2, 2] = [1, 1, 1, 0, 1, 1]
    penalties = (TUNING.step_penalty, TUNING.jump_penalty, TUNING.edge_weight)
    total = aggregate(costs, np.zeros((5, 5), np.float32), *penalties)
    assert (total[2].argmin(-1) == 3).all()
