"""Tracks of two rigid bodies shared out by what their motions explain, in closed form:
bodies that cross, and one that comes back.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.bundle import Cameras, adjust
from hdr_nsff.priors.movers.motion_segmentation import (
    groups_by_motion,
    may_be_one,
    members_of,
    same,
    share_out,
    things,
)
from hdr_nsff.priors.movers.rigid_groups import Tracks, fit

TIMES, COUNT, FOCAL = 20, 140, 200.0
T = np.arange(TIMES)
K = np.tile([[FOCAL, 0, 120], [0, FOCAL, 70], [0, 0, 1.0]], (TIMES, 1, 1))
EYES = np.stack(
    [0.05 * np.sin(2.1 * T), 0.04 * np.sin(2.9 * T + 1), 0.02 * np.sin(1.7 * T)], -1
)  # a hand that shakes
CAMERAS = Cameras(K, np.concatenate([np.tile(np.eye(3), (TIMES, 1, 1)), EYES[..., None]], 2))


def body(
    seed: int, size: float, start: list[float], velocity: list[float], spin: float
) -> np.ndarray:
    """Points (COUNT, TIMES, 3) of a turning body on a straight path."""
    local = np.random.default_rng(seed).uniform(-size, size, (COUNT, 3))
    rotations = Rotation.from_rotvec(np.outer(T * spin, [0.3, 1.0, 0.2])).as_matrix()
    return np.einsum("tij,nj->nti", rotations, local) + np.array(start) + np.outer(T, velocity)


ONE = body(0, 0.3, [-0.6, 0.0, 2.0], [0.05, 0, 0], 0.08)
TWO = body(1, 0.15, [0.5, 0.05, 2.6], [-0.05, 0.01, 0.01], -0.1)


def tracked(points: np.ndarray, seen: np.ndarray, far: np.ndarray) -> Tracks:
    """Tracks of points (N, TIMES, 3) at the times `seen` (N, TIMES), all in one patch,
    put at `far` (N, TIMES) times their depth.
    """
    local = points - EYES
    pixels = (
        local[..., :2] / local[..., 2:] * FOCAL
        + [120, 70]
        + np.random.default_rng(9).normal(0, 0.05, (*seen.shape, 2))
    )
    hide = np.where(seen, 1.0, np.nan)[..., None]
    return Tracks(
        pixels * hide,
        (EYES + local * far[..., None]) * hide,
        seen * 0.3,
        seen.astype(int),
        np.zeros(seen.shape, int),
    )


def spans(first: np.ndarray, lasting: int, end: int = TIMES) -> np.ndarray:
    """Which times (N, TIMES) are within `lasting` of the first, before `end`."""
    return (first[:, None] <= T) & (first[:, None] + lasting > T) & (end > T)


def crossing() -> Tracks:
    """Both bodies in one patch all along; depth knows one wrong distance for both."""
    first = np.random.default_rng(3).integers(0, TIMES - 9, 2 * COUNT)
    points = np.concatenate([ONE, TWO])
    return tracked(points, spans(first, 10), 2.3 / points[..., 2])


def hidden() -> tuple[Tracks, np.ndarray]:
    """The second body, out of sight for three times, comes back where depth puts it a
    third too near; which of its tracks are late.
    """
    late = np.arange(COUNT) >= COUNT // 2
    first = np.where(late, 14, np.random.default_rng(4).integers(0, 4, COUNT))
    return tracked(
        TWO,
        spans(first, 8) & ((T < 11) | late[:, None]),
        np.where(late[:, None], 0.7, 1.0) * np.ones(TIMES),
    ), late


def test_two_bodies_that_cross_in_one_patch_are_two_things_and_none_is_mixed() -> None:
    found = things(crossing(), CAMERAS)
    assert len(found) == 2 and all(shape is not None for _, shape in found)
    shares = sorted((group.members < COUNT).mean() for group, _ in found)
    assert shares[0] < 0.02 and shares[1] > 0.98


def test_tracks_put_into_the_wrong_group_find_back() -> None:
    tracks = crossing()
    one, two = (
        np.arange(COUNT + 20),
        np.arange(COUNT + 20, 2 * COUNT),
    )  # the first has 20 of the second
    found = groups_by_motion(tracks, [one, two], CAMERAS)
    assert len(found) == 2
    assert {frozenset((g.members >= COUNT).tolist()) for g, _ in found} == {
        frozenset({False}),
        frozenset({True}),
    }


def test_what_comes_back_after_it_was_hidden_is_one_thing_at_its_distance() -> None:
    tracks, late = hidden()
    found = groups_by_motion(tracks, [np.nonzero(~late)[0], np.nonzero(late)[0]], CAMERAS)
    assert len(found) == 1 and len(found[0][0].members) == COUNT
    shape = found[0][1]
    assert shape is not None
    for t in (2, 8, 15, 19):
        seen = tracks.trust[:, t] > 0
        ratio = (shape.at(t) - EYES[t])[seen, 2] / (TWO[:, t] - EYES[t])[seen, 2]
        assert abs(np.median(ratio) - 1) < 0.05


def test_things_far_apart_or_seen_apart_are_not_tried_as_one() -> None:
    tracks, late = hidden()
    a, b = fit(tracks, np.nonzero(~late)[0]), fit(tracks, np.nonzero(late)[0])
    assert may_be_one(tracks, a, b)
    away = Tracks(
        tracks.pixels + np.where(late, 200.0, 0.0)[:, None, None],
        tracks.points,
        tracks.trust,
        tracks.patch,
        tracks.age,
    )
    assert not may_be_one(away, a, b)


def test_the_larger_group_gets_what_both_explain_and_nobody_what_none_explains() -> None:
    before = [np.array([0, 1, 2]), np.array([3, 4])]
    cost = np.array(
        [
            [0.1, 0.2],
            [3.0, 0.1],
            [9.0, 8.0],
            [0.3, 0.2],
            [np.inf, np.inf],
            [np.inf, 1.0],
            [5.0, 5.0],
        ]
    )
    assert share_out(before, cost).tolist() == [0, 1, 0, 0, 1, 1, -1]


def test_groups_of_few_tracks_are_left_out_but_for_the_largest() -> None:
    owner = np.repeat([0, 1, -1], [90, 1, 9])
    assert [len(m) for m in members_of(owner)] == [90]
    assert [len(m) for m in members_of(np.array([0] + [-1] * 99))] == [1] and members_of(
        np.full(5, -1)
    ) == []


def test_a_hundredth_of_the_tracks_makes_no_other_group() -> None:
    assert same(np.arange(200), np.arange(2, 200)) and not same(np.arange(200), np.arange(3, 200))


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_hardly_any_tracks_are_no_error() -> None:
    tracks = crossing()
    few = Tracks(*(getattr(tracks, f)[:5] for f in ("pixels", "points", "trust", "patch", "age")))
    found = things(few, CAMERAS)
    assert len(found) == 1 and found[0][1] is None
    assert np.isfinite(adjust(tracks, fit(tracks, np.arange(COUNT)), CAMERAS).error)
