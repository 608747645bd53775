"""Map a function over the tensors of a frozen dataclass, so that moving or slicing one
is a single call.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError

T = TypeVar("T")


def tree_map(function: Callable[[Tensor], Tensor], value: T) -> T:
    """`value` with `function` applied to every tensor in it: dataclasses, dicts, lists
    and tuples are entered.
    """

    def walk(v: Any) -> Any:
        if isinstance(v, Tensor):
            return function(v)
        if dataclasses.is_dataclass(v) and not isinstance(v, type):
            return dataclasses.replace(
                v, **{f.name: walk(getattr(v, f.name)) for f in dataclasses.fields(v)}
            )
        if isinstance(v, dict):
            return {k: walk(x) for k, x in v.items()}
        if isinstance(v, (list, tuple)):
            return type(v)(walk(x) for x in v)
        return v

    return walk(value)


def to_device(value: T, device: torch.device | str) -> T:
    """`value` with every tensor on `device`."""
    return tree_map(lambda t: t.to(device), value)


def hold_threads(count: int) -> None:
    """Let torch use `count` threads (0: as it is). Before every step or frame: numba's
    kernels set the count of the OpenMP library that both share.
    """
    if count:
        torch.set_num_threads(count)


def pick_device(name: str) -> torch.device:
    """The device of a `--device` flag; InputError where CUDA is asked for and missing."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(
            "--device cuda: this torch sees no CUDA device; leave the flag out to use the CPU"
        )
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise InputError(f"--device {name}: no such device; choose auto, cpu or cuda") from error
