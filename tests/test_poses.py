"""Poses of a clip: interpolation between registered frames, and trusted points."""

import numpy as np
import pytest
from posed_clips import H, K, W
from scipy.spatial.transform import Rotation

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.poses import Poses, format_ranges, interpolate, project, trusted_points


def test_missing_poses_lie_between_their_neighbors():
    c2w = np.tile(np.eye(4)[:3], (4, 1, 1))
    c2w[2, :, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    c2w[2, 0, 3] = 2.0
    filled = interpolate(
        Poses(np.tile(K, (4, 1, 1)), c2w, np.array([True, False, True, False]), "full"),
        [[0, 1, 2, 3]],
    )
    assert np.allclose(filled.c2w[1, :, 3], (1, 0, 0))
    assert np.degrees(Rotation.from_matrix(filled.c2w[1, :, :3]).magnitude()) == pytest.approx(45)
    assert np.allclose(filled.c2w[3], c2w[2])  # held beyond the last
    assert filled.notes == (
        "2 of 4 frames did not register; their poses are interpolated (frames 1, 3)",
    )


def test_points_seen_twice_or_badly_are_not_trusted():
    points = np.array([[0, 0, 4.0], [0, 0, 4], [0, 0, 4]])
    tracks = np.array([[t, p, W / 2, H / 2] for p, n in enumerate((3, 2, 3)) for t in range(n)])
    poses = Poses(
        np.tile(K, (3, 1, 1)),
        np.tile(np.eye(4)[:3], (3, 1, 1)),
        np.ones(3, bool),
        "full",
        points,
        np.array([0.1, 0.1, 5]),
        tracks,
    )
    kept = trusted_points(poses)
    assert len(kept.points) == 1 and kept.tracks[:, 1].tolist() == [0, 0, 0]
    assert np.allclose(kept.frame_errors, 0)


def test_ranges_of_frames_read_well():
    assert format_ranges([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"
    assert format_ranges(list(range(0, 40, 2))).endswith("...")


def test_a_single_registered_frame_lends_its_pose_to_all():
    c2w = np.tile(np.eye(4)[:3], (3, 1, 1))
    c2w[1, :, 3] = (1, 2, 3)
    poses = Poses(np.tile(K, (3, 1, 1)), c2w, np.array([False, True, False]), "full")
    assert (interpolate(poses, [[0, 1, 2]]).c2w[:, :, 3] == (1, 2, 3)).all()


def test_a_camera_without_registered_frames_is_refused_in_a_sentence():
    c2w = np.tile(np.eye(4)[:3], (4, 1, 1))
    poses = Poses(np.tile(K, (4, 1, 1)), c2w, np.array([True, False, True, False]), "full")
    with pytest.raises(InputError, match=r"frames 1, 3.*--poses"):
        interpolate(poses, [[0, 2], [1, 3]])


def test_every_point_is_projected_into_its_frame():
    c2w = np.tile(np.eye(4)[:3], (2, 1, 1))
    c2w[1, 0, 3] = 1.0  # one unit to the right: half a focal length at depth 2
    poses = Poses(np.tile(K, (2, 1, 1)), c2w, np.ones(2, bool), "full")
    pixels, depth = project(poses, np.array([0, 1]), np.array([[0, 0, 2.0], [0, 0, 2.0]]))
    np.testing.assert_allclose(pixels, [[W / 2, H / 2], [W / 2 - K[0, 0] / 2, H / 2]])
    assert depth.tolist() == [2, 2]
