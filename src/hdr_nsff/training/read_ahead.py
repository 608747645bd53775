"""Frames of the next step, read while this one runs.

Those of a long clip do not all stay in memory, and decoding one takes a good part of a
step.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from hdr_nsff.core.process import limit_torch_threads
from hdr_nsff.scene.scene import Frame


class ReadAhead:
    """Reads frames beside the caller, which then finds them in memory."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.frames = frames
        self.pool = ThreadPoolExecutor(1, initializer=limit_torch_threads, initargs=(1,))

    def __call__(self, index: int) -> None:
        """Begin to read a frame. What goes wrong is raised where it is used."""
        self.pool.submit(lambda: self.frames[index].image)
