"""Data parallelism under `torchrun`: every process holds the whole model and its share
of a step's batches; gradients are summed.

Nothing here when there is one process. Sums instead of `DistributedDataParallel`'s
hooks, because the grids add to their gradients in place.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Ranks:
    """This process among the others."""

    rank: int = 0
    world: int = 1

    @property
    def main(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def sum_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Every parameter's gradient becomes the sum over all processes."""
        if self.world == 1:
            return
        for p in parameters:
            if p.grad is None:
                p.grad = torch.zeros_like(p)
            dist.all_reduce(p.grad)

    def max_buffers(self, buffers: Iterable[Tensor]) -> None:
        """Every buffer becomes the maximum over all processes."""
        if self.world > 1:
            for b in buffers:
                dist.all_reduce(b, dist.ReduceOp.MAX)

    def agree(self, seconds: float) -> float:
        """The first process's number, for all."""
        if self.world == 1:
            return seconds
        value = torch.tensor([seconds], dtype=torch.float64)
        dist.broadcast(value, 0)
        return float(value)


@contextmanager
def group() -> Iterator[Ranks]:
    """Join the other processes where `torchrun` started several; leave in order at the
    end.
    """
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield Ranks()
        return
    dist.init_process_group("gloo" if not torch.cuda.is_available() else "cpu:gloo,cuda:nccl")
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    try:
        yield Ranks(dist.get_rank(), world)
        gc.collect()  # gloo may abort at exit where tensors outlive the group
        dist.barrier()
    finally:
        dist.destroy_process_group()
