"""Compilation of the numeric kernels by numba, with a cache on disk where one can be
written.

numba keeps compiled code in `__pycache__` beside the source, in the user's cache folder
or in NUMBA_CACHE_DIR. Where none of them is writable (a read-only installation without
a home, as in many containers) numba refuses to compile at all. The decorator here then
compiles without a cache, which costs about a minute at every start.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import event

from hdr_nsff.core.progress import say

LONG_SECONDS = 2.0  # of compiling, from which on it is reported


class CompilationReport(event.Listener):
    """Reports once that kernels are being compiled, where that takes long: a first run
    seems to stand still meanwhile.
    """

    def __init__(self) -> None:
        self.depth = 0  # of kernels within kernels
        self.begun = 0.0
        self.seconds = 0.0
        self.is_said = multiprocessing.parent_process() is not None

    def on_start(self, event: event.Event) -> None:
        """Start the clock with the outermost kernel."""
        if self.depth == 0:
            self.begun = time.monotonic()
        self.depth += 1

    def on_end(self, event: event.Event) -> None:
        """Say it where compiling has taken long."""
        self.depth -= 1
        seconds = self.seconds + time.monotonic() - self.begun
        if self.depth == 0:
            self.seconds = seconds
        if seconds > LONG_SECONDS and not self.is_said:
            self.is_said = True
            say("compiling kernels, once per installation; this takes a minute or two")


REPORT = CompilationReport()
event.register("numba:compile", REPORT)


def jit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: compile a function by `numba.njit` with these options, such as
    `parallel`, `nogil`, `fastmath`, and keep the machine code on disk.

    Functions with `inline="always"` become part of their callers and are not cached.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        if options.get("inline") == "always":
            return numba.njit(**options)(function)
        try:
            return watching_folder(numba.njit(cache=True, **options)(function), function)
        except RuntimeError as error:
            if "cannot cache function" not in str(error):
                raise
            report_missing_cache()
            return numba.njit(**options)(function)

    return decorate


def watching_folder(compiled: Any, function: Callable[..., Any]) -> Any:
    """The `compiled` function, compiled anew once any source in its folder has changed.

    numba looks at the function's own file only, but machine code holds the functions
    that it calls, too.
    """
    index = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if index is not None:  # a numba that keeps it so; none where it compiles nothing
        index._source_stamp = stamp_of(Path(function.__code__.co_filename).parent)
    return compiled


@cache
def stamp_of(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, times and sizes of the Python sources in a folder."""
    found = [(path.name, path.stat()) for path in sorted(folder.glob("*.py"))]
    return tuple((name, stat.st_mtime_ns, stat.st_size) for name, stat in found)


@cache
def report_missing_cache() -> None:
    """Say once that kernels are compiled at every start, and how to change that."""
    REPORT.is_said = True
    say(
        "compiling without a cache (no writable folder for numba's); "
        "set NUMBA_CACHE_DIR to a writable folder"
    )


def cache_is_writable() -> bool:
    """Whether numba finds a folder for the machine code of this package's kernels."""

    def kernel() -> int:
        return 0

    try:
        numba.njit(cache=True)(kernel)  # looks for the folder, compiles nothing
    except RuntimeError:
        return False
    return True
