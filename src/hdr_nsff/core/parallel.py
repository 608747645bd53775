"""A function mapped over items by several threads, with a progress bar."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import cv2

from hdr_nsff.core.progress import track


def in_threads(work: Callable, items: list, report: str | None, threads: int = 2) -> list:
    """`work` of every item, in order, on a few threads with OpenCV's own threads off
    (its results depend on their number).
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(threads)
    try:
        results = pool.map(work, items)
        return list(results if report is None else track(results, report, total=len(items)))
    finally:
        pool.shutdown(
            cancel_futures=True
        )  # Ctrl-C waits for what is under way, not for what is to come
        cv2.setNumThreads(before)
