"""The numpy pinhole camera: closed forms, inverses, and its torch twin."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.cameras import Camera

K = np.array([[60.0, 0, 32], [0, 50, 24], [0, 0, 1]])


def random_poses(*shape: int) -> np.ndarray:
    """Poses (*shape, 3, 4) near the origin."""
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(0.3 * rng.normal(size=(*shape, 3)).reshape(-1, 3))
    matrices = rotations.as_matrix().reshape(*shape, 3, 3)
    return np.concatenate([matrices, rng.normal(size=(*shape, 3, 1))], -1)


def random_points(*shape: int) -> np.ndarray:
    """Points (*shape, 3) in front of those poses."""
    return np.random.default_rng(1).normal(size=(*shape, 3)) + np.array([0, 0, 4])


def test_a_point_on_the_axis_projects_to_the_principal_point():
    c2w = np.concatenate([np.eye(3), [[1.0], [2], [3]]], 1)
    pixels, depth = pinhole.project(np.array([1.0, 2, 8]), K, c2w)
    assert pixels.tolist() == [32, 24] and depth == 5


def test_one_unit_to_the_right_at_depth_two_is_half_a_focal_length():
    pixels, _ = pinhole.project(np.array([1.0, 0, 2]), K, np.eye(4)[:3])
    assert pixels.tolist() == [32 + 60 / 2, 24]


def test_pixel_centers_are_at_halves_x_before_y():
    centers = pinhole.pixel_centers(2, 3)
    assert centers.shape == (2, 3, 2) and centers[1, 2].tolist() == [2.5, 1.5]


def test_numpy_and_torch_cameras_project_equally():
    c2w = random_poses()
    camera = Camera(torch.from_numpy(K), torch.from_numpy(c2w), 64, 48)
    points = 3 * random_points(200) - [0, 0, 8]
    assert (pinhole.to_camera(points, c2w)[:, 2] < 0).any()  # behind the camera, too
    pixels, depth = pinhole.project(points, K, c2w)
    torch_pixels, torch_depth = camera.project(torch.from_numpy(points))
    np.testing.assert_allclose(depth, torch_depth.numpy(), atol=1e-12)
    np.testing.assert_allclose(pixels, torch_pixels.numpy(), rtol=1e-9)


def test_numpy_and_torch_cameras_have_the_same_rays_and_pixels():
    c2w = random_poses()
    camera = Camera(torch.from_numpy(K), torch.from_numpy(c2w), 64, 48)
    pixels = pinhole.pixel_centers(48, 64).reshape(-1, 2)
    np.testing.assert_array_equal(pixels, camera.pixel_grid().numpy())
    rays = camera.rays(torch.from_numpy(pixels))
    points = pinhole.unproject(pixels, np.full(len(pixels), 2.5), K, c2w)
    np.testing.assert_allclose(points, rays.origins + 2.5 * rays.directions, atol=1e-12)


def test_unprojection_inverts_projection():
    c2w = random_poses()
    points = random_points(50)
    points = points[pinhole.to_camera(points, c2w)[:, 2] > 0.1]
    pixels, depth = pinhole.project(points, K, c2w)
    np.testing.assert_allclose(pinhole.unproject(pixels, depth, K, c2w), points, atol=1e-9)


def test_world_rays_reach_points_at_their_depth():
    c2w, points = random_poses(), random_points(50)
    pixels, depth = pinhole.project(points, K, c2w)
    reached = c2w[:, 3] + depth[:, None] * pinhole.world_rays(pixels, K, c2w)
    np.testing.assert_allclose(reached, points, atol=1e-12)


def test_world_and_camera_coordinates_are_inverses():
    c2w, points = random_poses(), random_points(20)
    np.testing.assert_allclose(pinhole.to_world(pinhole.to_camera(points, c2w), c2w), points)


def test_transfer_is_projection_of_the_unprojected_pixel():
    first, second = random_poses(2)
    pixels = np.array([[20.5, 11.5], [40.0, 30.0]])
    depth = np.array([2.5, 6.0])
    A, b = pinhole.transfer(K, first, K, second)
    image = pinhole.homogeneous(pixels) @ A.T + b / depth[:, None]
    points = pinhole.unproject(pixels, depth, K, first)
    expected, expected_depth = pinhole.project(points, K, second)
    np.testing.assert_allclose(image[:, :2] / image[:, 2:], expected, rtol=1e-9)
    np.testing.assert_allclose(image[:, 2] * depth, expected_depth, rtol=1e-9)


def test_leading_shapes_broadcast():
    """Five cameras and seven points: all pairs, and camera n with point n."""
    c2w, points = random_poses(5), random_points(7)
    pixels, depth = pinhole.project(points, K, c2w[:, None])
    assert pixels.shape == (5, 7, 2) and depth.shape == (5, 7)
    each, _ = pinhole.project(points[:5], np.tile(K, (5, 1, 1)), c2w)
    np.testing.assert_allclose(each, pixels[range(5), range(5)])


def test_points_behind_the_camera_project_through_the_least_depth():
    pixels, depth = pinhole.project(np.array([1.0, 0, -2]), K, np.eye(4)[:3], min_depth=0.5)
    assert depth == -2
    assert pixels.tolist() == [32 + 60 / 0.5, 24]
