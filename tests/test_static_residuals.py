"""Residuals against a static scene: zero for points at rest, the motion for others."""

from dataclasses import replace

import numpy as np
import pytest
from painted_clips import FOCAL, SPEED, H, K, T, W, cameras, painted_clip
from posed_planes import oblique

from hdr_nsff.geometry.pinhole import pixel_centers
from hdr_nsff.priors.masks.static_residuals import (
    ChainedFlow,
    chain_flow,
    epipolar_residual,
    static_residual,
    working_clip,
)


def test_chained_flow_adds_up():
    """Below the square, the wall moves by the same number of pixels in every frame."""
    flow, valid, pairs, video, _ = painted_clip("rising")
    chains = chain_flow(working_clip(flow, valid, pairs, video), 0)
    assert [chained.frame for chained in chains] == [1, 2, 3, 4, 5, 6]
    assert np.allclose(chains[3].flow[62:, 20:], (-4 * SPEED, 0), atol=1e-4)


def test_the_static_residual_is_zero_at_rest_and_the_motion_of_movers():
    """The square moves by +4 px against parallax: its best depth is infinity, where
    nothing moves.
    """
    flow, valid, pairs, video, truth = painted_clip("along")
    chains = chain_flow(working_clip(flow, valid, pairs, video), 0)
    to_next = [chained for chained in chains if chained.frame == 1]
    residual = static_residual(0, to_next, np.tile(K, (T, 1, 1)), cameras())[0]
    assert np.allclose(residual[~truth[0] & valid[1]], 0, atol=1e-3)
    assert np.allclose(residual[truth[0]].mean(0), (-4, 0), atol=1e-3)


@pytest.mark.parametrize("unit", [1, 1e-5, 1e5])
def test_points_at_rest_have_no_residual_before_turned_cameras(unit):
    clip = oblique(5)
    centers = pixel_centers(*clip.size)
    pixels = centers.reshape(-1, 2)
    disparity = np.random.default_rng(2).uniform(0.1, 0.5, len(pixels))
    world, everywhere = clip.unproject(2, pixels, disparity), np.ones(clip.size, bool)
    chains = []
    for frame, links in ((3, 1), (4, 2), (1, 1), (0, 2)):
        seen = clip.project(frame, world)[0].reshape(centers.shape)
        chains.append(ChainedFlow(frame, links, (seen - centers).astype(np.float32), everywhere))
    c2w = clip.c2w * [1, 1, 1, unit]
    assert np.abs(static_residual(2, chains, clip.K, c2w)).max() < 1e-3
    unsure = [replace(chained, valid=~everywhere) for chained in chains]
    assert np.abs(static_residual(2, unsure, clip.K, c2w)).max() < 1e-3


def test_the_epipolar_residual_leads_to_the_line():
    """The camera moves sideways, so epipolar lines are rows."""
    depth = 2 + 2 * np.random.default_rng(0).random((H, W))
    flow = np.zeros((H, W, 2), np.float32)
    flow[..., 0] = -FOCAL * 0.2 / depth
    flow[30, 40, 1] = 5.0
    residual = epipolar_residual(flow, np.ones((H, W), bool))
    assert np.allclose(residual[30, 40], (0, -5), atol=0.05)
    others = np.delete(residual.reshape(-1, 2), 30 * W + 40, 0)
    assert np.abs(others).max() < 0.05
