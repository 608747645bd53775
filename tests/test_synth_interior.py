"""The synthetic room: its movers and its rig."""

import numpy as np
import pytest
from synth_scene import BOX, ROOM

from hdr_nsff.geometry.pinhole import project
from hdr_nsff.synth.scenes.geometry import intrinsics
from hdr_nsff.synth.scenes.interior import CORD, INTERIOR, PIVOT, ball_pose, box_pose, camera_pose


def test_ball_swings_on_a_circle_about_its_pivot() -> None:
    """At angle a it hangs CORD cos(a) below the pivot and CORD sin(a) beside it."""
    for t in (0.0, 3.5, 17.0):
        center = (ball_pose(t) @ [0, CORD, 0, 1])[:3] - PIVOT
        angle = np.radians(18) * np.sin(2 * np.pi * (t + 4) / 30)
        assert center[1] == pytest.approx(CORD * np.cos(angle))
        assert np.hypot(center[0], center[2]) == pytest.approx(CORD * abs(np.sin(angle)))


def test_moved_carries_movers_rigidly_and_leaves_the_room() -> None:
    rng = np.random.default_rng(0)
    local = rng.normal(size=(5, 3))
    start, end = (local @ box_pose(t)[:3, :3].T + box_pose(t)[:3, 3] for t in (4.0, 9.5))
    points = np.concatenate([start, local])
    bodies = np.array([BOX] * 5 + [ROOM] * 5)
    result = INTERIOR.moved(points, bodies, np.zeros((10, 2)), 4.0, 9.5)
    np.testing.assert_allclose(result[:5], end, atol=1e-12)
    np.testing.assert_array_equal(result[5:], local)


def test_motion_between_frames_stays_within_ten_pixels() -> None:
    K = intrinsics(240, 136)
    for t in range(36):
        for pose, point in ((box_pose, [0.1, 0.1, 0.1, 1]), (ball_pose, [0, CORD, 0, 1])):
            before, depth = project((pose(t) @ point)[:3], K, camera_pose(t))
            after, _ = project((pose(t + 1) @ point)[:3], K, camera_pose(t + 1))
            assert np.linalg.norm(after - before) < 10 and depth > 1
            assert (before > 0).all() and (before < [240, 136]).all()  # always in the picture


def test_the_rig_is_two_rows_of_cameras_that_look_at_one_place() -> None:
    eyes = np.array([INTERIOR.pose("rig", k)[:, 3] for k in range(9)])
    assert np.ptp(eyes, axis=0) == pytest.approx([1.2, 0.28, 0])
    assert sorted(np.unique(eyes[:, 1], return_counts=True)[1]) == [4, 5]
    beside = np.linalg.norm(eyes - np.roll(eyes, 1, axis=0), axis=1)
    assert beside.max() < 0.35  # the next to record stands beside, also after the last
    target, K = np.array(INTERIOR.rig_target), intrinsics(240, 136)
    for k in range(9):
        pixel, _ = project(target, K, INTERIOR.pose("rig", k))
        np.testing.assert_allclose(pixel, [120, 68], atol=1e-9)


def test_every_camera_of_the_rig_always_sees_both_movers() -> None:
    K = intrinsics(240, 136)
    boxes = [(box_pose(t) @ [0, 0, 0, 1])[:3] for t in range(36)]
    balls = [(ball_pose(t) @ [0, CORD, 0, 1])[:3] for t in range(36)]
    centers = boxes + balls
    for k in range(9):
        pixels, depth = project(np.array(centers), K, INTERIOR.pose("rig", k))
        assert (pixels > 20).all() and (pixels < [220, 116]).all() and (depth > 1.5).all()
