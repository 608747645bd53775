"""Tracks along flow: where they go and where they end."""

from dataclasses import replace

import numpy as np
import pytest

from hdr_nsff.priors.movers.rigid_groups import neighbor_graph
from hdr_nsff.priors.movers.starts import middle_times
from hdr_nsff.priors.movers.tracks import (
    MovingView,
    Tracks,
    advance,
    follow_moving_pixels,
    smooth_flow,
)
from hdr_nsff.priors.movers.tuning import TRACK_TUNING


def test_a_track_ends_where_flow_is_invalid_or_leaves_the_moving_pixels() -> None:
    moving = np.zeros((8, 8), bool)
    moving[2:6, 2:6] = True
    flow, valid = np.full((8, 8, 2), 1.0), np.ones((8, 8), bool)
    valid[3, 3] = False
    view = MovingView(moving, np.zeros((8, 8, 3)), np.ones((8, 8)), {1: flow}, {1: valid})
    out = advance(view, view, 1, np.array([[2.5, 2.5], [3.5, 3.5], [5.5, 5.5], [np.nan, np.nan]]))
    assert out[0].tolist() == [3.5, 3.5] and np.isnan(out[1:]).all()


def test_flow_is_averaged_over_known_pixels_of_similar_motion() -> None:
    flow = np.random.default_rng(0).normal(0, 0.3, (30, 40, 2)).astype(np.float32)
    flow[:, 20:] += [9.0, 0.0]  # another object
    known = np.ones((30, 40), bool)
    known[10, 10], flow[10, 10] = False, 100
    smooth = smooth_flow(flow, known)
    assert np.isnan(smooth[10, 10]).all()
    error = smooth - np.where(np.arange(40)[:, None] < 20, [0.0, 0.0], [9.0, 0.0])
    assert np.nanstd(error) < 0.3 / 3 and np.nanmax(abs(error)) < 0.6  # nothing leaks across


def test_tracks_follow_a_flow_between_pixels_and_count_their_steps() -> None:
    moving = np.ones((20, 60), bool)
    flow = np.full((20, 60, 2), [1.25, 0.0], np.float32)
    both = {1: flow, -1: -flow}
    trust = moving.astype(float)
    view = MovingView(moving, np.zeros((20, 60, 3)), trust, both, {1: moving, -1: moving})
    tracks = follow_moving_pixels([view] * 4, np.arange(4.0))
    begun = np.argmin(tracks.age, 1)
    here = np.take_along_axis(tracks.pixels[..., 0], begun[:, None], 1)
    expected = here + 1.25 * (np.arange(4) - begun[:, None])
    visible = tracks.trust > 0
    assert np.allclose(tracks.pixels[..., 0][visible], expected[visible], atol=1e-4)
    assert np.array_equal(tracks.age, abs(np.arange(4) - begun[:, None]))


def test_tracks_end_between_two_objects() -> None:
    moving = np.ones((9, 40), bool)
    right, left = np.float32([6.0, 0.0]), np.float32([-3.0, 0.0])
    flow = np.where(np.arange(40)[None, :, None] < 20, right, left).repeat(9, 0)
    view = MovingView(moving, np.zeros((9, 40, 3)), moving.astype(float), {1: flow}, {1: moving})
    # the border is at x = 20
    out = advance(view, view, 1, np.array([[19.0, 4.5], [20.0, 4.5], [21.2, 4.5]]))
    assert out[0, 0] == pytest.approx(25)
    assert np.isnan(out[1, 0])
    assert out[2, 0] == pytest.approx(18.2)


def test_large_movers_have_sparser_tracks() -> None:
    moving = np.ones((50, 60), bool)
    still = np.zeros((50, 60, 2), np.float32)
    both, sure = {1: still, -1: still}, {1: moving, -1: moving}
    views = [MovingView(moving, np.zeros((50, 60, 3)), moving.astype(float), both, sure)] * 4
    few = follow_moving_pixels(views, np.arange(4.0), replace(TRACK_TUNING, max_starts=200))
    assert few.spacing == 8 and len(few.trust) == 4 * 6 * 7  # of 48 x 58 inner pixels
    assert follow_moving_pixels(views, np.arange(4.0)).spacing == TRACK_TUNING.stride_px


def test_somebody_who_passes_between_two_starts_has_tracks() -> None:
    passing = np.zeros((70, 40, 60), bool)
    for k, t in enumerate(range(20, 26)):
        passing[t, 10:20, 5 + 6 * k : 15 + 6 * k] = True
    waiting = np.zeros((40, 60), bool)
    waiting[25:35, 20:30] = True
    views = []
    for moving in passing | waiting:
        flow = np.zeros((40, 60, 2), np.float32)
        flow[:20] = [6.0, 0.0]
        both, sure = {1: flow, -1: -flow}, {1: moving, -1: moving}
        views.append(MovingView(moving, np.zeros((40, 60, 3)), moving.astype(float), both, sure))
    tuning = replace(TRACK_TUNING, start_frames=5)  # 0, 17, 34, 52 and 69
    tracks = follow_moving_pixels(views, np.arange(70.0), tuning)
    passers = np.nanmin(tracks.pixels[..., 1], 1) < 20
    assert 0 < passers.sum() < 20 < (~passers).sum()
    assert ((tracks.trust[passers] > 0).any(0) == passing.any((1, 2))).all()
    without = replace(tuning, further_rounds=0)
    found = follow_moving_pixels(views, np.arange(70.0), without)
    assert np.array_equal(found.pixels, tracks.pixels[~passers], equal_nan=True)


def test_a_region_that_flow_does_not_follow_is_tried_elsewhere_and_given_up() -> None:
    region = np.ones((4, 4), bool)
    missed = dict.fromkeys([3, 4, 5, 6, 9], region)
    assert middle_times(missed, []) == [4, 9]
    assert middle_times(missed, [4, 9]) == [5]
    assert middle_times(missed, [3, 4, 5, 6, 9]) == []
    assert middle_times({}, [1]) == []


def test_tracks_of_any_spacing_have_neighbors() -> None:
    for spacing in (3, 9):
        y, x = np.mgrid[:4, :5].reshape(2, -1) * spacing + 0.5
        pixels = np.stack([x, y], -1)[:, None].repeat(3, 1)
        ones = np.ones(pixels.shape[:2])
        times = np.arange(3.0)
        tracks = Tracks(pixels, np.zeros((20, 3, 3)), ones, ones.astype(int), ones, times, spacing)
        num_neighbors = np.diff(neighbor_graph(tracks).indptr)
        assert num_neighbors.min() == 5 and num_neighbors.max() == 11
