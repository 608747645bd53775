"""Time as knots: a knot is a position on the sorted list of training times, 0 at the
first and T - 1 at the last. What varies in time is kept at knots and interpolated.
"""

from __future__ import annotations

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


def catmull_rom(values: Tensor, position: float) -> Tensor:
    """`values` (K, ...) at `position` in [0, K - 1], by a cubic through them: (...).

    The cubic has continuous velocity (Catmull and Rom 1974). Both ends are extended in
    a straight line, so that linear motion is reproduced everywhere.
    """
    if len(values) == 1:
        return values[0]
    first_row, weights = catmull_rom_weights(len(values), position)
    return weighted_rows(values[first_row : first_row + len(weights)], weights)


def catmull_rom_weights(count: int, position: float) -> tuple[int, list[float]]:
    """The first of `count` rows that `catmull_rom` adds up, and their weights."""
    last = count - 1
    if last == 0:
        return 0, [1.0]
    low = min(max(int(position), 0), last - 1)
    u = position - low
    # weights of the rows low - 1, low, low + 1, low + 2
    before = 0.5 * u * (u * (2 - u) - 1)
    start = 1 + 0.5 * u * u * (3 * u - 5)
    end = 0.5 * u * (u * (4 - 3 * u) + 1)
    after = 0.5 * u * u * (u - 1)
    if low == 0:  # row -1 is 2 * row 0 - row 1
        start, end = start + 2 * before, end - before
        before = 0.0
    if low + 2 > last:  # row K is 2 * row K - 1 - row K - 2
        start, end = start - after, end + 2 * after
        after = 0.0
    first_row, end_row = max(low - 1, 0), min(low + 3, last + 1)
    weights = [before, start, end, after][first_row - low + 1 : end_row - low + 1]
    return first_row, weights


def weighted_rows(values: Tensor, weights: list[float]) -> Tensor:
    """The sum of the rows of `values` (K, ...) times `weights` (K): (...).

    One product and not a sum of rows, whose gradients would each fill all of `values`.
    """
    factors = constant(tuple(weights), values.device, values.dtype)
    return (factors @ values.flatten(1)).view(values.shape[1:])
