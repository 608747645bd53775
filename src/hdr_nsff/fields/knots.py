"""Time as knots: a knot is a position on the sorted list of training times; what varies
in time lives on it and is interpolated.
"""

from __future__ import annotations

import torch
from torch import Tensor


def knot_of(times: Tensor, time: float) -> float:
    """Position of a time (in frames) on the sorted training times (T,), clamped to
    their range.
    """
    if len(times) == 1:
        return 0.0
    i = int(
        torch.searchsorted(times, torch.tensor(time, dtype=times.dtype, device=times.device)).clamp(
            1, len(times) - 1
        )
    )
    return float(i - 1 + ((time - times[i - 1]) / (times[i] - times[i - 1])).clamp(0, 1))


def linear(values: Tensor, position: float) -> Tensor:
    """`values` (K, ...) between two of them, at `position` in [0, K - 1]."""
    if len(values) == 1:
        return values[0]
    low = min(int(position), len(values) - 2)
    u = position - low
    return weighted(values[low : low + 2], [1 - u, u])


def catmull_rom(values: Tensor, position: float) -> Tensor:
    """`values` (K, ...) by the cubic through them with continuous velocity (Catmull &
    Rom 1974); ends are extended straight on.
    """
    last = len(values) - 1
    if last == 0:
        return values[0]
    low = min(max(int(position), 0), last - 1)
    u = position - low
    a, b, c, d = (
        0.5 * u * (u * (2 - u) - 1),
        1 + 0.5 * u * u * (3 * u - 5),
        0.5 * u * (u * (4 - 3 * u) + 1),
        0.5 * u * u * (u - 1),
    )
    if low == 0:
        a, b, c = 0.0, b + 2 * a, c - a
    if low + 2 > last:
        b, c, d = b - d, c + 2 * d, 0.0
    first, end = max(low - 1, 0), min(low + 3, last + 1)
    return weighted(values[first:end], [a, b, c, d][first - low + 1 : end - low + 1])


def weighted(values: Tensor, weights: list[float]) -> Tensor:
    """The sum of `values` (K, ...) times `weights` (K): one product, where gradients of
    single rows would each fill the whole of them.
    """
    return (values.new_tensor(weights) @ values.flatten(1)).view(values.shape[1:])
