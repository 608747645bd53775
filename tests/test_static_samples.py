"""Static points in several exposures: they are the same points, and hidden ones are not
read.
"""

import numpy as np
import pytest
from wall import GAMMA22, wall_view

from hdr_nsff.radiometry.static_samples import static_samples


def test_static_points_are_the_same_points_in_every_bracket():
    rng = np.random.default_rng(0)
    samples = static_samples([wall_view(i, GAMMA22, rng) for i in range(9)], 3, 900, rng)
    both = samples.valid[:, 1] & samples.valid[:, 2]
    ratio = 2.2 * np.log2(samples.rgb[:, 2][both] / samples.rgb[:, 1][both])
    assert both.sum() > 300
    assert np.median(ratio) == pytest.approx(2.0, abs=0.03)
    assert np.percentile(np.abs(ratio - 2), 90) < 0.4


def test_points_hidden_behind_a_surface_are_not_read():
    rng = np.random.default_rng(0)
    views = [wall_view(i, GAMMA22, rng) for i in range(3)]
    views[1].disparity[:] = 0.5  # something at half the distance stands before the second camera
    samples = static_samples(views, 3, 300, rng)
    first = samples.valid[:100, 0].any(-1)  # points of the first frame
    assert first.any() and not samples.valid[:100, 1][first].any()
