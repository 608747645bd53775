"""Keypoints of rolling frames against a camera that sees all rows at once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_prepare import footage, given

from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.priors.poses.rolling_shutter import at_middle_rows
from hdr_nsff.priors.poses.view_matches import ViewMatches
from hdr_nsff.scene.manifest import Manifest

HEIGHT, WIDTH, FOCAL = 90, 160, 140.0
READOUT = 0.75
VIEWS = list(range(6))
POINTS = np.random.default_rng(0).uniform((-2, -1.2, 4), (2, 1.2, 9), (60, 3))


def seen(time: np.ndarray | float) -> np.ndarray:
    """POINTS (N, 3) from a camera that slides, turns and shakes, at one time or one per
    point: (N, 2) pixels.
    """
    time = np.broadcast_to(time, len(POINTS))
    yaw = 0.02 * time + 0.01 * np.sin(time)
    x, y, z = (POINTS - np.stack([0.1 * time, 0.05 * np.cos(time), 0 * time], 1)).T
    right = np.cos(yaw) * x - np.sin(yaw) * z
    ahead = np.sin(yaw) * x + np.cos(yaw) * z
    return FOCAL * np.stack([right, y], 1) / ahead[:, None] + (WIDTH / 2, HEIGHT / 2)


def rolled(view: int, readout: float = READOUT) -> np.ndarray:
    """What a rolling shutter records of them in a view, by fixed-point iteration."""
    xy = seen(float(view))
    for _ in range(20):
        xy = seen(view + readout * (xy[:, 1] / HEIGHT - 0.5))
    return xy


def matches_of(keypoints: list[np.ndarray], gaps: tuple[int, ...]) -> ViewMatches:
    """All points matched between views that are so many frames apart."""
    pairs = [(a, a + gap) for gap in gaps for a in VIEWS[:-gap]]
    rows = np.tile(np.arange(len(POINTS))[:, None], 2)
    return ViewMatches(keypoints, pairs, [rows] * len(pairs))


def error(keypoints: list[np.ndarray]) -> float:
    """The mean distance from where one sees all rows at once, pixels."""
    pairs = zip(keypoints, VIEWS, strict=True)
    return float(np.mean([np.linalg.norm(xy - seen(float(v)), axis=1).mean() for xy, v in pairs]))


@pytest.mark.parametrize(("gaps", "left"), [((1, 2, 3), 0.1), ((3, 1), 0.1), ((2,), 0.25)])
def test_keypoints_lie_where_the_middle_row_sees_them(gaps: tuple[int, ...], left: float) -> None:
    recorded = [rolled(view) for view in VIEWS]
    moved = at_middle_rows(matches_of(recorded, gaps), [VIEWS], READOUT, HEIGHT)
    assert error(moved.keypoints) < left * error(recorded)


def test_nearer_views_count_before_farther_ones() -> None:
    recorded = [rolled(view) for view in VIEWS]
    by_both = at_middle_rows(matches_of(recorded, (1, 3)), [VIEWS], READOUT, HEIGHT)
    by_next = at_middle_rows(matches_of(recorded, (1,)), [VIEWS], READOUT, HEIGHT)
    both = zip(by_both.keypoints[1:-1], by_next.keypoints[1:-1], strict=True)
    assert all(np.array_equal(a, b) for a, b in both)


def test_a_keypoint_without_near_matches_moves_as_those_around_it() -> None:
    recorded = [rolled(view) for view in VIEWS]
    found = matches_of(recorded, (1,))
    lonely = [rows[1:] for rows in found.matches]  # the first point is never matched
    moved = at_middle_rows(
        ViewMatches(recorded, found.pairs, lonely), [VIEWS], READOUT, HEIGHT
    ).keypoints
    ends = [seen(float(view))[0] for view in VIEWS]
    before = np.mean([np.linalg.norm(a[0] - b) for a, b in zip(recorded, ends, strict=True)])
    after = np.mean([np.linalg.norm(a[0] - b) for a, b in zip(moved, ends, strict=True)])
    assert after < 0.5 * before


def test_matches_that_took_no_time_show_no_velocity() -> None:
    top, bottom = np.array([[80.0, 0.0]]), np.array([[80.0, HEIGHT]])
    row = np.zeros((1, 2), int)
    found = ViewMatches([bottom, top], [(0, 1)], [row])  # read at the same moment
    same = at_middle_rows(found, [[0, 1]], 1.0, HEIGHT)
    assert np.array_equal(same.keypoints[0], bottom) and np.array_equal(same.keypoints[1], top)


def test_views_of_two_cameras_show_no_velocity() -> None:
    recorded = [rolled(view) for view in VIEWS]
    found = matches_of(recorded, (1, 3, 5))
    apart = at_middle_rows(found, [[view] for view in VIEWS], READOUT, HEIGHT)
    assert all(np.array_equal(a, b) for a, b in zip(apart.keypoints, recorded, strict=True))


def test_matches_stay_as_they_are() -> None:
    found = matches_of([rolled(view, 0.0) for view in VIEWS], (1,))
    same = at_middle_rows(found, [VIEWS], 0.0, HEIGHT)
    assert same.pairs == found.pairs and same.matches is found.matches
    assert all(np.array_equal(a, b) for a, b in zip(same.keypoints, found.keypoints, strict=True))


def test_a_scene_keeps_the_readout_of_its_poses(tmp_path: Path) -> None:
    clip = footage(tmp_path / "clip")
    config = PrepareConfig(clip, tmp_path / "scene", hold_out=0, **given(tmp_path))
    assert Manifest.load(prepare(config)).readout == 0
    assert Manifest.load(prepare(replace(config, readout=20.0))).readout == 20
    assert Manifest.load(prepare(config)).readout == 0
