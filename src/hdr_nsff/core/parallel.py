"""A function mapped over items by several threads, with a progress bar."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import cv2

from hdr_nsff.core.process import usable_cores
from hdr_nsff.core.progress import track

Item = TypeVar("Item")
Result = TypeVar("Result")
MAX_THREADS = 8  # each holds the memory of one item


def map_in_threads(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    report: str | None,
    threads: int | None = None,
) -> list[Result]:
    """`work` of every item, in order, on as many `threads` as there are cores, at most
    `MAX_THREADS`. `report` names the progress bar; None shows none.

    OpenCV's own threads are off meanwhile: its results depend on their number.
    """
    opencv_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(threads or min(usable_cores(), MAX_THREADS))
    try:
        results = pool.map(work, items)
        if report is None:
            return list(results)
        return list(track(results, report, total=len(items)))
    finally:
        # After Ctrl-C, items that have begun are finished, and the others are dropped.
        pool.shutdown(cancel_futures=True)
        cv2.setNumThreads(opencv_threads)
