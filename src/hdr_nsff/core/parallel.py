"""A function mapped over items by several threads, with a progress bar."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import cv2

from hdr_nsff.core.progress import track

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_threads(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    report: str | None,
    threads: int = 2,
) -> list[Result]:
    """`work` of every item, in order, on a few threads. `report` names the progress
    bar; None shows none.

    OpenCV's own threads are off meanwhile: its results depend on their number.
    """
    opencv_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(threads)
    try:
        results = pool.map(work, items)
        if report is None:
            return list(results)
        return list(track(results, report, total=len(items)))
    finally:
        # After Ctrl-C, items that have begun are finished, and the others are dropped.
        pool.shutdown(cancel_futures=True)
        cv2.setNumThreads(opencv_threads)
