"""Progress bars with the time left, from the first item on, for anything that takes
more than two seconds; plain lines where no terminal shows them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from datetime import timedelta
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

LINE_SECONDS = 10.0  # between two lines where there is no terminal
SHORT_SECONDS = 2.0  # what takes no longer needs no line
MINUTES_FROM = 300.0  # seconds from which on the time left is said in minutes

T = TypeVar("T")
console = Console(stderr=True, highlight=False)


def bar() -> Progress:
    """A progress display: `with bar() as p: task = p.add_task("poses", total=3);
    p.advance(task)`.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeLeftColumn(),
        TextColumn("{task.fields[note]}"),
    )
    return Progress(*columns, console=console, transient=False, disable=not console.is_terminal)


def track(items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Yield `items`, with a bar on a terminal; elsewhere with a line after the first
    item, where all of them take long, and every ten seconds.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    start = time.monotonic()
    last_line = 0.0
    with bar() as progress:
        task = progress.add_task(description, total=total, note="")
        for done, item in enumerate(items, 1):
            yield item
            progress.advance(task)
            seconds = time.monotonic() - start
            is_long = done == 1 and (seconds_left(1, total, seconds) or 0.0) > SHORT_SECONDS
            if progress.disable and (is_long or seconds - last_line > LINE_SECONDS):
                last_line = seconds
                line = f"{description}: {done}{progress_of(done, total, seconds)}"
                print(line, file=sys.stderr, flush=True)


class TimeLeftColumn(ProgressColumn):
    """The time left of a task: what its field `left` says in seconds, else by the time
    that its items have taken.
    """

    def __init__(self) -> None:
        super().__init__()
        # per task: items that are done, and the seconds until the last of them was
        self.reached: dict[TaskID, tuple[float, float]] = {}

    def render(self, task: Task) -> Text:
        """The time as hours, minutes and seconds; dashes before the first item."""
        left = task.fields.get("left")
        if left is None:
            left = self.estimate(task)
        return Text("-:--:--" if left is None else str(timedelta(seconds=round(left))))

    def estimate(self, task: Task) -> float | None:
        """Seconds left, which fall until the next item is done."""
        elapsed = task.finished_time if task.finished_time is not None else task.elapsed or 0.0
        done, then = self.reached.get(task.id, (0.0, 0.0))
        if task.completed != done:
            done, then = task.completed, elapsed
            self.reached[task.id] = done, then
        left = seconds_left(done, task.total, then)
        return None if left is None else max(left - (elapsed - then), 0.0)


def seconds_left(done: float, total: float | None, seconds: float) -> float | None:
    """What is left of `total` items if each takes as long as those `done` in `seconds`;
    None where that is unknown. Mapping may take an image twice, and then more than its
    total.
    """
    if not total or not 0 < done <= total:
        return None
    return seconds / done * (total - done)


def progress_of(done: int, total: int | None, seconds: float) -> str:
    """The rest of a progress line: the total and the time left, where known."""
    left = seconds_left(done, total, seconds)
    return "" if left is None else f" of {total}, {time_left(left)}"


def time_left(seconds: float) -> str:
    """A time left, in words."""
    if seconds < MINUTES_FROM:
        return f"{seconds:.0f} s left"
    return f"{seconds / 60:.0f} min left"


def say(message: str) -> None:
    """Print one line for the person at the terminal."""
    console.print(message, markup=False, soft_wrap=True)
