"""Progress bars with time left, for anything that takes more than two seconds; plain
lines where no one watches a terminal.
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
    """`items`, with a bar on a terminal or a line every ten seconds elsewhere."""
    total = len(items) if total is None and isinstance(items, Sized) else total
    start = last = time.monotonic()
    with bar() as progress:
        task = progress.add_task(description, total=total, note="")
        for done, item in enumerate(items):
            yield item
            progress.advance(task)
            now = time.monotonic()
            if progress.disable and now - last > 10:
                last = now
                left = (
                    f", {(now - start) / (done + 1) * (total - done - 1):.0f} s left"
                    if total
                    else ""
                )
                print(
                    f"{description}: {done + 1}{f' of {total}' if total else ''}{left}",
                    file=sys.stderr,
                    flush=True,
                )


def say(message: str) -> None:
    """One line for the person at the terminal."""
    console.print(message, markup=False, soft_wrap=True)
