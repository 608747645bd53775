"""Progress bars with the time left, for anything that takes more than two seconds;
plain lines where no terminal shows them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

LINE_SECONDS = 10.0  # between two lines where there is no terminal

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
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    return Progress(*columns, console=console, transient=False, disable=not console.is_terminal)


def track(items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Yield `items`, with a bar on a terminal or a line every ten seconds elsewhere."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    start = time.monotonic()
    last_line = start
    with bar() as progress:
        task = progress.add_task(description, total=total, note="")
        for done, item in enumerate(items, 1):
            yield item
            progress.advance(task)
            now = time.monotonic()
            if progress.disable and now - last_line > LINE_SECONDS:
                last_line = now
                line = f"{description}: {done}{progress_of(done, total, now - start)}"
                print(line, file=sys.stderr, flush=True)


def progress_of(done: int, total: int | None, seconds: float) -> str:
    """The rest of a progress line: the total and the time left, where known. Mapping
    may take an image twice, and then more than its total.
    """
    if not total or done > total:
        return ""
    seconds_left = seconds / done * (total - done)
    return f" of {total}, {seconds_left:.0f} s left"


def say(message: str) -> None:
    """Print one line for the person at the terminal."""
    console.print(message, markup=False, soft_wrap=True)
