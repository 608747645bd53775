"""Depth of movers that several cameras see at the same instants: a wall, and before
it a square that is somewhere else at every time.
"""

from dataclasses import replace

import numpy as np
import pytest
from posed_planes import RAYS, H, K, W, cameras_at, plane

from hdr_nsff.priors.depth.geometric import same_time_depth
from hdr_nsff.priors.depth.parallax import candidates
from hdr_nsff.priors.movers.synchronized import take_same_time_depth
from hdr_nsff.scene.manifest import FrameEntry, Manifest
from hdr_nsff.scene.posed_video import PosedVideo

WALL, SQUARE = 4.0, 2.5  # z
EYES = [(-0.3, 0.0, 0.0), (0.0, 0.0, 0.0), (0.3, 0.0, 0.0)]
TIMES = 3


def rig() -> tuple[PosedVideo, np.ndarray]:
    """Three still cameras, each with frames at three times, camera by camera; and the
    z-depth (T, H, W) of what they see.
    """
    c2w = np.repeat(cameras_at(*EYES), TIMES, axis=0)
    times = np.tile(np.arange(TIMES, dtype=float), len(EYES))
    wall, far = plane(c2w, WALL, 0.0)
    square, near = plane(c2w, SQUARE, 0.0, seed=1)
    x = RAYS[..., 0] * SQUARE + c2w[:, 0, 3, None, None]
    y = RAYS[..., 1] * SQUARE + c2w[:, 1, 3, None, None]
    middle = (-0.3 + 0.3 * times)[:, None, None]
    moving = (np.abs(x - middle) < 0.4) & (np.abs(y) < 0.4)
    video = np.where(moving[..., None], square, wall).astype(np.float32)
    clipped = np.zeros(moving.shape, bool)
    matrices = np.tile(K, (len(times), 1, 1))
    return PosedVideo(matrices, c2w, times, video, clipped, moving), np.where(moving, near, far)


def wall_points() -> np.ndarray:
    """Static points (N, 3)."""
    wall = np.concatenate([RAYS, np.ones((H, W, 1))], -1) * WALL
    return wall[::4, ::4].reshape(-1, 3)


def test_movers_have_the_depth_that_cameras_see_at_one_instant():
    clip, depth = rig()
    found = same_time_depth(clip, wall_points())
    assert found is not None
    disparity, confidence = found
    inner = clip.moving & (np.abs(RAYS[..., 1] * SQUARE) < 0.3)
    assert np.median(np.abs(disparity * depth - 1)[inner]) < 0.03
    assert np.median(np.abs(disparity * depth - 1)[~clip.moving]) < 0.03
    assert np.median(confidence[inner]) > 0.5


def test_one_camera_sees_nothing_at_the_same_instant():
    clip, _ = rig()
    alone = replace(clip, times=np.arange(len(clip.times), dtype=float))
    assert same_time_depth(alone, wall_points()) is None


def test_frames_of_other_cameras_are_near_in_time_however_many_there_are():
    times = np.tile(np.arange(200.0), 3)
    assert candidates(times, 0, same_time=True) == [200, 400]
    assert {200, 201, 400}.issubset(candidates(times, 0))
    assert 399 not in candidates(times, 0)
    single = candidates(np.arange(300.0), 150)
    assert single[0] == 150 - 144 and {149, 151, 198, 102, 204}.issubset(single)
    assert 150 not in single and 200 not in single


def test_moving_pixels_take_what_is_seen_twice_and_the_rest_of_a_region_follows():
    moving = np.zeros((1, 4, 8), bool)
    moving[0, 1:3, 1:4] = True
    moving[0, 1:3, 5:7] = True  # seen by one camera only
    before, trust = np.full(moving.shape, 0.2), np.full(moving.shape, 0.3)
    seen = np.full(moving.shape, 0.5)
    sure = np.zeros(moving.shape)
    sure[0, 1:3, 1:3] = 0.8
    disparity, confidence = take_same_time_depth(before, trust, seen, sure, moving)
    assert (disparity[0, 1:3, 1:4] == 0.5).all() and (disparity[0, 1:3, 5:7] == 0.2).all()
    assert confidence[0, 1, 1] > 0.9 and confidence[0, 1, 3] < 0.3
    assert (disparity[~moving] == 0.2).all() and (confidence[~moving] == 0.3).all()


@pytest.mark.parametrize(
    ("cameras", "tracks", "times", "expected"),
    [
        ([0, 0, 1, 1], [0, 0, 0, 0], [0, 1, 0, 1], True),
        ([0, 1, 0, 1], [0, 0, 0, 0], [0, 1, 2, 3], False),
        ([0, 0, 0, 0], [0, 0, 1, 1], [0, 1, 0, 1], False),
    ],
)
def test_cameras_are_synchronized_where_they_share_times(cameras, tracks, times, expected):
    frames = [
        FrameEntry(
            index=k, bracket=0, image=f"{k}.png", source=f"{k}", camera_id=c, track=r, time=t
        )
        for k, (c, r, t) in enumerate(zip(cameras, tracks, times, strict=True))
    ]
    manifest = Manifest(source="clip", inputs={}, width=W, height=H, frames=frames)
    assert manifest.synchronized == expected
