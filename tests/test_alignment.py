"""Two worlds of the same cameras: what rotation, shift and scale do not change."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdr_nsff.geometry.alignment import (
    nearest_rotation,
    pose_errors,
    scale_between,
    transfer_pose,
    umeyama,
)

TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
SHIFT = np.array([1.0, -2.0, 0.5])


def random_poses(count: int) -> np.ndarray:
    """Poses (count, 3, 4)."""
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()
    return np.concatenate([rotations, rng.normal(size=(count, 3, 1))], 2)


def in_another_world(poses: np.ndarray, scale: float) -> np.ndarray:
    """The same poses (N, 3, 4) turned, scaled and shifted."""
    centers = scale * poses[:, :, 3] @ TURN.T + SHIFT
    return np.concatenate([TURN @ poses[:, :, :3], centers[:, :, None]], 2)


def test_umeyama_recovers_scale_rotation_and_translation():
    source = np.random.default_rng(1).normal(size=(9, 3))
    fit = umeyama(source, 3 * source @ TURN.T + SHIFT)
    assert fit is not None and fit.scale == pytest.approx(3)
    np.testing.assert_allclose(fit.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(fit.translation, SHIFT, atol=1e-12)


def test_umeyama_never_mirrors():
    source = np.random.default_rng(1).normal(size=(9, 3))
    fit = umeyama(source, source * [1, 1, -1])
    assert fit is not None and np.linalg.det(fit.rotation) == pytest.approx(1)


def test_poses_in_another_world_have_no_error():
    poses = random_poses(9)
    errors = pose_errors(poses, in_another_world(poses, 2.5))
    assert errors == pytest.approx({"ate": 0, "ate_share": 0, "rotation_degrees": 0}, abs=1e-6)


def test_a_turn_of_every_other_camera_is_half_of_it_after_alignment():
    """Half of the cameras turn by 10 degrees about their own axis x: the common
    rotation is 5 degrees, which leaves 5 on both sides.
    """
    poses = np.tile(np.eye(4)[:3], (8, 1, 1))
    poses[:, :, 3] = np.random.default_rng(0).normal(size=(8, 3))
    turned = poses.copy()
    turned[::2, :, :3] = Rotation.from_euler("x", 10, degrees=True).as_matrix()
    assert pose_errors(poses, turned)["rotation_degrees"] == pytest.approx(5)


def test_the_scale_between_worlds_is_found_and_is_one_for_given_poses():
    poses = random_poses(9)
    assert scale_between(poses, in_another_world(poses, 2.5)) == pytest.approx(2.5)
    assert scale_between(poses, poses) == 1
    poses[:, :, 3] = 0
    assert scale_between(poses, in_another_world(poses, 2.5)) is None


def test_a_carried_pose_is_the_pose_in_the_other_world():
    poses = random_poses(2)
    other = in_another_world(poses, 2.5)
    np.testing.assert_allclose(
        transfer_pose(other[0], poses[0], poses[1], 2.5), other[1], atol=1e-12
    )


def test_the_nearest_rotation_is_that_of_a_matrix_with_small_errors():
    rotations = random_poses(20)[:, :, :3]
    noise = 0.01 * np.random.default_rng(3).standard_normal(rotations.shape)
    found = nearest_rotation(rotations + noise)
    assert np.abs(found - rotations).max() < 0.04
    np.testing.assert_allclose(found @ found.swapaxes(1, 2), [np.eye(3)] * 20, atol=1e-12)
    np.testing.assert_allclose(nearest_rotation(rotations), rotations, atol=1e-12)


def test_the_nearest_rotation_of_a_mirror_is_no_mirror():
    mirror = np.diag([3.0, 2.0, -1.0])
    np.testing.assert_allclose(nearest_rotation(mirror), np.eye(3), atol=1e-12)


def test_the_nearest_rotation_of_a_cross_covariance_maps_source_to_target():
    source = np.random.default_rng(4).standard_normal((30, 3))
    found = nearest_rotation((source @ TURN.T).T @ source)
    np.testing.assert_allclose(found, TURN, atol=1e-12)
