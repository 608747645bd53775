"""Views with parallax are chosen, and exact flow gives exact points."""

import numpy as np
from posed_planes import (
    RAYS,
    SWEEPING,
    H,
    W,
    cameras_at,
    exact_flow,
    neighbors,
    oblique,
    plane,
    posed_video,
)

from hdr_nsff.priors.depth.parallax import choose_views, disparity_of_flow, triangulate


def test_points_triangulated_from_exact_flow_are_exact():
    c2w = SWEEPING[:3]
    _, depth = plane(c2w, 4.0, 0.5)
    pairs = neighbors(3)
    points = triangulate(
        posed_video(c2w), exact_flow(c2w, depth, pairs), np.ones((4, H, W), bool), pairs
    )
    assert len(points) > 500
    assert np.abs(points[:, 2] - (4.0 + 0.5 * points[:, 0])).max() < 1e-3


def test_turned_cameras_show_the_disparity_of_points_and_how_far_it_moves_them():
    clip, rng = oblique(2), np.random.default_rng(1)
    pixels, disparity = rng.uniform(0, [W, H], (50, 2)), rng.uniform(0.2, 0.5, 50)
    target = clip.project(1, clip.unproject(0, pixels, disparity))[0]
    at_infinity = clip.project(1, clip.unproject(0, pixels, np.full(50, 1e-7)))[0]
    found, error, parallax_px = disparity_of_flow(clip, 0, 1, pixels, target)
    np.testing.assert_allclose(found, disparity, rtol=1e-3)
    assert error.max() < 1e-3
    np.testing.assert_allclose(parallax_px, np.linalg.norm(target - at_infinity, axis=1), rtol=0.01)


def test_views_with_good_parallax_are_chosen_first():
    """Points at z = 4, focal 60: baselines of 0.01, 0.2 and 2 move them by 0.15, 3 and
    30 px; 5 % of 64 px is 3.2 px.
    """
    wall = np.concatenate([4 * RAYS, np.full((H, W, 1), 4.0)], -1)
    points = wall[::8, ::8].reshape(-1, 3)
    c2w = cameras_at((0, 0, 0), (0.01, 0, 0), (0.2, 0, 0), (2, 0, 0))
    views, largest = choose_views(posed_video(c2w), points, 12)
    assert views[0][0] == 2
    assert np.isclose(largest, 30, rtol=0.02)
