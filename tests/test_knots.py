"""Time as knots: where a time lies among the training times, and curves through values
at knots.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.knots import catmull_rom, interpolate_linear, knot_of

every_curve = pytest.mark.parametrize("curve", [interpolate_linear, catmull_rom])
Curve = Callable[[Tensor, float], Tensor]


def values(count: int = 6) -> Tensor:
    return torch.randn(count, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_a_time_is_a_position_among_uneven_training_times() -> None:
    times = torch.tensor([0.0, 1.0, 3.0, 7.0], dtype=torch.float64)
    assert [knot_of(times, t) for t in (0.0, 1.0, 3.0, 7.0)] == [0, 1, 2, 3]
    assert [knot_of(times, t) for t in (0.25, 2.0, 4.0)] == [0.25, 1.5, 2.25]
    assert (knot_of(times, -1.0), knot_of(times, 9.0)) == (0, 3)


def test_a_single_training_time_is_knot_0() -> None:
    assert knot_of(torch.tensor([4.0]), 9.0) == 0


@every_curve
def test_a_curve_passes_through_its_values(curve: Curve) -> None:
    v = values()
    for k in range(len(v)):
        torch.testing.assert_close(curve(v, float(k)), v[k], rtol=0, atol=1e-14)


@every_curve
@pytest.mark.parametrize("count", [2, 3, 6])
def test_linear_motion_is_reproduced_also_at_the_ends(curve: Curve, count: int) -> None:
    start, velocity = values()[:2]
    v = start + torch.arange(count, dtype=torch.float64)[:, None, None] * velocity
    for position in (0.0, 0.3, 0.9, count - 1.5, count - 1.01, count - 1.0):
        torch.testing.assert_close(curve(v, position), start + position * velocity)


@every_curve
def test_a_single_value_is_constant(curve: Curve) -> None:
    v = values(1)
    assert torch.equal(curve(v, 0.0), v[0])


def test_linear_interpolation_half_way_is_the_mean() -> None:
    v = values()
    torch.testing.assert_close(interpolate_linear(v, 3.5), (v[3] + v[4]) / 2)


def test_a_parabola_is_reproduced_by_the_cubic_away_from_the_ends() -> None:
    v = torch.arange(6, dtype=torch.float64)[:, None] ** 2
    for position in (1.2, 2.5, 3.9):
        expected = torch.tensor([position**2], dtype=torch.float64)
        torch.testing.assert_close(catmull_rom(v, position), expected)


def test_the_cubics_velocity_is_continuous_and_that_of_the_neighbors() -> None:
    v, e = values(), 1e-6
    for k in range(1, 5):
        before = (catmull_rom(v, float(k)) - catmull_rom(v, k - e)) / e
        after = (catmull_rom(v, k + e) - catmull_rom(v, float(k))) / e
        torch.testing.assert_close(before, after, atol=1e-4, rtol=0)
        torch.testing.assert_close(after, (v[k + 1] - v[k - 1]) / 2, atol=1e-4, rtol=0)


def test_the_cubics_gradient_reaches_four_knots_and_no_more() -> None:
    v = values().requires_grad_()
    catmull_rom(v, 2.5).sum().backward()
    share = v.grad[:, 0, 0]
    torch.testing.assert_close(share, torch.tensor([0, -1, 9, 9, -1, 0], dtype=torch.float64) / 16)
