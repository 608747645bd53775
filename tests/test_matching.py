"""Keypoints and which frames are matched."""

import numpy as np
from posed_clips import H, W, panning

from hdr_nsff.priors.poses.matching import (
    MatchingTuning,
    detect_keypoints,
    keypoint_mask,
    match_pairs,
    sift_image,
    spread_pairs,
    view_pairs,
)


def test_no_keypoint_lies_near_ignored_pixels():
    ignore = np.zeros((1, H, W), bool)
    ignore[0, :, : W // 2] = True
    found = detect_keypoints(panning(np.zeros(1)), ignore)[0]
    assert len(found.xy) > 20 and found.xy[:, 0].min() > W / 2 + 1


def test_keypoints_have_pixel_centers_at_halves():
    dot = np.zeros((1, H, W, 3), np.float32)
    y, x = np.mgrid[:H, :W] + 0.5
    blob = np.exp(-((x - 60.5) ** 2 + (y - 40.5) ** 2) / 2 / 3**2)  # around pixel (60, 40)
    dot[0] = blob[..., None]
    xy = detect_keypoints(dot, np.zeros((1, H, W), bool))[0].xy
    assert np.linalg.norm(xy - (60.5, 40.5), axis=1).min() < 0.15


def test_small_frames_are_doubled_with_their_masks():
    ignore = np.zeros((H, W), bool)
    ignore[10, 10] = True
    assert sift_image(np.zeros((H, W, 3)), 2, True).shape == (2 * H, 2 * W)
    assert (keypoint_mask(ignore, 2, margin=0) == 0).sum() == 4


def test_noise_hides_fewer_matches_of_frames_that_are_not_doubled():
    clip = panning(np.array([0.0, 0.1]))
    noisy = clip + np.random.default_rng(0).normal(0, 0.08, clip.shape)
    ignore = np.zeros(clip.shape[:3], bool)

    def num_matches(denoise_px):
        tuning = MatchingTuning(small_side=0, denoise_px=denoise_px)
        keypoints = detect_keypoints(noisy, ignore, tuning)
        return len(match_pairs(keypoints, [(0, 1)], tuning)[0].p)

    assert num_matches(0.7) > 1.3 * num_matches(0.0) > 10


def test_pairs_include_frames_of_equal_exposure():
    pairs = spread_pairs(20)
    assert [j for i, j in pairs if i == 0] == [1, 2, 3, 4, 6, 8, 12, 16]
    assert all(i < j < 20 for i, j in pairs)


def test_many_views_of_two_cameras_meet_at_the_same_time():
    pairs = view_pairs([list(range(20)), list(range(20, 40))])
    assert {(k, 20 + k) for k in range(20)} <= set(pairs) and (0, 25) not in pairs
