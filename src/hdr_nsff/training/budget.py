"""How long a run trains, and how far it is."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated

from annotated_types import Ge, Gt, Le

from hdr_nsff.core.progress import seconds_left

# minutes of training where none are given (hand-chosen): of a clip of so many pixels in
# all frames, and at most
SMALL_CLIP_MINUTES, SMALL_CLIP_PIXELS = 5.0, 1_700_000
MAX_MINUTES = 30.0


@dataclass(frozen=True)
class Budget:
    """Steps or minutes: steps count where both are given; without either, the minutes
    follow the clip.
    """

    steps: Annotated[int, Ge(1), Le(10**12)] | None = None
    """Stop after this many steps. The same seed and steps give the same result, also
    through kills and restarts.
    """
    minutes: Annotated[float, Gt(0), Le(1e6)] | None = None
    """Without --steps: stop after this many minutes of training; learning rates and
    schedules follow the clock. Default: 5 for a small clip, more for more pixels and
    frames, at most 30.
    """

    def progress(self, step: int, seconds: float) -> float:
        """Share of the run that is done, 0 to 1, after `step` steps in `seconds`."""
        if self.steps is not None:
            return step / self.steps
        assert self.minutes is not None
        return min(seconds / (60 * self.minutes), 1.0)

    def for_clip(self, num_pixels: int, num_frames: int) -> Budget:
        """This budget, or where it is open, the minutes that follow the clip."""
        if self.steps is not None or self.minutes is not None:
            return self
        return replace(self, minutes=minutes_for(num_pixels, num_frames))


def minutes_for(num_pixels: int, num_frames: int) -> float:
    """The minutes that a clip of `num_frames` of `num_pixels` each is trained for.

    They grow with the root of all pixels, and hold where the user gives none.
    """
    share = num_pixels * num_frames / SMALL_CLIP_PIXELS
    return round(min(max(SMALL_CLIP_MINUTES * share**0.5, SMALL_CLIP_MINUTES), MAX_MINUTES), 1)


def longest_clip(num_pixels: int) -> int:
    """The frames of `num_pixels` each from which on the default time grows no more."""
    return int(SMALL_CLIP_PIXELS * (MAX_MINUTES / SMALL_CLIP_MINUTES) ** 2 / num_pixels)


@dataclass(frozen=True)
class Schedule:
    """How learning rates and terms change over a run."""

    period: Annotated[float, Ge(0), Le(1)] = 0.45
    """The schedules' period K as a share of the run; 0: the published K = 1000
    min(max(30, frames), 250) steps.
    """
    prior_fade: Annotated[float, Ge(0), Le(1)] = 1.0
    """Depth and flow weights are multiplied by this every period (published: 0.1)."""
    lr_final: Annotated[float, Ge(0), Le(1)] = 0.05
    """Learning rates fall exponentially to this share of their start over the run; 0:
    the published 0.1 per 300k steps.
    """


@dataclass(frozen=True)
class Clock:
    """How far a run is."""

    budget: Budget
    schedule: Schedule
    num_frames: int
    step: int = 0
    seconds: float = 0.0  # of training, without compiling and writing

    @property
    def progress(self) -> float:
        """Share of the run that is done, 0 to 1."""
        return self.budget.progress(self.step, self.seconds)

    @property
    def seconds_left(self) -> float | None:
        """Seconds of training that are left at the speed so far; None at the start."""
        return seconds_left(self.progress, 1.0, self.seconds) if self.seconds else None

    @property
    def phase(self) -> float:
        """Time in units of the schedules' period K."""
        if self.schedule.period:
            return self.progress / self.schedule.period
        return self.step / (1000 * min(max(30, self.num_frames), 250))

    @property
    def lr_share(self) -> float:
        """Learning rates relative to their start."""
        if self.schedule.lr_final:
            return self.schedule.lr_final**self.progress
        return 0.1 ** (self.step / 300_000)


class Stopwatch:
    """Seconds of training, without pauses and the first step, which compiles."""

    def __init__(self, seconds: float) -> None:
        self.before = seconds  # of training, in processes before this one
        self.started: float | None = None

    def read(self) -> float:
        """Seconds of training so far; the first reading starts the watch."""
        if self.started is None:
            self.started = time.monotonic()
            return self.before
        return self.before + time.monotonic() - self.started

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Time that is not counted, after the first reading."""
        assert self.started is not None
        paused = time.monotonic()
        yield
        self.started += time.monotonic() - paused
