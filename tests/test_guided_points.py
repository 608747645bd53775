"""Static points between cameras of known poses, on boards before a wall whose depth is
known.
"""

import json

import numpy as np
import pytest
from posed_clips import BOARDS, H, K, W, sliding

from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import read_npy
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.prepare.prepare import prepare
from hdr_nsff.prepare.work import PrepareConfig
from hdr_nsff.priors.poses.guided_points import (
    GuidedTuning,
    line_distances,
    points_between_cameras,
    triangulate_pair,
)
from hdr_nsff.scene.scene import Scene

EYES = np.array([(-0.5, 0, 0), (0, 0.2, 0.1), (0.5, -0.1, 0)])


def poses_at(eyes: np.ndarray) -> Poses:
    """Cameras at `eyes` (T, 3) that look along +z."""
    c2w = np.concatenate([np.tile(np.eye(3), (len(eyes), 1, 1)), eyes[:, :, None]], 2)
    return Poses(np.tile(K, (len(eyes), 1, 1)), c2w, np.ones(len(eyes), bool), "full")


def test_points_lie_on_the_boards():
    video, hidden = sliding(EYES).astype(np.float32), np.zeros((3, H, W), bool)
    found = points_between_cameras(poses_at(EYES), video, hidden, np.zeros(3))
    depths = np.array([depth for depth, _, _ in BOARDS])
    off = np.abs(found.points[:, 2:] / depths - 1).min(1)
    assert len(found.points) > 100 and np.mean(off < 0.03) > 0.97
    assert np.bincount(found.tracks[:, 1].astype(int)).tolist() == [2] * len(found.points)
    assert found.point_errors.max() < GuidedTuning().max_error_px


def test_nothing_is_found_in_pixels_that_are_ignored_or_at_different_times():
    video, hidden = sliding(EYES).astype(np.float32), np.zeros((3, H, W), bool)
    hidden[:, :, : W // 2] = True
    found = points_between_cameras(poses_at(EYES), video, hidden, np.zeros(3))
    assert len(found.points) and found.tracks[:, 2].min() > W // 2
    for ignore, times in ((np.ones_like(hidden), np.zeros(3)), (hidden, np.arange(3.0))):
        poses = poses_at(EYES)
        assert points_between_cameras(poses, video, ignore, times) is poses


def test_wrong_poses_find_no_points():
    video, hidden = sliding(EYES).astype(np.float32), np.zeros((3, H, W), bool)
    wrong = poses_at(EYES[:, [1, 0, 2]] * (3, -1, 1))
    assert len(points_between_cameras(wrong, video, hidden, np.zeros(3)).points) == 0


def test_a_point_is_found_on_its_line_and_where_it_is():
    point, poses = np.array([[0.3, -0.2, 4.0]]), poses_at(EYES)
    local = point - EYES[:2]
    p, q = local[:, None, :2] / local[:, None, 2:] * K[0, 0] + (W / 2, H / 2)
    assert line_distances(poses, 0, 1, p, q) == pytest.approx(0, abs=1e-9)
    along = EYES[1] - EYES[0]
    across = np.array([[-along[1], along[0]]]) / np.hypot(*along[:2])
    assert 1.5 < line_distances(poses, 0, 1, p, q + 2 * across)[0, 0] <= 2
    found, error = triangulate_pair(poses, 0, 1, p, q)
    assert found == pytest.approx(point) and error == pytest.approx(0, abs=1e-9)
    assert np.isinf(triangulate_pair(poses, 0, 1, q, p)[1]).all()  # rays meet behind


def test_still_cameras_with_given_poses_have_depth_and_whole_masks(tmp_path):
    frames = []
    for k, (eye, picture) in enumerate(zip(EYES, sliding(EYES), strict=True)):
        for t in range(9):  # something dark passes
            frame = picture.copy()
            frame[30:60, 13 * t : 13 * t + 40] = 0.03
            write_png(tmp_path / "rig" / f"camera{k}" / f"{t}.png", frame)
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = eye
        frames.append({"file_path": f"camera{k}", "transform_matrix": pose.tolist()})
    size = {"w": W, "h": H, "fl_x": K[0, 0], "cx": W / 2, "cy": H / 2}
    (tmp_path / "poses.json").write_text(json.dumps({"frames": frames, **size}))
    config = PrepareConfig(
        tmp_path / "rig", tmp_path / "scene", poses=tmp_path / "poses.json", hold_out=0
    )
    prepare(config)
    scene = Scene.open(tmp_path / "scene")
    assert len(read_npy(tmp_path / "scene" / "points.npy")) > 50
    assert 1 < scene.near < 2.6 and 6 < scene.far < 12
    depths = np.array([depth for depth, _, _ in BOARDS])
    covered = []
    for frame in scene.train:
        assert frame.disparity is not None and frame.disparity_confidence is not None
        known = frame.disparity_confidence.numpy() > 0.5
        off = np.abs(1 / frame.disparity.numpy()[known][:, None] / depths - 1).min(1)
        assert known.mean() > 0.5 and np.median(off) < 0.05
        at = 13 * int(frame.time)
        assert frame.moving is not None
        covered.append(float(frame.moving[30:60, at : at + 40].float().mean()))
    assert min(covered) > 0.9
