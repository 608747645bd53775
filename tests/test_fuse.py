"""Fusion of disparity maps: warped maps, their vote, and edges on image edges."""

import numpy as np
from posed_planes import H, W, cameras_at, oblique, posed_video

from hdr_nsff.geometry.pinhole import pixel_centers
from hdr_nsff.priors.depth.fuse import (
    FuseTuning,
    joint_median,
    vote,
    warp_disparity,
    weighted_median,
)

TUNING = FuseTuning()


def test_a_warped_map_shifts_by_its_parallax_and_the_nearer_surface_wins():
    """Baseline 1, focal 60: disparity 0.05 moves by 3 px, 0.1 by 6 px; both land on
    column 20, the nearer stays.
    """
    s = posed_video(cameras_at((0, 0, 0), (-1, 0, 0)))
    disparity, weight = np.zeros((H, W), np.float32), np.zeros((H, W), np.float32)
    disparity[10, 17], disparity[10, 14] = 0.05, 0.1
    weight[10, 17], weight[10, 14] = 1.0, 0.5
    result, result_weight = np.empty_like(disparity), np.empty_like(weight)
    rotation, shift = s.transfer(0, 1)
    warp_disparity(disparity, weight, rotation, shift, result, result_weight)
    assert np.isclose(result[10, 20], 0.1) and result_weight[10, 20] == 0.5
    assert (result > 0).sum() == 1


def test_a_map_lands_where_a_turned_camera_sees_its_points_at_their_depth_there():
    clip, rng = oblique(2), np.random.default_rng(1)
    disparity = rng.uniform(0.2, 0.4, (H, W)).astype(np.float32)
    weight = (rng.random((H, W)) < 0.1).astype(np.float32)
    pixels = pixel_centers(H, W)[weight > 0]
    world = clip.unproject(0, pixels, disparity[weight > 0].astype(float))
    seen, depth, inside = clip.project(1, world)
    expected = np.zeros((H, W))
    for (x, y), z in zip(seen[inside].astype(int), depth[inside], strict=True):
        expected[y, x] = max(expected[y, x], 1 / z)
    result, result_weight = np.empty_like(disparity), np.empty_like(disparity)
    warp_disparity(disparity, weight, *clip.transfer(0, 1), result, result_weight)
    assert 200 < (expected > 0).sum() < len(pixels)
    np.testing.assert_allclose(result, expected, atol=1e-5)
    np.testing.assert_array_equal(result_weight > 0, expected > 0)


def test_the_vote_is_the_mean_of_those_near_the_weighted_median():
    """Weights 1, 1, 1, 2.5: the total is 5.5, the median is the third value; the
    outlier at 9 does not count.
    """
    disparities = np.array([1.0, 1.02, 1.01, 9.0], np.float32).reshape(4, 1, 1)
    weights = np.array([1, 1, 1, 2.5], np.float32).reshape(4, 1, 1)
    fused, agreeing, total = vote(disparities, weights, TUNING.max_disparity_difference)
    assert np.isclose(fused[0, 0], 1.01) and agreeing[0, 0] == 3 and total[0, 0] == 5.5


def test_the_weighted_median_is_that_of_sorted_values():
    """Equal values and weights of zero included; weights are whole, so that sums are
    exact.
    """
    rng = np.random.default_rng(0)
    for _ in range(500):
        n = rng.integers(1, 40)
        values = rng.integers(0, rng.integers(1, 60), n).astype(np.float32)
        weights = rng.integers(0, 4, n).astype(np.float32)
        weights[rng.integers(n)] = 1
        order = np.argsort(values)
        reached = np.cumsum(weights[order]) >= 0.5 * weights.sum()
        expected = values[order][reached.argmax()]
        assert weighted_median(values, weights, weights.sum()) == expected


def test_cleaning_moves_a_depth_edge_onto_the_image_edge():
    """The image changes at column 16, the map at column 18: columns 16 and 17 go back
    to the far side.
    """
    rgb, disparity = np.full((32, 32, 3), 0.2, np.float32), np.full((32, 32), 0.2, np.float32)
    rgb[:, :16], disparity[:, :18] = 0.8, 0.5
    weight = np.ones((32, 32), np.float32)
    cleaned = joint_median(disparity, weight, rgb, TUNING.window_px, TUNING.rgb_scale)
    assert (cleaned[:, :16] == 0.5).all() and (cleaned[:, 16:] == 0.2).all()
