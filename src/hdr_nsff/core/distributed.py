"""Data parallelism under `torchrun`: every process holds the whole model and its share
of a step's batches; gradients are summed. With one process, nothing here does anything.

Gradients are summed after the backward pass and not by `DistributedDataParallel`'s
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

from hdr_nsff.core.errors import InputError


@dataclass(frozen=True)
class Ranks:
    """This process among the others."""

    rank: int = 0  # 0 to world - 1
    world: int = 1  # number of processes

    @property
    def main(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def sum_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Every parameter's gradient becomes the sum over all processes."""
        if self.world == 1:
            return
        for parameter in parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            dist.all_reduce(parameter.grad)

    def max_buffers(self, buffers: Iterable[Tensor]) -> None:
        """Every buffer becomes the maximum over all processes."""
        if self.world == 1:
            return
        for buffer in buffers:
            dist.all_reduce(buffer, dist.ReduceOp.MAX)

    def follow_first(self, tensors: Iterable[Tensor]) -> None:
        """Every tensor becomes that of the first process."""
        if self.world == 1:
            return
        for tensor in tensors:
            dist.broadcast(tensor.detach(), 0)

    def check_same(self, tensors: Iterable[Tensor]) -> None:
        """RuntimeError where processes hold different tensors, by their sums."""
        if self.world == 1:
            return
        lowest = torch.stack([tensor.detach().double().sum() for tensor in tensors])
        highest = lowest.clone()
        dist.all_reduce(lowest, dist.ReduceOp.MIN)
        dist.all_reduce(highest, dist.ReduceOp.MAX)
        if not torch.equal(lowest, highest):
            raise RuntimeError(
                f"the {self.world} processes have learned different parameters: "
                "train in one process, and report this"
            )

    def agree(self, seconds: float) -> float:
        """The first process's number, for all."""
        if self.world == 1:
            return seconds
        value = torch.tensor([seconds], dtype=torch.float64)
        dist.broadcast(value, 0)
        return float(value)


@contextmanager
def group(device: str = "auto") -> Iterator[Ranks]:
    """Join the other processes where `torchrun` started several, and leave in order at
    the end. Each takes a CUDA device of its own, unless `device` is the CPU; InputError
    where there are too few.
    """
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield Ranks()
        return
    if device != "cpu" and torch.cuda.is_available():
        own, count = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
        if own >= count:
            raise InputError(
                f"{count} CUDA devices are too few for process {own + 1} on this machine; "
                "start one process for each, or train with --device cpu"
            )
        torch.cuda.set_device(own)
        dist.init_process_group("cpu:gloo,cuda:nccl")
    else:
        dist.init_process_group("gloo")
    try:
        yield Ranks(dist.get_rank(), world)
        gc.collect()  # gloo may abort at exit where tensors outlive the group
        dist.barrier()
    finally:
        dist.destroy_process_group()
