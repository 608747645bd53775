"""Time as knots: a knot is a position on the sorted list of training times; what varies in time lives on it and is interpolated."""

from __future__ import annotations

import torch
from torch import Tensor


def knot_of(times: Tensor, time: float) -> float:
    """Position of a time (in frames) on the sorted training times (T,), clamped to their range."""
    if len(times) == 1:
        return 0.0
    i = int(torch.searchsorted(times, torch.tensor(time, dtype=times.dtype, device=times.device)).clamp(1, len(times) - 1))
    return float(i - 1 + ((time - times[i - 1]) / (times[i] - times[i - 1])).clamp(0, 1))


def linear(values: Tensor, position: float) -> Tensor:
    """`values` (K, ...) between two of them, at `position` in [0, K - 1]."""
    if len(values) == 1:
        return values[0]
    low = min(int(position), len(values) - 2)
    return torch.lerp(values[low], values[low + 1], position - low)


def catmull_rom(values: Tensor, position: float) -> Tensor:
    """`values` (K, ...) by the cubic through them with continuous velocity (Catmull & Rom 1974); ends are extended straight on."""
    last = len(values) - 1
    if last == 0:
        return values[0]
    low = min(max(int(position), 0), last - 1)
    u = position - low
    b, c = values[low], values[low + 1]
    if u == 0:
        return b
    a = values[low - 1] if low > 0 else 2 * b - c
    d = values[low + 2] if low + 2 <= last else 2 * c - b
    return b + 0.5 * u * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * (b - c) + d - a)))
