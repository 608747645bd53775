"""Map a function over the tensors of a frozen dataclass, so that moving or slicing one
is a single call.
"""

from __future__ import annotations

import dataclasses
import re
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


def pick_device(name: str) -> torch.device:
    """The device of a `--device` flag: auto, cpu, cuda or cuda:N. InputError for any
    other name, and for a CUDA device that is not there.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cpu":
        return torch.device("cpu")
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
    return torch.device(name)
