"""Moving masks, corrected by difference from the background of other frames."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.prepare.steps import masks
from hdr_nsff.prepare.work import PrepareConfig, Work
from hdr_nsff.priors.masks.background import BackgroundTuning, correct_by_background
from hdr_nsff.scene.manifest import FrameEntry, Manifest

T, H, W = 12, 40, 60
BODY = np.s_[10:34, 20:34]
HOLE = np.s_[14:30, 24:30]
K = np.array([[60.0, 0, W / 2], [0, 60.0, H / 2], [0, 0, 1]])
STILL = np.tile(np.eye(3, 4), (T, 1, 1))
ONE_GROUP = np.zeros(T, int)
ALL = np.ones(T, bool)


def clip(seed=0):
    """A textured background before which a dark body stands in frame 5 alone."""
    noise = np.random.default_rng(seed)
    wall = np.repeat(np.repeat(noise.uniform(0.3, 1, (H // 4, W // 4, 3)), 4, 0), 4, 1)
    video = np.tile(wall, (T, 1, 1, 1)) + noise.normal(0, 0.01, (T, H, W, 3))
    video[5][BODY] = 0.05
    return video.astype(np.float32)


def mask_with_hole():
    moving = np.zeros((T, H, W), bool)
    moving[5][BODY] = True
    moving[5][HOLE] = False
    return moving


def test_a_hole_in_a_body_is_filled_and_nothing_else():
    filled = correct_by_background(mask_with_hole(), clip(), ONE_GROUP, ALL, K, STILL)
    assert filled[5][HOLE].mean() > 0.95
    outside = np.ones((H, W), bool)
    outside[9:35, 19:35] = False
    assert not filled[5][outside].any() and not filled[np.arange(T) != 5].any()


def test_marked_pixels_that_equal_the_background_leave_the_mask():
    before = mask_with_hole()
    before[5, 5:15, 45:55] = True
    before[3, 10:20, 10:20] = True
    corrected = correct_by_background(before, clip(), ONE_GROUP, ALL, K, STILL)
    assert not corrected[5, 5:15, 45:55].any() and not corrected[3].any()
    assert corrected[5][BODY].mean() > 0.95


def test_a_body_that_flow_marked_once_is_followed_through_time():
    video, moving = clip(), np.zeros((T, H, W), bool)
    for t in range(4, 9):
        video[t][10:34, 10 + 3 * t : 20 + 3 * t] = 0.05
    moving[6][10:34, 28:38] = True
    corrected = correct_by_background(moving, video, ONE_GROUP, ALL, K, STILL)
    for t in (4, 5, 7, 8):
        assert corrected[t][10:34, 10 + 3 * t : 20 + 3 * t].mean() > 0.95
    assert not corrected[[0, 1, 2, 3, 9, 10, 11]].any()


def test_a_solid_body_needs_no_mark_before_a_still_camera():
    nothing = np.zeros((T, H, W), bool)
    corrected = correct_by_background(nothing, clip(), ONE_GROUP, ALL, K, STILL)
    assert corrected[5][BODY].mean() > 0.95
    assert not corrected[np.arange(T) != 5].any()
    turning = STILL.copy()
    turning[0, :, :3] = Rotation.from_euler("y", 0.01).as_matrix()
    assert not correct_by_background(nothing, clip(), ONE_GROUP, ALL, K, turning).any()


def test_thin_changes_need_a_mark():
    video = clip()
    video[5] = video[4]
    for row in (6, 18, 30):  # of branches in the wind
        video[5, row : row + 3, 10:50] = 0.05
    nothing, tuning = np.zeros((T, H, W), bool), BackgroundTuning(solid_radius_share=0.1)
    assert not correct_by_background(nothing, video, ONE_GROUP, ALL, K, STILL, tuning).any()
    corrected = correct_by_background(nothing, clip(), ONE_GROUP, ALL, K, STILL, tuning)
    assert corrected[5][BODY].mean() > 0.95


def test_a_faint_change_needs_a_mark():
    video = clip()
    video[5] = video[4]
    video[5][BODY] -= 0.08
    nothing = np.zeros((T, H, W), bool)
    assert not correct_by_background(nothing, video, ONE_GROUP, ALL, K, STILL).any()


def test_frames_of_other_exposures_show_no_background():
    alone = np.arange(T) == 5
    before = mask_with_hole()
    assert (correct_by_background(before, clip(), alone.astype(int), ALL, K, STILL) == before).all()


def test_a_frame_that_is_brighter_as_a_whole_is_left_alone():
    video = clip()
    video[5] *= 0.5
    before = mask_with_hole()
    assert (correct_by_background(before, video, ONE_GROUP, ALL, K, STILL) == before).all()


def test_held_out_frames_show_training_frames_nothing():
    train = np.arange(T) == 5
    before = mask_with_hole()
    assert (correct_by_background(before, clip(), ONE_GROUP, train, K, STILL) == before).all()


def test_the_last_frame_of_a_camera_is_no_neighbor_of_the_first_of_the_next(monkeypatch):
    video, moving = np.concatenate([clip(), clip(1)]), np.zeros((2 * T, H, W), bool)
    video[5] = video[4]
    video[T - 1][BODY], moving[T - 1][BODY] = 0.05, True
    video[T + 5] = video[T + 4]
    video[T][BODY] -= 0.08  # a leaf, which needs a mark
    frames = [
        FrameEntry(index=i, image="", source="", time=i % T, bracket=0, camera_id=i // T)
        for i in range(2 * T)
    ]
    for f in frames:
        f.K, f.c2w = K.tolist(), STILL[0].tolist()
    manifest = Manifest(source="rig", width=W, height=H, parallax="none", frames=frames)
    work = Work(PrepareConfig(Path("rig"), Path("scene")), None, manifest)
    work.equalized = video, np.zeros(moving.shape, bool)
    work.raw_flows = np.zeros((0, H, W, 2)), np.zeros((0, H, W), bool), np.zeros((0, 2), int)
    monkeypatch.setattr(masks, "geometric_mask", lambda *given, **more: moving.copy())
    found = masks.estimated_masks(work)
    assert found[T - 1][BODY].mean() > 0.95 and not found[T].any()


def test_the_background_of_a_turning_camera_is_aligned():
    y, x = np.mgrid[:H, :W] + 0.5
    c2w, video, moving = STILL.copy(), clip(), mask_with_hole()
    for t in range(T):
        c2w[t, :, :3] = Rotation.from_euler("y", 0.01 * (t - 5)).as_matrix()
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ c2w[t, :, :3].T
        angle = np.arctan2(rays[..., 0], rays[..., 2])
        video[t] = (0.6 + 0.3 * np.sin(30 * angle))[..., None]
    video[5][BODY] = 0.05
    filled = correct_by_background(moving, video, ONE_GROUP, ALL, K, c2w)
    assert filled[5][HOLE].mean() > 0.9 and filled.sum() <= 24 * 14 + 80
    # frames twice as large are compared on the same grid
    tuning, twice = BackgroundTuning(working_pixels=H * W), np.array([[2.0], [2], [1]])
    large, larger = (images.repeat(2, 1).repeat(2, 2) for images in (video, moving))
    found = correct_by_background(larger, large, ONE_GROUP, ALL, twice * K, c2w, tuning)
    assert np.array_equal(found, filled.repeat(2, 1).repeat(2, 2))
