"""Keypoints of rolling frames against a camera that sees all rows at once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import posed_clips
import pytest
from test_prepare import footage, given

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.tensors import CPU
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.prepare.steps.poses import read_round, write_round
from hdr_nsff.priors.poses.estimate import estimate_poses
from hdr_nsff.priors.poses.mapper import Mapper
from hdr_nsff.priors.poses.reconstruct import ReconstructionTuning, SfmViews
from hdr_nsff.priors.poses.rolling_shutter import at_middle_rows, best_readout
from hdr_nsff.priors.poses.view_matches import EarlierRounds, ViewMatches
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


@pytest.mark.parametrize(
    ("least", "gain", "found"),
    [(0.6, 0.09, 0.6), (1.1, 0.3, 1.1), (0.6, 0.01, 0.0), (-0.2, 0.1, 0.0), (1.6, 0.9, 0.0)],
)
def test_a_readout_is_where_the_error_is_least(least: float, gain: float, found: float) -> None:
    """`gain`: the share by which the error falls from a readout of 0."""
    squared = (1 - gain) ** 2, 1 - (1 - gain) ** 2
    measured = best_readout(lambda r: (squared[0] + squared[1] * (1 - r / least) ** 2) ** 0.5)
    assert measured == pytest.approx(found)


def test_errors_that_have_no_least_value_mean_no_readout() -> None:
    assert best_readout(lambda r: 1 - 0.1 * r**2) == best_readout(lambda r: 1.0) == 0


def sliding(readout: float) -> np.ndarray:
    """A painted clip (T, H, W, 3) whose rows are read one after the other, by bands."""
    bands, frames = 12, np.arange(10)
    clip = np.zeros((len(frames), posed_clips.H, posed_clips.W, 3), np.float32)
    height = posed_clips.H // bands
    for band in range(bands):
        time = frames + readout * ((band + 0.5) / bands - 0.5)
        shake = 0.15 * np.sin(time / 2), 0.1 * np.cos(time / 2)
        places = np.stack([time / 9 - 0.5, *shake], 1)
        rows = slice(band * height, (band + 1) * height)
        clip[:, rows] = posed_clips.sliding(places)[:, rows]
    return clip


def test_structure_from_motion_measures_the_readout(tmp_path: Path) -> None:
    found = estimate_poses(sliding(0.6), None, tmp_path, threads=1, readout="auto")
    assert found.readout == pytest.approx(0.6, abs=0.1)


def test_where_nothing_maps_with_a_readout_the_poses_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> Poses:
        raise InputError("too few views")

    nothing = np.zeros((2, 8, 8), bool)
    views = SfmViews(np.zeros((2, 8, 8, 3)), nothing, [[0, 1]], np.arange(2))
    earlier = EarlierRounds(model={"cameras.bin": b""})
    mapper = Mapper(views, tmp_path, 1, "sift", ReconstructionTuning(), CPU, earlier)
    poses = Poses(np.eye(3)[None], np.eye(4)[None, :3], np.ones(1, bool), "full")
    for name in ("model", "poses"):
        monkeypatch.setattr(Mapper, name, fail)
        assert mapper.with_measured_readout(poses) is poses and earlier.readout == 0
        assert "not measured, taken for none: too few views" in capsys.readouterr().err
        monkeypatch.setattr(Mapper, "measured_readout", lambda _: 0.5)
    assert earlier.model == {"cameras.bin": b""}


def test_the_first_round_keeps_its_readout(tmp_path: Path) -> None:
    K, c2w = np.tile(np.eye(3), (2, 1, 1)), np.tile(np.eye(4)[:3], (2, 1, 1))
    poses = Poses(K, c2w, np.ones(2, bool), "full", readout=0.25)
    write_round(tmp_path / "round.npz", poses, np.zeros((2, 8, 8), bool), {})
    assert read_round(tmp_path / "round.npz")[0].readout == 0.25


def test_a_scene_keeps_the_readout_of_its_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip = footage(tmp_path / "clip")
    config = PrepareConfig(clip, tmp_path / "scene", hold_out=0, **given(tmp_path))
    assert Manifest.load(prepare(config)).readout == 0
    assert Manifest.load(prepare(replace(config, readout=20.0))).readout == 20
    assert Manifest.load(prepare(replace(config, readout="auto"))).readout == 0
    assert "--readout auto: not measured" in capsys.readouterr().err  # the poses are given
    assert Manifest.load(prepare(config)).readout == 0
