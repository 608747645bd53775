"""Which frames of a clip are held out of training."""

from __future__ import annotations

import math
from collections.abc import Sequence

HOLD_OUT = 8  # every this many frames are held out where nothing else is asked for


def hold_out_every(count: int, every: int, cycle: int, removed: bool = False) -> list[int]:
    """Which of `count` frames are held out of training: every `every`-th.

    Never the first or the last; none for 0. `every` grows until all exposures of the
    cycle are held out in turn: until it has no common factor with the length of the
    cycle. Where these frames are `removed` and the cycle runs over the others, until
    the number of frames between two of them has none.
    """
    if every <= 0:
        return []
    while math.gcd(every - removed, cycle) > 1:
        every += 1
    return list(range(every // 2, count - 1, every))


def widest_hold_out(count: int, cycle: int) -> int | None:
    """The largest `every` up to HOLD_OUT that holds out any of `count` frames."""
    fitting = (n for n in range(HOLD_OUT, 1, -1) if hold_out_every(count, n, cycle))
    return next(fitting, None)


def hold_out_spacing(frames: Sequence[int]) -> int | None:
    """The smallest `every` for which `hold_out_every` gives just these `frames`.

    The clip ends soon after them. None where there is no such number.
    """
    for every in range(2, 2 * frames[0] + 2):
        if hold_out_every(frames[-1] + 2, every, 1) == list(frames):
            return every
    return None


def frames_between(count: int, cycle: int) -> list[int]:
    """Which of `count` frames the protocol novel-view-time holds out of training.

    Every second one, never the first or the last. With an even exposure cycle every
    second frame would always show the same exposures: there, each cycle begins with the
    other half, so that of a cycle of 2 the frames 0, 3, 4, 7, 8, ... are trained on.
    """
    inner = range(1, count - 1)
    if cycle % 2:
        return [k for k in inner if k % 2]
    return [k for k in inner if (k + k // cycle) % 2]
