"""Cameras of the synthetic scenes, as plain arrays."""

import numpy as np
import pytest
import torch

from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.pinhole import project
from hdr_nsff.synth.scenes.geometry import intrinsics, look_at
from hdr_nsff.synth.scenes.interior import camera_pose


def test_camera_sees_57_degrees_across() -> None:
    """Half of 240 pixels over tan(28.5 degrees) = 0.54296: focal 221.0."""
    K = intrinsics(240, 136)
    assert K[0, 0] == pytest.approx(221.0, abs=0.05) and K[1, 1] == K[0, 0]
    pixel, depth = project(np.array([0.5, -0.25, 2.0]), K, np.eye(3, 4))
    np.testing.assert_allclose(pixel, [120 + K[0, 0] / 4, 68 - K[0, 0] / 8])
    assert depth == 2.0


def test_camera_looks_at_its_target_level() -> None:
    eye, target = np.array([0.3, -0.2, 0.1]), np.array([-0.1, 0.4, 3.0])
    c2w = look_at(eye, target)
    pixel, depth = project(target, intrinsics(240, 136), c2w)
    np.testing.assert_allclose(pixel, [120, 68], atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm(target - eye))
    np.testing.assert_allclose(c2w[:, :3].T @ c2w[:, :3], np.eye(3), atol=1e-12)
    assert c2w[1, 0] == pytest.approx(0) and c2w[1, 1] > 0.9  # x horizontal, y down


def test_projection_agrees_with_the_camera_of_the_package() -> None:
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (9, 3))
    c2w, K = camera_pose(5.5), intrinsics(240, 136)
    camera = Camera(torch.tensor(K), torch.tensor(c2w), 240, 136)
    pixels, depth = project(points, K, c2w)
    expected, expected_depth = camera.project(torch.tensor(points))
    np.testing.assert_allclose(pixels, expected.numpy(), atol=1e-9)
    np.testing.assert_allclose(depth, expected_depth.numpy(), atol=1e-12)
