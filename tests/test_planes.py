"""Six feature planes: features in closed form, total variation, growth."""

import pytest
import torch

from hdr_nsff.fields.baselines.planes import AXES, Planes


def test_features_are_products_of_the_planes_in_closed_form() -> None:
    planes = Planes(1, coarsest=5, finest=5, slices=3)
    u, t = torch.linspace(0, 1, 5), torch.linspace(0, 1, 3)
    # 2 first axis + 3 second axis, and 1 + third axis * time: bilinear is exact
    planes.space.data[:, 0] = 2 * u[None, :] + 3 * u[:, None]
    planes.time.data[:, 0] = 1 + u[None, :] * t[:, None]
    point, share = torch.tensor([[0.3, 0.55, 0.81]]), 0.4
    wanted = [(2 * point[0, a] + 3 * point[0, b]) * (1 + point[0, c] * share) for a, b, c in AXES]
    torch.testing.assert_close(planes(point, share)[0], torch.stack(wanted))
    assert all(set(pair) == {0, 1, 2} for pair in AXES)  # every product spans space and time


def test_total_variation_is_the_mean_square_step_along_each_axis() -> None:
    planes = Planes(2, coarsest=4, finest=9, slices=3)
    planes.space.data.zero_()
    planes.space.data[..., :4, :4] = 0.5 * torch.arange(4.0)  # steps of 0.5 along one of two axes
    planes.time.data[..., :4] = torch.arange(3.0)[:, None]  # of 1 along time
    assert float(planes.total_variation().detach()) == pytest.approx(0.25 + 1.0)


def test_growing_keeps_what_the_planes_hold() -> None:
    planes = Planes(2, coarsest=5, finest=9, slices=2)
    planes.time.data.normal_()
    points = torch.rand(50, 3)
    before = planes(points, 0.3)
    planes.grow(9)  # every old grid point is a new one
    torch.testing.assert_close(planes(points, 0.3), before, atol=1e-5, rtol=1e-4)
    assert planes.used[0].shape == (3, 2, 9, 9)


def test_only_the_parts_in_use_of_the_planes_get_gradients() -> None:
    planes = Planes(2, coarsest=4, finest=9, slices=2)
    planes(torch.rand(80, 3), 0.5).sum().backward()
    grad = planes.space.grad
    assert grad is not None and bool((grad[..., :4, :4] != 0).any())
    assert not grad[..., 4:, :].any() and not grad[..., 4:].any()
