"""Time as knots: where a time lies among the training times, and curves through values
at knots.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.knots import cubic, interpolate_linear, knot_of

Curve = Callable[[Tensor, float], Tensor]
EVEN, UNEVEN = [0.0, 1, 2, 3, 4, 5], [0.0, 1, 2, 4, 4.5, 9]


def even_cubic(values: Tensor, position: float) -> Tensor:
    return cubic(values, EVEN[: len(values)], position)


every_curve = pytest.mark.parametrize("curve", [interpolate_linear, even_cubic])
any_times = pytest.mark.parametrize("times", [EVEN, UNEVEN])


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


@any_times
def test_a_parabola_is_reproduced_by_the_cubic_away_from_the_ends(times: list[float]) -> None:
    t = torch.tensor(times, dtype=torch.float64)[:, None]
    for position in (1.2, 2.5, 3.9):
        expected = interpolate_linear(t, position) ** 2
        torch.testing.assert_close(cubic(t**2, times, position), expected)


@pytest.mark.parametrize("count", [2, 3, 6])
def test_linear_motion_is_reproduced_by_the_cubic_at_uneven_times(count: int) -> None:
    t = torch.tensor(UNEVEN[:count], dtype=torch.float64)[:, None]
    for position in torch.linspace(0, count - 1, 41).tolist():
        found = cubic(t, UNEVEN[:count], position)
        torch.testing.assert_close(found, interpolate_linear(t, position), rtol=0, atol=1e-12)


@any_times
def test_the_cubics_velocity_is_continuous(times: list[float]) -> None:
    v, e = values(), 1e-6
    for k in range(1, 5):
        before = (cubic(v, times, float(k)) - cubic(v, times, k - e)) / e
        after = (cubic(v, times, k + e) - cubic(v, times, float(k))) / e
        before, after = before / (times[k] - times[k - 1]), after / (times[k + 1] - times[k])
        torch.testing.assert_close(before, after, atol=1e-4, rtol=0)
        if times is EVEN:
            torch.testing.assert_close(after, (v[k + 1] - v[k - 1]) / 2, atol=1e-4, rtol=0)


def test_the_cubics_gradient_reaches_four_knots_and_no_more() -> None:
    v = values().requires_grad_()
    even_cubic(v, 2.5).sum().backward()
    share = v.grad[:, 0, 0]
    torch.testing.assert_close(share, torch.tensor([0, -1, 9, 9, -1, 0], dtype=torch.float64) / 16)
