"""Depth from known poses: planes with closed forms, parts worked by hand, and regions
without evidence.
"""

import numpy as np
import pytest
from estimates import geometric_depth
from posed_planes import (
    RAYS,
    SWEEPING,
    H,
    K,
    W,
    cameras_at,
    exact_flow,
    neighbors,
    plane,
)

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.io import write_npy
from hdr_nsff.footage.depth_files import read_depth_files
from hdr_nsff.priors.depth import geometric as depth_module
from hdr_nsff.scene.posed_video import PosedVideo

NO_POINTS = np.zeros((0, 3))


def solve(c2w, video, depth, moving=None, clipped=None, **given):
    """`geometric_depth` with exact flow of the static scene."""
    nothing = np.zeros(video.shape[:3], bool)
    moving, clipped = (nothing if m is None else m for m in (moving, clipped))
    pairs = neighbors(len(c2w))
    flow = exact_flow(c2w, depth, pairs)
    valid = ~clipped[pairs[:, 0]] & ~clipped[pairs[:, 1]]
    count = len(c2w)
    times = given.get("times", np.arange(count, dtype=np.float64))
    clip = PosedVideo(np.tile(K, (count, 1, 1)), c2w, times, video, clipped, moving)
    return geometric_depth(clip, flow, valid, pairs, given.get("points", NO_POINTS))


@pytest.mark.parametrize(("z0", "slope"), [(4.0, 0.0), (4.0, 0.6), (2.5, -0.4)])
def test_a_plane_seen_by_a_moving_camera_has_its_disparity_everywhere(z0, slope):
    video, depth = plane(SWEEPING, z0, slope)
    disparity, confidence, near, far = solve(SWEEPING, video, depth)
    error = np.abs(disparity * depth - 1)
    assert np.median(error) < 0.01 and np.quantile(error[:, 4:-4, 4:-4], 0.95) < 0.04
    assert np.median(confidence) > 0.7
    assert near < depth.min() * 1.02 and far > depth.max() * 0.98


def test_exposure_does_not_change_the_disparity():
    """Correlation is blind to gain and offset."""
    video, depth = plane(SWEEPING, 4.0, 0.3)
    video[::2] = 0.1 + 0.5 * video[::2]
    disparity, *_ = solve(SWEEPING, video, depth)
    assert np.median(np.abs(disparity * depth - 1)) < 0.015


def test_two_frames_are_enough():
    c2w = cameras_at((0, 0, 0), (0.3, 0, 0))
    video, depth = plane(c2w, 4.0, 0.0)
    disparity, *_ = solve(c2w, video, depth)
    assert np.median(np.abs(disparity * depth - 1)) < 0.03


def test_clipped_pixels_are_filled_from_other_frames_with_less_confidence():
    video, depth = plane(SWEEPING, 4.0, 0.3)
    clipped = np.zeros(video.shape[:3], bool)
    clipped[3, 10:30, 20:40] = True
    video[clipped] = 1.0
    disparity, confidence, *_ = solve(SWEEPING, video, depth, clipped=clipped)
    inside = np.s_[3, 12:28, 22:38]
    assert np.median(np.abs(disparity * depth - 1)[inside]) < 0.02
    assert confidence[inside].mean() < confidence[3, 12:28, 42:58].mean()


def test_a_moving_region_has_low_confidence_and_is_never_behind_the_scene():
    video, depth = plane(SWEEPING, 4.0, 0.0)
    moving = np.zeros(video.shape[:3], bool)
    moving[:, 16:32, 24:40] = True
    drifting = SWEEPING.copy()
    # as if its camera went elsewhere: no single depth explains it
    drifting[:, 1, 3] += 0.3 * np.arange(7) ** 1.5
    video[moving] = plane(drifting, 3.0, 0.0, seed=5)[0][moving]
    disparity, confidence, *_ = solve(SWEEPING, video, depth, moving=moving)
    assert confidence[moving].max() <= 0.5 < np.median(confidence[~moving])
    assert disparity[moving].min() > 0.98 / 4.0


def test_movers_are_at_rest_between_cameras_of_one_time():
    """Five cameras, one time: the 'moving' region has exact parallax."""
    c2w = SWEEPING[1:6]
    video, depth = plane(c2w, 4.0, 0.0)
    moving = np.zeros(video.shape[:3], bool)
    moving[:, 16:32, 24:40] = True
    disparity, confidence, *_ = solve(c2w, video, depth, moving=moving, times=np.zeros(5))
    assert np.median(np.abs(disparity * depth - 1)[moving]) < 0.02
    assert np.median(confidence[moving]) > 0.6


def test_without_parallax_all_depth_is_one_and_a_message_reports_it(monkeypatch):
    messages = []
    monkeypatch.setattr(depth_module, "say", messages.append)
    c2w = cameras_at(*[(0.001 * t, 0, 0) for t in range(4)])
    video, depth = plane(c2w, 4.0, 0.0)
    disparity, confidence, near, far = solve(c2w, video, depth)
    assert (disparity == 1).all() and (confidence == 0).all() and (near, far) == (0.5, 2.0)
    assert "parallax" in messages[0]


def test_clipped_frames_have_depth_of_low_confidence():
    """All is clipped: only structure from motion's points are left; confidence
    is low.
    """
    video, depth = plane(SWEEPING, 4.0, 0.0)
    wall = np.concatenate([4 * RAYS, np.full((H, W, 1), 4.0)], -1)
    points = wall[::4, ::4].reshape(-1, 3)
    clipped = np.ones(video.shape[:3], bool)
    disparity, confidence, near, far = solve(SWEEPING, video, depth, points=points, clipped=clipped)
    assert np.isfinite(disparity).all() and (disparity > 0).all()
    assert confidence.max() < 0.5 and 0 < near < far


def test_a_mask_over_the_static_scene_is_seen_through():
    """A region that was called moving but obeys the plane's depth in all frames gets
    the plane's disparity and its confidence.
    """
    video, depth = plane(SWEEPING, 4.0, 0.0)
    moving = np.zeros(video.shape[:3], bool)
    moving[3, 16:32, 24:40] = True
    disparity, confidence, *_ = solve(SWEEPING, video, depth, moving=moving)
    assert np.median(np.abs(disparity * depth - 1)[moving]) < 0.01
    assert np.median(confidence[moving]) > 0.6


def test_given_maps_become_disparity_by_their_kind(tmp_path):
    values = np.full((H, W), 4.0, np.float32)
    values[0, 0] = 0  # not measured
    write_npy(tmp_path / "0.npy", values)
    write_exr(tmp_path / "1.exr", {"Z": values})
    files = [tmp_path / "0.npy", tmp_path / "1.exr"]
    disparity, confidence = read_depth_files(files, "metric", (H, W))
    assert np.allclose(disparity, 0.25) and confidence[0, 0, 0] == 0 and confidence[:, 1:].all()
    assert np.allclose(read_depth_files(files, "disparity", (H, W))[0][:, 1:], 4.0)
    assert np.allclose(read_depth_files(files, "relative", (H, W))[0][0], values)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.ones((H, W + 1)), "shape"),
        (np.full((H, W), np.inf), "NaN or Inf"),
        (np.zeros((H, W)), "no depth above 0"),
    ],
)
def test_a_bad_depth_map_is_one_sentence(tmp_path, values, words):
    write_npy(tmp_path / "0.npy", values)
    with pytest.raises(InputError, match=words):
        read_depth_files([tmp_path / "0.npy"], "metric", (H, W))


def test_sky_has_no_part_in_near_and_far():
    disparity = np.full((2, 8, 8), 0.5, np.float32)
    disparity[:, :3] = 0
    ones = np.ones_like(disparity)
    near, far = depth_module.depth_range(disparity, ones)
    assert (near, far) == pytest.approx((1.6, 2.4))
    assert depth_module.depth_range(disparity, 0 * ones) == pytest.approx((1.0, 4.0))
    with pytest.raises(InputError, match="endlessly far away"):
        depth_module.depth_range(0 * ones, ones)
