"""Time as knots: a knot is a position on the sorted list of training times, 0 at the
first and T - 1 at the last. What varies in time is kept at knots and interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hdr_nsff.core.tensors import constant


def knot_of(times: Tensor, time: float) -> float:
    """Position of a time (in frames) on the sorted training times (T,).

    It is clamped to their range.
    """
    if len(times) == 1:
        return 0.0
    wanted = torch.tensor(time, dtype=times.dtype, device=times.device)
    after = int(torch.searchsorted(times, wanted).clamp(1, len(times) - 1))
    before = after - 1
    fraction = (time - times[before]) / (times[after] - times[before])
    return float(before + fraction.clamp(0, 1))


def time_at(times: Tensor, knot: float) -> float:
    """The time (in frames) at a position on the sorted training times (T,)."""
    if len(times) == 1:
        return float(times[0])
    before = min(int(knot), len(times) - 2)
    return float(torch.lerp(times[before], times[before + 1], knot - before))


def interpolate_linear(values: Tensor, position: float) -> Tensor:
    """`values` (K, ...) at `position` in [0, K - 1], linear in between: (...)."""
    if len(values) == 1:
        return values[0]
    low, fraction = linear_position(len(values), position)
    return weighted_rows(values[low : low + 2], [1 - fraction, fraction])


def linear_position(count: int, position: float) -> tuple[int, float]:
    """The row below a position in [0, count - 1], and the share of the next one."""
    if count == 1:
        return 0, 0.0
    low = min(int(position), count - 2)
    return low, position - low


def cubic(values: Tensor, times: Sequence[float], position: float) -> Tensor:
    """`values` (K, ...) of K rising `times` at `position` in [0, K - 1], by a cubic
    through them: (...).

    A cubic of Hermite with continuous velocity: at a time, that of the parabola through
    its value and the two beside it; at both ends, that of the line to the neighbor. So
    linear motion is reproduced everywhere, at any times. At even times it is the cubic
    of Catmull and Rom 1974.
    """
    first_row, weights = cubic_weights(times, position)
    return weighted_rows(values[first_row : first_row + len(weights)], weights)


def cubic_weights(times: Sequence[float], position: float) -> tuple[int, list[float]]:
    """The first of the rows that `cubic` adds up, and their weights (1 to 4)."""
    last = len(times) - 1
    if last == 0:
        return 0, [1.0]
    low = min(max(int(position), 0), last - 1)
    u = position - low
    gap = times[low + 1] - times[low]
    # this gap over those before and after, which are endless at the ends
    before = gap / (times[low] - times[low - 1]) if low > 0 else 0.0
    after = gap / (times[low + 2] - times[low + 1]) if low + 1 < last else 0.0
    start, end = u * (1 - u) ** 2, -u * u * (1 - u)  # of the velocities at both times
    # of the steps from row low - 1 to low, to low + 1, to low + 2
    step_before = start * before**2 / (1 + before)
    step = u * u * (3 - 2 * u) + start / (1 + before) + end / (1 + after)
    step_after = end * after**2 / (1 + after)
    weights = [-step_before, 1 + step_before - step, step - step_after, step_after]
    first_row, end_row = max(low - 1, 0), min(low + 3, last + 1)
    return first_row, weights[first_row - low + 1 : end_row - low + 1]


def weighted_rows(values: Tensor, weights: list[float]) -> Tensor:
    """The sum of the rows of `values` (K, ...) times `weights` (K): (...).

    One product and not a sum of rows, whose gradients would each fill all of `values`.
    """
    factors = constant(tuple(weights), values.device, values.dtype)
    return (factors @ values.flatten(1)).view(values.shape[1:])
