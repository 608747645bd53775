"""Which views are keyframes, which pairs are matched, and what masks leave."""

import numpy as np

from hdr_nsff.priors.poses.view_matches import (
    KeyframeTuning,
    ViewMatches,
    choose_keyframes,
    pairs_to_match,
)


def test_a_short_clip_is_mapped_at_once():
    assert choose_keyframes([list(range(48))]) == []


def test_keyframes_of_a_long_clip_are_spread_and_bounded():
    chosen = choose_keyframes([list(range(600))])
    assert len(chosen) == KeyframeTuning().max_keyframes
    assert chosen[0] == 0 and chosen[-1] == 599
    assert np.ptp(np.diff(chosen)) <= 1


def test_every_camera_of_a_rig_has_keyframes():
    groups = [list(range(0, 80, 2)), list(range(1, 80, 2))]
    chosen = choose_keyframes(groups)
    assert {0, 78, 1, 79} <= set(chosen)


def test_the_number_of_pairs_grows_with_the_number_of_frames():
    numbers = []
    for count in (150, 300, 600):
        group = [list(range(count))]
        numbers.append(len(pairs_to_match(group, choose_keyframes(group))))
    assert numbers[2] - numbers[1] <= 4 * 300 and numbers[1] - numbers[0] <= 4 * 150


def test_a_view_between_keyframes_is_matched_with_those_around_it():
    group = [list(range(100))]
    keyframes = choose_keyframes(group)
    view = next(v for v in range(50, 100) if v not in keyframes)
    partners = {a + b - view for a, b in pairs_to_match(group, keyframes) if view in (a, b)}
    nearest = sorted(keyframes, key=lambda k: abs(k - view))[:2]
    assert len(partners) == 4 and set(nearest) <= partners <= set(keyframes)


def test_masked_keypoints_leave_with_their_matches():
    points = np.array([[0.5, 0.5], [2.5, 0.5], [3.5, 1.5]])
    matches = ViewMatches([points, points], [(0, 1)], [np.array([[0, 0], [1, 1], [2, 2]])])
    mask = np.full((2, 4), 255, np.uint8)
    hidden = mask.copy()
    hidden[0, 0] = 0
    left = matches.outside([hidden, mask])
    assert np.array_equal(left.keypoints[0], points[1:])
    assert left.matches[0].tolist() == [[0, 1], [1, 2]]
