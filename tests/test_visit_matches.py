"""Keypoints and matches of a rig's cameras, merged from all of their visits."""

import numpy as np

from hdr_nsff.priors.poses.view_matches import ViewMatches
from hdr_nsff.priors.poses.visit_matches import (
    VisitTuning,
    choose_visits,
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
