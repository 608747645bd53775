"""What the visits of a camera show: the static scene, and movers before it."""

import cv2
import numpy as np
from posed_clips import texture

from hdr_nsff.priors.masks.visits import VisitTuning, separate_movers, without_movers

H, W, VISITS = 60, 90, 4
BACKGROUND = texture(0, W, H)


def visits() -> tuple[np.ndarray, np.ndarray]:
    """Frames (V, H, W, 3) of one camera with a bright square that moves on, and where
    it is (V, H, W).
    """
    video, moving = np.stack([BACKGROUND] * VISITS), np.zeros((VISITS, H, W), bool)
    for k in range(VISITS):
        moving[k, 20:40, 5 + 20 * k : 25 + 20 * k] = True
    video[moving] = 1 - video[moving] ** 2
    noise = np.random.default_rng(0).normal(0, 0.01, video.shape)
    return np.clip(video + noise, 0, 1).astype(np.float32), moving


def test_movers_differ_from_what_most_visits_show():
    video, truth = visits()
    found = separate_movers(video, np.zeros_like(truth), [0] * VISITS)
    assert (found.moving & truth).sum() > 0.95 * truth.sum()
    margin = np.ones((9, 9), np.uint8)  # 4 pixels
    around = np.stack([cv2.dilate(mask.astype(np.uint8), margin) > 0 for mask in truth])
    assert not (found.moving & ~around).any()


def test_the_static_picture_is_free_of_movers():
    video, truth = visits()
    found = separate_movers(video, np.zeros_like(truth), [0] * VISITS)
    assert np.abs(found.video[0] - BACKGROUND).mean() < 0.01
    assert found.unknown.mean() < 0.01


def test_frames_that_are_held_out_shape_neither_the_picture_nor_the_masks_of_others():
    video, truth = visits()
    learned = np.array([True, True, True, False])
    changed = video.copy()
    changed[3] = 0.5
    clipped = np.zeros_like(truth)
    one, other = (separate_movers(v, clipped, [0] * VISITS, learned) for v in (video, changed))
    assert np.array_equal(one.video, other.video)
    assert np.array_equal(one.moving[learned], other.moving[learned])
    assert np.array_equal(one.distance[learned], other.distance[learned])


def test_each_camera_has_a_picture_of_its_own():
    video, _ = visits()
    both = np.stack([video, video[:, :, ::-1]], 1).reshape(-1, H, W, 3)
    clipped = np.zeros(both.shape[:3], bool)
    found = separate_movers(both, clipped, [0, 1] * VISITS)
    assert np.allclose(found.video[1], found.video[0][:, ::-1], atol=0.02)


def test_known_movers_leave_the_mean_of_the_others():
    video = np.array([1.0, 2.0, 6.0]).reshape(3, 1, 1, 1) * np.ones((3, 1, 2, 3))
    moving = np.array([[[False, True]], [[False, True]], [[True, True]]])
    picture, clipped, unknown = without_movers(
        video, np.zeros((3, 1, 2), bool), moving, [0, 0, 0], count=1
    )
    assert np.allclose(picture[0, 0, :, 0], [1.5, 3.0])  # the mean of all where none is static
    assert unknown.tolist() == [[[False, True]]]
    assert not clipped.any()


def test_clipped_visits_count_only_where_nothing_else_was_recorded():
    video = np.array([1.0, 3.0]).reshape(2, 1, 1, 1) * np.ones((2, 1, 2, 3))
    clipped = np.array([[[True, True]], [[False, True]]])
    still = np.zeros((2, 1, 2), bool)
    picture, lost, _ = without_movers(video, clipped, still, [0, 0], count=1)
    assert np.allclose(picture[0, 0, :, 0], [3.0, 2.0])
    assert lost.tolist() == [[[False, True]]]


def test_of_many_visits_those_spread_evenly_are_compared():
    few = VisitTuning(max_compared=5)
    frames = [visits()[0][k % VISITS] for k in range(3 * VISITS)]
    video, truth = np.stack(frames), np.tile(visits()[1], (3, 1, 1))
    found = separate_movers(video, np.zeros_like(truth), [0] * len(video), tuning=few)
    assert found.moving.shape == truth.shape
    assert (found.moving & truth).sum() > 0.95 * truth.sum()
    assert np.abs(found.video[0] - BACKGROUND).mean() < 0.01
