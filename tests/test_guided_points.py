"""Static points between cameras of known poses, on boards before a wall whose depth is
known.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from posed_clips import BOARDS, H, K, W, sliding
from posed_planes import oblique

from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import read_npy
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.prepare.prepare import prepare
from hdr_nsff.prepare.steps.poses import with_common_points
from hdr_nsff.prepare.work import PrepareConfig, Work
from hdr_nsff.priors.depth.guided_points import line_distances, points_between_cameras
from hdr_nsff.scene.manifest import FrameEntry, Manifest
from hdr_nsff.scene.posed_video import PosedVideo
from hdr_nsff.scene.scene import Scene

EYES = np.array([(-0.5, 0, 0), (0, 0.2, 0.1), (0.5, -0.1, 0)])


def boards_from(eyes: np.ndarray) -> PosedVideo:
    """The boards at one instant, by cameras at EYES that are said to be at `eyes`."""
    c2w = np.concatenate([np.tile(np.eye(3), (3, 1, 1)), eyes[:, :, None]], 2)
    nowhere = np.zeros((3, H, W), bool)
    video = sliding(EYES).astype(np.float32)
    return PosedVideo(np.tile(K, (3, 1, 1)), c2w, np.zeros(3), video, nowhere, nowhere)


def test_points_lie_on_the_boards():
    clip = boards_from(EYES)
    points, tracks = points_between_cameras(clip)
    depths = np.array([depth for depth, _, _ in BOARDS])
    off = np.abs(points[:, 2:] / depths - 1).min(1)
    assert len(points) > 100 and np.mean(off < 0.03) > 0.97
    frames, rows = tracks[:, :2].T.astype(int)
    assert np.bincount(rows).tolist() == [2] * len(points)
    for i in range(3):
        seen = frames == i
        pixels, _, inside = clip.project(i, points[rows[seen]])
        assert inside.all() and np.abs(pixels - tracks[seen, 2:]).max() < 2


def test_nothing_is_found_in_pixels_that_are_ignored_or_at_different_times():
    clip = boards_from(EYES)
    left = np.zeros((3, H, W), bool)
    left[:, :, : W // 2] = True
    for hidden in (replace(clip, moving=left), replace(clip, clipped=left)):
        points, tracks = points_between_cameras(hidden)
        assert len(points) and tracks[:, 2].min() > W // 2
    everywhere = np.ones_like(left)
    for empty in (replace(clip, moving=everywhere), replace(clip, times=np.arange(3.0))):
        points, tracks = points_between_cameras(empty)
        assert (points.shape, tracks.shape) == ((0, 3), (0, 4))


def test_wrong_poses_find_no_points():
    points, _ = points_between_cameras(boards_from(EYES[:, [1, 0, 2]] * (3, -1, 1)))
    assert len(points) == 0


def test_frames_that_are_held_out_give_no_points():
    clip = boards_from(EYES)
    poses = Poses(np.tile(K, (6, 1, 1)), np.tile(clip.c2w, (2, 1, 1)), np.ones(6, bool), "full")
    manifest = Manifest(source="rig", width=W, height=H)
    for index in range(6):  # three cameras at two times, of which one is held out
        entry = FrameEntry(index=index, image="", source="", time=index // 3, bracket=0)
        entry.camera_id, entry.split = index % 3, "test" if index < 3 else "train"
        manifest.frames.append(entry)
    found = []
    for held_out in (clip.video, np.random.default_rng(0).random(clip.video.shape)):
        work = Work(PrepareConfig(Path("rig"), Path("scene")), None, manifest)
        video = np.concatenate([held_out, clip.video]).astype(np.float32)
        work.equalized = video, np.zeros((6, H, W), bool)
        no_pairs = np.zeros((0, 2), int)
        work.raw_flows = np.zeros((0, H, W, 2)), np.zeros((0, H, W), bool), no_pairs
        found.append(with_common_points(work, poses))
    assert len(found[0].points) > 100 and set(found[0].tracks[:, 0]) == {3, 4, 5}
    assert np.array_equal(found[0].points, found[1].points)
    assert (found[0].near, found[0].far) == (found[1].near, found[1].far)


def test_a_pixel_is_as_far_from_the_line_as_it_was_moved():
    point, clip = np.array([[0.3, -0.2, 4.0]]), boards_from(EYES)
    p, q = (clip.project(i, point)[0] for i in (0, 1))
    assert line_distances(clip, 0, 1, p, q) == pytest.approx(0, abs=1e-9)
    far, _, _ = clip.project(1, EYES[0] + 2 * (point - EYES[0]))  # on the line too
    along = (far - q) / np.linalg.norm(far - q)
    across = along[:, ::-1] * (1, -1)
    moved = np.concatenate([q + 2 * across, q + 5 * along])
    assert line_distances(clip, 0, 1, p, moved)[0] == pytest.approx([2, 0], abs=1e-9)


def test_what_turned_cameras_see_is_on_its_line_and_on_no_other():
    clip, rng = oblique(2), np.random.default_rng(1)
    points = clip.unproject(0, rng.uniform(5, 40, (9, 2)), rng.uniform(0.2, 0.5, 9))
    p, q = (clip.project(i, points)[0] for i in (0, 1))
    distances = line_distances(clip, 0, 1, p, q)
    assert np.diag(distances).max() < 1e-3 < 1 < np.median(distances)


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
