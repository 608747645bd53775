"""Shared rigid motions: rotations about a center, mixtures of shifts, quaternions."""

import math

import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.knots import time_at
from hdr_nsff.fields.splat.rasterize import rotation_matrices
from hdr_nsff.fields.splat.trajectories import WINDOW, Trajectories, quaternion_product

KNOTS = 10


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def turning(angle: float) -> Trajectories:
    """One basis that turns about a z axis by `angle` (radians) per knot."""
    t = Trajectories(1, torch.arange(float(KNOTS)))
    t.centers[:] = torch.tensor([1.0, 2.0, 3.0])
    half = 0.5 * angle * torch.arange(KNOTS)
    t.rotations.data = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], 1)
    return t


def about_z(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_trajectories_are_at_rest_before_training() -> None:
    t, points, quaternions = (
        Trajectories(3, torch.arange(float(KNOTS))),
        random(20, 3),
        random(20, 4),
    )
    t.centers[:] = random(3, 3, seed=1)
    mixture = random(3, 20, seed=2).softmax(0)
    for knot in (0.0, 3.7, 9.0):
        torch.testing.assert_close(t.move(points, mixture, t.pose(knot)), points)
        torch.testing.assert_close(t.turn(quaternions, mixture, t.pose(knot)), quaternions)


def test_a_pure_rotation_turns_about_its_center() -> None:
    t, points = turning(0.3), random(20, 3)
    for knot in (0, 2, 9):
        expected = (points - t.centers) @ about_z(0.3 * knot).T + t.centers
        torch.testing.assert_close(t.move(points, torch.ones(1, 20), t.pose(float(knot))), expected)


def test_between_knots_a_rotation_stays_rigid_and_nearly_even() -> None:
    t, points = turning(0.3), random(20, 3)
    moved = t.move(points, torch.ones(1, 20), t.pose(4.5))
    distances, before = torch.cdist(moved, moved), torch.cdist(points, points)
    torch.testing.assert_close(distances, before, atol=1e-4, rtol=1e-4)
    expected = (points - t.centers) @ about_z(0.3 * 4.5).T + t.centers
    torch.testing.assert_close(moved, expected, atol=1e-4, rtol=1e-3)


def test_a_gaussian_turns_as_its_place_does() -> None:
    t, quaternions = turning(0.3), random(20, 4)
    turned = rotation_matrices(t.turn(quaternions, torch.ones(1, 20), t.pose(3.0)))
    torch.testing.assert_close(turned, about_z(0.9) @ rotation_matrices(quaternions))


def test_a_mixture_of_two_shifts_is_their_weighted_mean() -> None:
    t, points = Trajectories(2, torch.arange(float(KNOTS))), random(3, 3)
    shifts = t.translations.data.view(KNOTS, 2, 4)
    shifts[:, 0, 0] = torch.arange(KNOTS)  # one knot after another along x
    shifts[:, 1, 1] = 2.0 * torch.arange(KNOTS)  # twice as far along y
    mixture = torch.tensor([[1.0, 0.0, 0.25], [0.0, 1.0, 0.75]])
    expected = torch.tensor([[3.5, 0, 0], [0, 7, 0], [0.25 * 3.5, 0.75 * 7, 0]])
    torch.testing.assert_close(t.move(points, mixture, t.pose(3.5)) - points, expected)


def test_a_steady_shift_is_steady_where_a_frame_is_missing() -> None:
    times = torch.tensor([0.0, 1, 2, 4, 5, 6])
    t = Trajectories(1, times)
    t.translations.data[:, 0] = times
    for knot in torch.linspace(0, 5, 21).tolist():
        x = t.move(torch.zeros(1, 3), torch.ones(1, 1), t.pose(knot))[0, 0]
        assert float(x.detach()) == pytest.approx(time_at(times, knot), abs=1e-6)


def test_quaternions_multiply_as_rotation_matrices_do() -> None:
    a, b = random(20, 4), random(20, 4, seed=1)
    product = rotation_matrices(quaternion_product(a, b))
    expected = rotation_matrices(a) @ rotation_matrices(b)
    torch.testing.assert_close(product, expected, atol=1e-5, rtol=1e-4)


def test_rotation_matrices_turn_and_do_not_mirror() -> None:
    r = rotation_matrices(random(20, 4))
    torch.testing.assert_close(r @ r.mT, torch.eye(3).expand(20, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(r), torch.ones(20))


def test_constant_acceleration_is_smooth_and_a_jump_is_not() -> None:
    missing = torch.tensor([0.0, 1, 2, 3, 5, 6, 7, 8, 9, 11])
    for times in (torch.arange(float(KNOTS)), missing):
        t = Trajectories(2, times)
        shifts = t.translations.data.view(KNOTS, 2, 4)
        shifts[:, 0, 0] = times**2
        assert float(t.roughness(4.0, 1.0).detach()) < 1e-9
    shifts[5, 1, 2] = 1.0
    assert float(t.roughness(4.0, 1.0).detach()) > 0.1
    assert float(t.roughness(0.0, 1.0).detach()) == 0  # the jump is outside of the window


def test_a_drawn_knot_has_gradients_only_where_it_is_marked() -> None:
    t = Trajectories(2, torch.arange(20.0))
    t.rotations.data += 0.1 * random(40, 4)
    mixture = random(2, 5, seed=1).softmax(0)
    knot = 9.3
    t.mark(knot)
    moved = t.move(random(5, 3), mixture, t.pose(knot))
    turned = t.turn(random(5, 4), mixture, t.pose(knot))
    (moved.square().sum() + turned[:, 1].sum() + t.roughness(knot, 1.0)).backward()
    for values, touched in (
        (t.rotations, t.rotations_touched),
        (t.translations, t.translations_touched),
    ):
        has = (values.grad != 0).any(1)
        assert bool(has.any()) and bool((touched[has] == 1).all())
    marked = t.rotations_touched.view(20, 2)[:, 0].nonzero()[:, 0].tolist()
    assert marked == list(range(9 - WINDOW, 10 + WINDOW))
