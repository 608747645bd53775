"""Moving things found from tracks: rigid fits, parts, and motions of known bodies."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.rigid_groups import (
    PARTS,
    Tracks,
    View,
    advance,
    fit,
    follow,
    gather,
    parts,
    rigid,
    settled,
)

TIMES = 14


def body(
    seed: int, start: np.ndarray, velocity: np.ndarray, spin: float, count: int = 120
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (count, TIMES, 3) of a turning, moving body; its rotations (TIMES, 3, 3)
    and places (TIMES, 3).
    """
    local = np.random.default_rng(seed).uniform(-0.25, 0.25, (count, 3))
    rotations = Rotation.from_rotvec(np.outer(np.arange(TIMES) * spin, [0.3, 1.0, 0.2])).as_matrix()
    places = start + np.outer(np.arange(TIMES), velocity)
    return np.einsum("tij,nj->nti", rotations, local) + places, rotations, places


def tracked(points: np.ndarray, noise: float = 0.0, seed: int = 0) -> Tracks:
    """Tracks of points seen by a camera at the origin (focal length 200 px), each over
    a part of the time, with noisy depth.
    """
    rng = np.random.default_rng(seed)
    pixels = 200 * points[..., :2] / points[..., 2:] + 100
    points = points * (1 + noise * rng.standard_normal(points.shape[:2]))[..., None]
    first = rng.integers(0, TIMES // 2, len(points))[:, None]
    seen = (np.arange(TIMES) >= first) & (np.arange(TIMES) < first + TIMES // 2)
    hide = np.where(seen, 1.0, np.nan)[..., None]
    return Tracks(
        pixels * hide,
        points * hide,
        seen.astype(float),
        seen.astype(int),
        np.zeros(seen.shape, int),
    )


def test_a_rigid_fit_survives_a_third_of_wrong_points() -> None:
    rng = np.random.default_rng(0)
    source, r = rng.standard_normal((60, 3)), Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix()
    target = source @ r.T + [1.0, 2.0, 3.0]
    target[:20] += rng.uniform(1, 3, (20, 3))
    found, shift = rigid(source, target, np.ones(60), rounds=30)
    assert abs(found - r).max() < 1e-3 and abs(shift - [1, 2, 3]).max() < 1e-3


def test_a_rigid_fit_never_mirrors() -> None:
    source = np.random.default_rng(0).standard_normal((20, 3))
    found, _ = rigid(source, source * [1, 1, -1], np.ones(20))
    assert np.linalg.det(found) == pytest.approx(1)


def test_few_points_give_a_shift_without_rotation() -> None:
    source = np.random.default_rng(0).standard_normal((4, 3))
    found, shift = rigid(
        source, source @ Rotation.from_rotvec([0, 0, 1.0]).as_matrix().T + 5, np.ones(4)
    )
    assert np.array_equal(found, np.eye(3)) and abs(shift - 5).max() < 2


def test_the_motion_of_one_body_is_found_from_tracks_that_come_and_go() -> None:
    points, rotations, _ = body(0, np.array([0, 0, 3.0]), np.array([0.05, 0, 0.01]), 0.1)
    tracks = tracked(points, noise=0.01)
    group = fit(tracks, np.arange(len(points)))
    middle = slice(2, TIMES - 2)  # smoothing shortens the ends
    relative = group.rotations @ group.rotations[TIMES // 2].T
    assert abs(relative - rotations @ rotations[TIMES // 2].T)[middle].max() < 0.06
    for t in range(2, TIMES - 2):
        back = group.canonical(points[:, t], t)
        assert (
            np.linalg.norm(back - group.canonical(points[:, TIMES // 2], TIMES // 2), axis=-1).max()
            < 0.06
        )


def test_two_bodies_that_touch_are_told_apart() -> None:
    one, _, _ = body(0, np.array([-0.4, 0, 3.0]), np.array([0.06, 0, 0]), 0.12)
    two, _, _ = body(1, np.array([0.5, 0.1, 3.2]), np.array([-0.04, 0.01, 0]), -0.08)
    groups = gather(tracked(np.concatenate([one, two]), noise=0.005))
    assert len(groups) == 2
    for g in groups:
        share = (g.members < len(one)).mean()
        assert min(share, 1 - share) < 0.05


def test_a_track_ends_where_flow_is_not_believed_or_leaves_the_moving_pixels() -> None:
    moving = np.zeros((8, 8), bool)
    moving[2:6, 2:6] = True
    flow, valid = np.full((8, 8, 2), 1.0), np.ones((8, 8), bool)
    valid[3, 3] = False
    view = View(moving, np.zeros((8, 8, 3)), np.ones((8, 8)), {1: flow}, {1: valid})
    out = advance(view, view, 1, np.array([[2.5, 2.5], [3.5, 3.5], [5.5, 5.5], [np.nan, np.nan]]))
    assert out[0].tolist() == [3.5, 3.5] and np.isnan(out[1:]).all()


def test_flow_is_averaged_over_what_moves_alike_and_is_believed() -> None:
    flow = np.random.default_rng(0).normal(0, 0.3, (30, 40, 2)).astype(np.float32)
    flow[:, 20:] += [9.0, 0.0]  # another thing
    told = np.ones((30, 40), bool)
    told[10, 10], flow[10, 10] = False, 100
    found = settled(flow, told)
    assert np.isnan(found[10, 10]).all()
    error = found - np.where(np.arange(40)[:, None] < 20, [0.0, 0.0], [9.0, 0.0])
    assert np.nanstd(error) < 0.3 / 3 and np.nanmax(abs(error)) < 0.6  # nothing leaks across


def test_tracks_follow_a_flow_between_pixels_and_count_their_steps() -> None:
    moving = np.ones((20, 60), bool)
    flow = np.full((20, 60, 2), [1.25, 0.0], np.float32)
    both = {1: flow, -1: -flow}
    views = [
        View(moving, np.zeros((20, 60, 3)), moving.astype(float), both, {1: moving, -1: moving})
        for _ in range(4)
    ]
    tracks = follow(views)
    begun = np.argmin(tracks.age, 1)
    here = np.take_along_axis(tracks.pixels[..., 0], begun[:, None], 1)
    expected = here + 1.25 * (np.arange(4) - begun[:, None])
    seen = tracks.trust > 0
    assert np.allclose(tracks.pixels[..., 0][seen], expected[seen], atol=1e-4)
    assert np.array_equal(tracks.age, abs(np.arange(4) - begun[:, None]))


def test_tracks_end_between_two_things() -> None:
    moving = np.ones((9, 40), bool)
    flow = np.where(
        np.arange(40)[None, :, None] < 20, np.float32([6.0, 0.0]), np.float32([-3.0, 0.0])
    ).repeat(9, 0)
    view = View(moving, np.zeros((9, 40, 3)), moving.astype(float), {1: flow}, {1: moving})
    out = advance(
        view, view, 1, np.array([[19.0, 4.5], [20.0, 4.5], [21.2, 4.5]])
    )  # the border is at x = 20
    assert (
        out[0, 0] == pytest.approx(25) and np.isnan(out[1, 0]) and out[2, 0] == pytest.approx(18.2)
    )


def test_tracks_without_neighbors_are_parts_by_themselves() -> None:
    points, _, _ = body(0, np.array([0, 0, 3.0]), np.array([0.05, 0, 0]), 0.1, count=12)
    near = tracked(points)
    far = [replace(near, pixels=near.pixels + 1000.0 * k) for k in range(12)]
    every = Tracks(
        *(
            np.concatenate([getattr(t, f) for t in far])
            for f in ("pixels", "points", "trust", "patch", "age")
        )
    )
    assert len(np.unique(parts(every))) == PARTS


@pytest.mark.filterwarnings("error")
def test_one_time_is_no_error() -> None:
    points, _, _ = body(0, np.array([0, 0, 3.0]), np.array([0.05, 0, 0]), 0.1)
    pixels = 200 * points[:, :1, :2] / points[:, :1, 2:] + 100
    once = np.ones((len(points), 1))
    groups = gather(Tracks(pixels, points[:, :1], once, once.astype(int), once.astype(int)))
    assert len(groups) == 1 and abs(groups[0].shifts).max() < 1e-12
