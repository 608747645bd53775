"""Threads of simulated CUDA blocks that take turns: each runs alone up to its next
barrier. Beyond it they go on in the opposite order, so where a barrier is missing, one
reads what another has yet to write. numba-cuda's own all run at once, and are polled.

A thread of the CPU goes on with the next thread of the block after one that ended. So a
kernel without barriers needs one for a whole block, in place of one for each thread.
"""

import os
import sys
import threading
from collections import deque
from typing import Any

import numpy as np
from numba.cuda.simulator import kernel, kernelapi
from numba.cuda.simulator.kernel import BlockManager, BlockThread
from numba.cuda.simulator.kernelapi import Dim3, FakeCUDAShared
from numba.np.numpy_support import as_dtype


class Turns(BlockManager):
    """A block whose threads run one after another."""

    def run(self, grid_point: tuple[int, ...], *args: Any) -> None:
        self.grid_point, self.args = grid_point, args
        self.points = deque(np.ndindex(*self._block_dim))  # of threads still to be begun
        self.ready: list[Lane] = []  # may go on, the last one first
        self.arrived: list[Lane] = []  # wait at the barrier
        self.failure: Exception | None = None
        self.ended = locked()
        self.pass_on()
        self.ended.acquire()
        if self.failure:
            raise self.failure

    def pass_on(self) -> None:
        """Give the turn to the next thread; past the barrier where all have arrived."""
        if not self.ready and not self.points:
            self.ready, self.arrived = self.arrived, self.ready
        if self.points:
            Lane(self).start()
        elif self.ready:
            self.ready.pop().turn.release()
        else:
            self.ended.release()


class Lane(BlockThread):
    """A thread of the CPU that runs threads of a block."""

    def __init__(self, block: Turns) -> None:
        super().__init__(None, block, block.grid_point, block.points[0], False)
        self.block, self.turn = block, locked()

    def run(self) -> None:
        block = self.block
        while block.points:
            self.threadIdx = Dim3(*block.points.popleft())
            x, y, z = self.threadIdx
            self.thread_id = x + block._block_dim[0] * (y + block._block_dim[1] * z)
            try:
                block._f(*block.args)
            except Exception as error:
                error.add_note(f"in thread {self.threadIdx} of block {self.blockIdx}")
                block.failure = block.failure or error
                block.points.clear()
        block.pass_on()

    def syncthreads(self) -> None:
        self.block.arrived.append(self)
        self.block.pass_on()
        self.turn.acquire()
        if self.block.failure:
            raise RuntimeError("another thread of the block failed")


class Shared(FakeCUDAShared):
    """Shared arrays, known by the instruction that makes each.

    numba-cuda reads the source lines of the whole stack for that.
    """

    def array(self, shape: Any, dtype: Any, alignment: None = None) -> np.ndarray:
        caller = sys._getframe(1)
        place = caller.f_code, caller.f_lasti
        if place not in self._allocations:
            self._allocations[place] = np.empty(shape, as_dtype(dtype))
        return self._allocations[place]


def locked() -> threading.Lock:
    """A lock that waits for its release."""
    lock = threading.Lock()
    lock.acquire()
    return lock


def take_turns() -> None:
    """Let the simulator run blocks so from now on, on one core where the system allows:
    to wake a thread on another one takes longer than what most of them do.
    """
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[os.getpid() % len(cores)]})
    kernel.BlockManager = Turns
    kernelapi.FakeCUDAShared = Shared
