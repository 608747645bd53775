"""Depth on shrunk frames, and how it returns to the pixels of the frames."""

import numpy as np
import pytest

from hdr_nsff.priors.depth.coarse import CoarseTuning, at_pixels, coarseness, shrink
from hdr_nsff.scene.posed_video import PosedVideo

HEIGHT, WIDTH = 37, 50


@pytest.fixture
def clip() -> PosedVideo:
    """Two frames, left half dark and right half bright."""
    video = np.full((2, HEIGHT, WIDTH, 3), 0.2, np.float32)
    video[:, :, 23:] = 0.8
    K = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    pose = np.eye(4)[:3]
    mask = np.zeros((2, HEIGHT, WIDTH), bool)
    return PosedVideo(np.stack([K, K]), np.stack([pose, pose]), np.arange(2.0), video, mask, mask)


def test_small_frames_are_not_shrunk():
    assert coarseness((136, 240)) == 1
    assert coarseness((360, 640)) == 2
    assert coarseness((720, 1280)) == 3


def test_a_point_is_seen_at_the_same_place_of_the_shrunk_frame(clip):
    small = shrink(clip, 2)
    point = np.array([[0.3, -0.2, 2.0]])
    pixel, cell = clip.project(0, point)[0], small.project(0, point)[0]
    height, width = small.size
    assert cell[0] == pytest.approx(pixel[0] * [width / WIDTH, height / HEIGHT])


def test_an_edge_of_depth_follows_the_edge_of_the_picture(clip):
    small = shrink(clip, 2)
    disparity = np.where(np.arange(small.size[1]) < 12, 0.25, 1.0).astype(np.float32)
    disparity = np.broadcast_to(disparity, (2, *small.size)).copy()
    found, trust = at_pixels(clip, small, disparity, np.ones_like(disparity), CoarseTuning())
    assert np.allclose(found[0][:, :22], 0.25) and np.allclose(found[0][:, 24:], 1.0)
    assert set(np.unique(found[1]).round(4)) == {0.25, 1.0}
    assert np.allclose(trust[0], 1)
