"""Groups of tracks that move as one, of known bodies."""

from dataclasses import replace

import numpy as np
import pytest
from moving_bodies import body, tracked
from scipy.sparse import csr_matrix

from hdr_nsff.priors.movers.rigid_groups import (
    cut_graph,
    find_rigid_groups,
    neighbor_graph,
    split_unconnected,
)
from hdr_nsff.priors.movers.rigid_motion import RigidGroup
from hdr_nsff.priors.movers.tracks import Tracks
from hdr_nsff.priors.movers.tuning import RIGID_GROUPS_TUNING, RigidGroupsTuning


def groups_of(tracks: Tracks, tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING) -> list[RigidGroup]:
    return find_rigid_groups(tracks, neighbor_graph(tracks, tuning), tuning=tuning)


def test_two_bodies_that_touch_are_separate_groups() -> None:
    one, _, _ = body(0, np.array([-0.4, 0, 3.0]), np.array([0.06, 0, 0]), 0.12)
    two, _, _ = body(1, np.array([0.5, 0.1, 3.2]), np.array([-0.04, 0.01, 0]), -0.08)
    groups = groups_of(tracked(np.concatenate([one, two]), noise=0.005))
    assert len(groups) == 2
    for group in groups:
        share = (group.members < len(one)).mean()
        assert min(share, 1 - share) < 0.05


def test_a_group_below_the_least_share_is_dropped() -> None:
    one, _, _ = body(0, np.array([-0.4, 0, 3.0]), np.array([0.06, 0, 0]), 0.12)
    two, _, _ = body(1, np.array([0.5, 0.1, 3.2]), np.array([-0.04, 0.01, 0]), -0.08)
    tracks = tracked(np.concatenate([one, two[:40]]), noise=0.005)
    assert len(groups_of(tracks)) == 2  # the second has a quarter of the tracks
    tuning = replace(RIGID_GROUPS_TUNING, min_group_share=0.5)
    assert len(groups_of(tracks, tuning)) == 1


def test_tracks_without_neighbors_are_parts_of_their_own() -> None:
    points, _, _ = body(0, np.array([0, 0, 3.0]), np.array([0.05, 0, 0]), 0.1, count=12)
    near = tracked(points)
    far = [replace(near, pixels=near.pixels + 1000.0 * k) for k in range(12)]
    names = ("pixels", "points", "trust", "patch", "age")
    every = {name: np.concatenate([getattr(t, name) for t in far]) for name in names}
    tracks = replace(near, **every)
    parts = cut_graph(tracks, neighbor_graph(tracks))
    assert len(np.unique(parts)) == RIGID_GROUPS_TUNING.parts


def test_more_bodies_than_parts_are_told_apart() -> None:
    outward = [np.array([np.cos(0.45 * k), np.sin(0.45 * k), 0]) for k in range(14)]
    bodies = [
        body(k, 3 * way + [0, 0, 6], 0.2 * way, 0.3 * (-1) ** k, count=40)[0]
        for k, way in enumerate(outward)
    ]
    groups = groups_of(tracked(np.concatenate(bodies), noise=0.002))
    assert len(groups) == 14
    purity = [np.bincount(group.members // 40).max() / len(group.members) for group in groups]
    assert min(purity) > 0.9


def test_small_pieces_stay_with_the_largest_of_their_part() -> None:
    part = np.array([0, 0, 0, 0, 0, 1, 1, 1, 1, 1])
    links = [(0, 1), (1, 2), (3, 4), (5, 6), (6, 7), (7, 8), (4, 9)]
    row, column = np.array(links).T
    graph = csr_matrix((np.ones(len(links)), (row, column)), (10, 10))
    graph = graph + graph.T
    split = split_unconnected(part, graph, 2)
    assert split.tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 2, 2]


@pytest.mark.filterwarnings("error")
def test_one_time_is_no_error() -> None:
    points, _, _ = body(0, np.array([0, 0, 3.0]), np.array([0.05, 0, 0]), 0.1)
    pixels = 200 * points[:, :1, :2] / points[:, :1, 2:] + 100
    once = np.ones((len(points), 1))
    tracks = Tracks(pixels, points[:, :1], once, once.astype(int), once.astype(int), np.zeros(1))
    groups = groups_of(tracks)
    assert len(groups) == 1 and abs(groups[0].translations).max() < 1e-12
