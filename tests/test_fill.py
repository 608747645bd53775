"""Gaps in maps: filled from around, and what is known stays."""

import numpy as np
import pytest

from hdr_nsff.geometry.fill import fill

H, W = 48, 64


def test_holes_take_the_values_around_them():
    known = np.ones((H, W), bool)
    known[5:40, 10:50] = False
    filled = fill(np.where(known, 2.0, 0.0).astype(np.float32), known)
    assert np.allclose(filled, 2.0, atol=1e-5)


def test_known_values_stay_and_a_map_without_any_is_left_as_it_is():
    rng = np.random.default_rng(0)
    values, known = rng.random((H, W)).astype(np.float32), rng.random((H, W)) < 0.3
    filled = fill(values, known)
    assert np.array_equal(filled[known], values[known])
    assert filled.min() >= values[known].min() and filled.max() <= values[known].max()
    assert fill(values, np.zeros((H, W), bool)) is values


@pytest.mark.parametrize("count", [1, 20])  # of 3072 pixels
def test_few_known_pixels_reach_everywhere(count):
    rng = np.random.default_rng(0)
    known = np.zeros((H, W), bool)
    known.flat[rng.choice(H * W, count, replace=False)] = True
    values = rng.uniform(1, 2, (H, W)).astype(np.float32)
    filled = fill(np.where(known, values, 0), known)
    assert np.array_equal(filled[known], values[known])
    least, most = values[known].min(), values[known].max()
    assert filled.min() > 0.999 * least and filled.max() < 1.001 * most
