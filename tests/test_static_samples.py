"""Static points in several exposures: they are the same points, and hidden ones are not
read.
"""

import numpy as np
import pytest
from test_debevec import EV, GAMMA22, record

from hdr_nsff.radiometry.static_samples import ResponseView, static_samples

K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
HEIGHT, WIDTH = 48, 64


def wall(x, y):
    """Radiance of a wall at z = 4: a smooth pattern over three decades."""
    level = 2 ** (3.2 * np.sin(0.9 * x) + 2.4 * np.cos(1.1 * y) - 3)
    return np.stack([level, level * 2 ** (0.5 * np.sin(x + y)), level * 0.8], -1)


def wall_view(index, curve, rng, depth_noise=0.0, shift=0.06):
    """Camera `index` in a row of cameras before the wall; a moving square is marked."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x = (column - K[0, 2]) / K[0, 0] * 4 + shift * index
    y = (row - K[1, 2]) / K[1, 1] * 4
    moving = np.zeros((HEIGHT, WIDTH), bool)
    moving[10:20, 3 * index : 3 * index + 10] = True
    radiance = np.where(moving[..., None], 3.0, wall(x, y))
    c2w = np.concatenate([np.eye(3), [[shift * index], [0], [0]]], 1)
    disparity = 0.25 * (1 + depth_noise * rng.standard_normal((HEIGHT, WIDTH)))
    bracket = index % 3
    return ResponseView(
        record(radiance * 2.0 ** EV[bracket], curve, rng),
        bracket,
        float(index),
        K,
        c2w,
        disparity,
        None,
        moving,
    )


def test_static_points_are_the_same_points_in_every_bracket():
    rng = np.random.default_rng(0)
    samples = static_samples([wall_view(i, GAMMA22, rng) for i in range(9)], 3, 900, rng)
    both = samples.valid[:, 1] & samples.valid[:, 2]
    ratio = 2.2 * np.log2(samples.rgb[:, 2][both] / samples.rgb[:, 1][both])
    assert both.sum() > 300
    assert (
        np.median(ratio) == pytest.approx(2.0, abs=0.03)
        and np.percentile(np.abs(ratio - 2), 90) < 0.4
    )


def test_points_hidden_behind_something_are_not_read():
    rng = np.random.default_rng(0)
    views = [wall_view(i, GAMMA22, rng) for i in range(3)]
    views[1].disparity[:] = 0.5  # something at half the distance stands before the second camera
    samples = static_samples(views, 3, 300, rng)
    first = samples.valid[:100, 0].any(-1)  # points of the first frame
    assert first.any() and not samples.valid[:100, 1][first].any()
