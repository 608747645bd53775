"""Rotations and a focal length from matches: derivatives, steps, and how certain."""

import numpy as np
from posed_clips import FOCAL
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.poses.rotation_adjustment import (
    MAD_TO_SIGMA,
    MATCHES_PER_POINT,
    RotationMatches,
    normal_equations,
    refine,
    rotate_pixels,
    rotate_pixels_jacobian,
    solve_damped,
)


def test_derivatives_of_turned_pixels_agree_with_differences():
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(0.1 * rng.normal(size=(2, 3))).as_matrix()
    frames, p = np.tile([0, 1], (5, 1)), rng.uniform(-40, 40, (5, 2))
    before, rays = rotate_pixels(rotations, FOCAL, frames, p)
    exact = rotate_pixels_jacobian(rotations, FOCAL, frames, p, rays)
    step = 1e-6
    for k in range(7):
        moved, focal = rotations.copy(), FOCAL
        if k < 6:
            turn = Rotation.from_rotvec(step * np.eye(3)[k % 3]).as_matrix()
            moved[k // 3] = moved[k // 3] @ turn
        else:
            focal = FOCAL * np.exp(step)
        slope = (rotate_pixels(moved, focal, frames, p)[0] - before) / step
        assert np.allclose(exact[:, :, k], slope, atol=1e-2)


def test_steps_and_the_deviation_of_the_focal_length_are_those_of_the_inverse():
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(0.1 * rng.normal(size=(8, 3))).as_matrix()
    frames = np.array([(i, j) for i in range(8) for j in range(i) for _ in range(10)])
    p = rng.uniform(-40, 40, (len(frames), 2))
    noise = rng.normal(size=p.shape)
    q = rotate_pixels(rotations, FOCAL, frames, p)[0] + noise
    error = MAD_TO_SIGMA * np.median(np.linalg.norm(noise, axis=1))
    for free_focal in (False, True):
        matches = RotationMatches(frames, p, q)
        normal, right = normal_equations(rotations, FOCAL, matches, free_focal)
        exact = np.linalg.inv(normal + 0.1 * np.diag(np.diag(normal))) @ right
        assert np.allclose(solve_damped(normal, 0.1, right), exact, rtol=1e-8, atol=1e-12)
        found = refine(rotations, FOCAL, matches, free_focal, max_iterations=0)
        variance = np.linalg.inv(normal)[-1, -1] * MATCHES_PER_POINT
        assert np.isclose(found.log_focal_deviation, error * np.sqrt(variance), rtol=1e-8)
