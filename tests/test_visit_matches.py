"""Keypoints and matches of a rig's cameras, merged from all of their visits."""

from pathlib import Path

import numpy as np
import pytest
import torch
from posed_clips import BOARDS, FOCAL, H, W, sliding

from hdr_nsff.priors.poses import sfm, visit_matches
from hdr_nsff.priors.poses.lightglue import LightGlueTuning
from hdr_nsff.priors.poses.matching import MatchingTuning
from hdr_nsff.priors.poses.view_matches import ViewMatches
from hdr_nsff.priors.poses.visit_matches import (
    VisitImages,
    VisitTuning,
    choose_visits,
    match_visits,
    merge_points,
    merge_visits,
    most_frequent,
)


def test_points_in_one_cell_become_their_mean():
    points = np.array([[1.2, 3.4], [7.5, 2.5], [1.6, 3.8]])
    merged, row_of = merge_points(points, cell=1.0)
    assert np.allclose(merged[row_of], [[1.4, 3.6], [7.5, 2.5], [1.4, 3.6]])


def test_a_keypoint_keeps_its_most_frequent_match():
    matches = np.array([[0, 5], [0, 6], [0, 5], [1, 6]])
    assert sorted(most_frequent(matches).tolist()) == [[0, 5], [1, 6]]


def test_matches_of_frames_are_matches_of_their_cameras():
    # images 0 and 2 are of camera 0, images 1 and 3 of camera 1
    here, there = np.array([[2.5, 2.5], [8.5, 8.5]]), np.array([[4.5, 2.5]])
    found = ViewMatches(
        keypoints=[here, there, here[::-1], there],
        pairs=[(0, 1), (1, 2)],
        matches=[np.array([[0, 0]]), np.array([[0, 1]])],
    )
    merged = merge_visits(found, np.array([0, 1, 0, 1]))
    assert merged.pairs == [(0, 1)]
    (a, b) = merged.matches[0][0]
    assert merged.keypoints[0][a].tolist() == [2.5, 2.5]
    assert merged.keypoints[1][b].tolist() == [4.5, 2.5]
    assert len(merged.matches[0]) == 1


def test_images_of_one_camera_are_not_matched_with_each_other():
    video = np.zeros((12, 4, 4, 3), np.float32)
    ignore = np.zeros((12, 4, 4), bool)
    places = [t % 3 for t in range(12)]
    visits = choose_visits(video, ignore, video[:3], ignore[:3], places)
    assert visits.camera.tolist() == [0, 1, 2] + [0] * 4 + [1] * 4 + [2] * 4
    assert len(visits.pairs()) == 3 * 5 * 5
    assert all(visits.camera[a] != visits.camera[b] for a, b in visits.pairs())


def test_large_rigs_match_fewer_frames_per_camera():
    video = np.zeros((80, 2, 2, 3), np.float32)
    ignore = np.zeros((80, 2, 2), bool)
    places = [t % 40 for t in range(80)]
    visits = choose_visits(video, ignore, video[:40], ignore[:40], places, VisitTuning())
    assert len(visits.camera) == 80  # the static picture and one frame each


BASELINE = 0.2  # between two cameras side by side, scene units
TOP = 20  # rows of every frame that are ignored
HALF = W // 2


def two_cameras() -> VisitImages:
    """Two cameras that take turns twice. A mover hides the left half of every first
    visit and the right half of every second one. Of the static pictures, the left half
    of the second camera's is known alone.
    """
    places = [0, 1, 0, 1]
    eyes = np.array([[-BASELINE / 2, 0, 0], [BASELINE / 2, 0, 0]])
    video = sliding(eyes[places])
    ignore = np.zeros((4, H, W), bool)
    ignore[:, :TOP] = True
    ignore[:2, :, :HALF] = True
    ignore[2:, :, HALF:] = True
    hidden = np.ones((2, H, W), bool)
    hidden[1, TOP:, :HALF] = False
    return choose_visits(video, ignore, video[:2], hidden, places)


def exact(images, masks, pairs, matcher, tuning, device):
    """A grid of points on the far wall, each the same row in every image."""
    assert (images[0].shape, len(masks)) == ((2 * H, 2 * W, 3), 6)
    x, y = np.meshgrid(np.arange(30.0, 2 * W - 30, 8), np.arange(4.0, 2 * H, 8))
    here = np.stack([x.ravel(), y.ravel()], 1)
    there = here - [2 * FOCAL * BASELINE / BOARDS[0][0], 0]
    points = [there if camera else here for camera in two_cameras().camera]
    return points, [np.repeat(np.arange(len(here))[:, None], 2, 1) for _ in pairs]


@pytest.mark.parametrize("matcher", ["sift", "aliked"])
def test_visits_see_what_movers_hide_in_others(
    matcher: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames are doubled, so the cameras' shift is twice that of pixels."""
    if matcher == "sift":
        pytest.importorskip("pycolmap")
    monkeypatch.setattr(visit_matches, "match_images", exact)
    job = sfm.Job(str(tmp_path), [["0.png"], ["1.png"]], [], 2 * FOCAL, "match")
    tunings = MatchingTuning(), LightGlueTuning(), VisitTuning()
    found = match_visits(job, two_cameras(), True, matcher, torch.device("cpu"), *tunings)
    assert found.pairs == [(0, 1)]
    rows = found.matches[0]
    assert len(np.unique(rows[:, 0])) == len(np.unique(rows[:, 1])) == len(rows)
    a, b = (points[rows[:, side]] for side, points in enumerate(found.keypoints))
    depths = [board[0] for board in BOARDS]
    shifts = [2 * FOCAL * BASELINE / depth for depth in (max(depths), min(depths))]
    assert (np.abs(a[:, 1] - b[:, 1]) < 1.5).mean() > 0.95
    right = (a - b)[:, 0]
    assert ((right > shifts[0] - 1.5) & (right < shifts[1] + 1.5)).mean() > 0.95
    for points in (a, b):
        assert points[:, 1].min() > 2 * TOP
        left = points[:, 0] < 2 * HALF
        assert left.sum() > 20 and (~left).sum() > 20
