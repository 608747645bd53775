"""A function mapped over the tensors of a frozen dataclass, so that moving or slicing
one is a single call; devices by name.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say

T = TypeVar("T")

CPU = torch.device("cpu")


def tree_map(function: Callable[[Tensor], Tensor], value: T) -> T:
    """`value` with `function` applied to every tensor in it. Dataclasses, dicts, lists
    and tuples are entered; anything else stays as it is.
    """

    def walk(node: Any) -> Any:
        if isinstance(node, Tensor):
            return function(node)
        if dataclasses.is_dataclass(node) and not isinstance(node, type):
            names = [f.name for f in dataclasses.fields(node)]
            return dataclasses.replace(node, **{name: walk(getattr(node, name)) for name in names})
        if isinstance(node, dict):
            return {key: walk(child) for key, child in node.items()}
        if isinstance(node, list | tuple):
            return type(node)(walk(child) for child in node)
        return node

    return walk(value)


def to_device(value: T, device: torch.device | str) -> T:
    """`value` with every tensor on `device`."""
    return tree_map(lambda t: t.to(device), value)


@lru_cache(maxsize=4096)
def constant(numbers: tuple[float, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    """A vector of these numbers on a device, copied there once: not to be changed.

    A copy from the host makes it wait for the device.
    """
    with torch.inference_mode(False):
        return torch.tensor(numbers, dtype=dtype, device=device)


@cache
def table_on(table: Tensor, device: torch.device, dtype: torch.dtype) -> Tensor:
    """A constant `table` on a device, copied there once: not to be changed."""
    with torch.inference_mode(False):
        return table.to(device, dtype)


def by_channel(values: Tensor) -> np.ndarray:
    """Values (N, C) or (N,) of the CPU as an array that lies in memory channel by
    channel; copied where they do not.
    """
    if values.ndim == 1:
        return values.detach().contiguous().numpy()
    return values.detach().T.contiguous().numpy().T


def computes_bf16_fast(device: torch.device) -> bool:
    """Whether a device has units for bfloat16: GPUs since Ampere, some CPUs.

    Without them, it takes many times as long as float32.
    """
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    return device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()


def layers_in_bf16(like: Tensor, enabled: bool) -> torch.autocast:
    """A context for network layers alone, on the device of `like`: in bfloat16 where
    that is `enabled`. Geometry stays outside: bfloat16 would move rays by a pixel.
    """
    return torch.autocast(like.device.type, torch.bfloat16, enabled=enabled)


def generator_for(device: torch.device, seed: int) -> torch.Generator:
    """A generator that draws for `device`: on CUDA there, elsewhere on the CPU.

    What is drawn on the CPU must be copied, and the host waits for every copy. The same
    seed draws the same numbers again, but others than on another kind of device.
    """
    return torch.Generator(device if device.type == "cuda" else CPU).manual_seed(seed)


@cache
def cuda_fault(name: str) -> str | None:
    """Why torch computes nothing on a CUDA device that it sees, such as one too old for
    this torch; None where it does.
    """
    try:
        torch.ones(2, device=name).sum().item()
    except RuntimeError as error:
        return f"{str(error).strip().partition(chr(10))[0]:.120}"
    return None


@cache
def say_once(message: str) -> None:
    """Print a line, the first time that it is to be said."""
    say(message)


def pick_device(name: str) -> torch.device:
    """The device of a `--device` flag: auto, cpu, cuda or cuda:N. InputError for any
    other name, and for a CUDA device that is not there or computes nothing; auto then
    says why it takes the CPU.
    """
    if name == "auto":
        if not torch.cuda.is_available():
            return CPU
        reason = cuda_fault("cuda")
        if reason is None:
            return torch.device("cuda")
        say_once(f"--device auto: using the CPU although there is a CUDA device: {reason}")
        return CPU
    if name == "cpu":
        return CPU
    match = re.fullmatch(r"cuda(?::(\d{1,3}))?", name, re.ASCII)
    if match is None:
        raise InputError(f"--device {name:.40}: no such device; choose auto, cpu, cuda or cuda:N")
    if not torch.cuda.is_available():
        raise InputError(
            f"--device {name}: this torch sees no CUDA device; leave the flag out to use the CPU"
        )
    count = torch.cuda.device_count()
    if match[1] is not None and int(match[1]) >= count:
        raise InputError(
            f"--device {name}: no such CUDA device; there are {count}, counted from cuda:0"
        )
    reason = cuda_fault(name)
    if reason is not None:
        raise InputError(f"--device {name}: torch computes nothing there ({reason}); take the CPU")
    return torch.device(name)
