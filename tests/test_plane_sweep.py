"""The parts of the plane sweep: window means, the best views, and smoothness."""

import numpy as np

from hdr_nsff.priors.depth.plane_sweep import (
    PlaneSweepTuning,
    aggregate,
    box,
    mean_of_lowest,
)

TUNING = PlaneSweepTuning()


def test_box_is_the_mean_over_the_window_inside_the_image():
    image, result = np.arange(12, dtype=np.float32).reshape(3, 4), np.empty((3, 4), np.float32)
    box(image, 1, result)
    assert np.isclose(result[0, 0], (0 + 1 + 4 + 5) / 4)
    assert np.isclose(result[1, 1], 5)


def test_only_the_best_three_quarters_of_the_views_count():
    costs = np.array([0.9, 0.1, 0.3, 0.2], np.float32)
    assert np.isclose(mean_of_lowest(costs, 4, TUNING.best_view_share), 0.2)
    assert mean_of_lowest(np.zeros(2, np.float32), 0, TUNING.best_view_share) == 1.0


def test_matching_is_smooth_where_all_costs_are_equal():
    """One pixel matches at candidate 3 alone; all others follow."""
    costs = np.full((5, 5, 6), 0.5, np.float32)
    costs[2, 2] = [1, 1, 1, 0, 1, 1]
    penalties = (TUNING.step_penalty, TUNING.jump_penalty, TUNING.edge_weight)
    total = aggregate(costs, np.zeros((5, 5), np.float32), *penalties)
    assert (total[2].argmin(-1) == 3).all()
