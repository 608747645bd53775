"""Rigid motion of known bodies from their tracks, and robust rigid fits."""

from dataclasses import replace

import numpy as np
import pytest
from moving_bodies import TIMES, body, tracked
from scipy.spatial.transform import Rotation

from hdr_nsff.geometry.alignment import nearest_rotation
from hdr_nsff.priors.movers.rigid_motion import fit_motion, fit_rigid
from hdr_nsff.priors.movers.tuning import RIGID_GROUPS_TUNING


def test_a_rigid_fit_survives_a_third_of_wrong_points() -> None:
    rng = np.random.default_rng(0)
    source, r = rng.standard_normal((60, 3)), Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix()
    target = source @ r.T + [1.0, 2.0, 3.0]
    target[:20] += rng.uniform(1, 3, (20, 3))
    tuning = replace(RIGID_GROUPS_TUNING, robust_rounds=30)
    rotation, translation = fit_rigid(source, target, np.ones(60), tuning)
    assert abs(rotation - r).max() < 1e-3 and abs(translation - [1, 2, 3]).max() < 1e-3


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.5, 3.0])
def test_a_rigid_fit_is_a_reweighted_one_of_kabsch(noise: float) -> None:
    rng = np.random.default_rng(1)
    source, weight = rng.standard_normal((50, 3)), rng.uniform(0.1, 1, 50)
    target = source @ Rotation.from_rotvec([1.2, -2.0, 0.6]).as_matrix().T + [1.0, 2.0, 3.0]
    target += noise * rng.standard_normal((50, 3))
    w = weight
    for _ in range(RIGID_GROUPS_TUNING.robust_rounds):
        a, b = np.average(source, 0, w), np.average(target, 0, w)
        r = nearest_rotation((w[:, None] * (target - b)).T @ (source - a))
        residual = np.linalg.norm(source @ r.T + b - r @ a - target, axis=-1)
        w = weight / (1 + (residual / (np.median(residual) + 1e-9)) ** 2)
    rotation, translation = fit_rigid(source, target, weight)
    assert abs(rotation - r).max() < 1e-9 and abs(translation - (b - r @ a)).max() < 1e-9


def test_a_rigid_fit_never_mirrors() -> None:
    source = np.random.default_rng(0).standard_normal((20, 3))
    rotation, _ = fit_rigid(source, source * [1, 1, -1], np.ones(20))
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_few_points_give_a_translation_without_rotation() -> None:
    source = np.random.default_rng(0).standard_normal((4, 3))
    target = source @ Rotation.from_rotvec([0, 0, 1.0]).as_matrix().T + 5
    rotation, translation = fit_rigid(source, target, np.ones(4))
    assert np.array_equal(rotation, np.eye(3)) and abs(translation - 5).max() < 2


def test_the_motion_of_one_body_is_found_from_tracks_that_come_and_go() -> None:
    points, rotations, _ = body(0, np.array([0, 0, 3.0]), np.array([0.05, 0, 0.01]), 0.1)
    tracks = tracked(points, noise=0.01)
    group = fit_motion(tracks, np.arange(len(points)))
    middle = slice(2, TIMES - 2)  # few tracks are left at the ends
    relative = group.rotations @ group.rotations[TIMES // 2].T
    assert abs(relative - rotations @ rotations[TIMES // 2].T)[middle].max() < 0.06
    centered = points - group.center - group.translations  # (N, TIMES, 3)
    canonical = np.einsum("ntj,tji->nti", centered, group.rotations)
    deviation = np.linalg.norm(canonical - canonical[:, [TIMES // 2]], axis=-1)
    assert deviation[:, middle].max() < 0.06


def test_a_steady_motion_stays_steady_over_uneven_times() -> None:
    points, _, positions = body(0, np.array([0, 0, 3.0]), np.array([0.05, 0, 0.01]), 0.0)
    kept = np.array([0, 1, 2, 4, 5, 9, 10, 11, 13])  # of TIMES frames
    tracks = tracked(points)
    visible = np.ones((len(points), len(kept)))
    tracks = replace(tracks.at(kept), points=points[:, kept], trust=visible)
    group = fit_motion(tracks, np.arange(len(points)))
    steps = np.diff(group.translations, axis=0)
    assert np.allclose(steps, np.diff(positions[kept], axis=0), atol=1e-9)
