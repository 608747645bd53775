"""A pretend accelerator: its tensors are CPU tensors in a wrapper that claims another
device. Operations refuse to mix the two, as CUDA does.

    with pretend_device() as device:
        x = torch.ones(3, device=device)
        x + torch.ones(3)  # RuntimeError

Allowed, as on CUDA: CPU scalars of no dimension, CPU tensors as indices, and copies.

`counted()` counts what costs time on a GPU: kernels that are launched, one for every
operation that is no view, and operations for which the host waits.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.backend_registration import (
    _DummyBackendModule,
    _setup_privateuseone_for_python_backend,
)

NAME = "pretend"
aten = torch.ops.aten
COPIES = {aten._to_copy.default, aten.copy_.default, aten._copy_from.default}
INDEXED = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default}
INDEXED |= {aten._index_put_impl_.default, aten._unsafe_index.Tensor}
# what torch calls where no mode sees it, to copy the numbers of Python lists
UNSEEN = [aten.empty_strided.default, aten.empty.memory_format, aten._copy_from.default]


# operations whose result has a size, or is a number, that only the device knows
WAITS = {aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default}
WAITS |= {aten._unique2.default, aten.repeat_interleave.Tensor, aten.equal.default}
# operations that only take memory
FREE = {aten.empty.memory_format, aten.empty_strided.default, aten.empty_like.default}
FREE |= {aten.new_empty.default, aten.new_empty_strided.default, aten.detach.default}
FREE |= {aten.set_.source_Tensor, aten.alias.default, aten.lift_fresh.default}


@dataclass
class Counts:
    """What was counted, by the names of operations."""

    launches: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)


COUNTING: list[Counts] = []


@contextmanager
def counted() -> Iterator[Counts]:
    """Counts for as long as the context lasts."""
    counts = Counts()
    COUNTING.append(counts)
    try:
        yield counts
    finally:
        COUNTING.remove(counts)


def count(func: Any, args: tuple[Any, ...], there: bool, on_device: bool) -> None:
    """Count an operation on the device, or a copy to it or from it."""
    crosses = func in COPIES and there != on_device
    if func in (aten.copy_.default, aten._copy_from.default):
        crosses = len({isinstance(x, PretendTensor) for x in args[:2]}) == 2
    is_mask = func in INDEXED and any(
        x is not None and x.dtype in (torch.bool, torch.uint8) for x in args[1]
    )
    for counts in COUNTING:
        if crosses or is_mask or func in WAITS:
            counts.waits[str(func)] += 1
        if (there or on_device) and not func.is_view and func not in FREE:
            counts.launches[str(func)] += 1


class PretendTensor(Tensor):
    """A tensor on the pretend device; `inner` holds its numbers."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> PretendTensor:
        made = Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=torch.device(NAME, 0),
        )
        made.inner = inner
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    def __repr__(self) -> str:  # type: ignore[override]
        return f"PretendTensor({self.inner})"

    def __format__(self, format_spec: str) -> str:
        return format(self.inner, format_spec)

    def tolist(self) -> Any:
        """Numbers on the host; torch has none for subclasses."""
        for counts in COUNTING:
            counts.waits["tolist"] += 1
        return self.inner.tolist()

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        return execute(func, args, kwargs or {})


class PretendMode(TorchDispatchMode):
    """Sees every operation, those that make tensors from nothing included."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        if torch.is_inference_mode_enabled():  # which takes no operation apart by itself
            with self:
                result = func.decompose(*args, **(kwargs or {}))
            if result is not NotImplemented:
                return result
        return execute(func, args, kwargs or {})


def execute(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Run an operation on the numbers, once its devices agree."""
    tensors = tensors_in((*args, *kwargs.values()))
    there = any(isinstance(x, PretendTensor) for x in tensors)
    wanted = kwargs.get("device")
    if there:
        check_devices(func, args, tensors)
    on_device = there if wanted is None else torch.device(wanted).type == NAME
    if func is aten.copy_.default:
        on_device = isinstance(args[0], PretendTensor)
    if COUNTING and (there or on_device):
        count(func, args, there, on_device)
    if func is aten._copy_from.default:
        args[1].inner.copy_(unwrap(args[0]))
        return args[1]
    generator = kwargs.get("generator")
    if on_device and generator is not None and generator.device.type != NAME:
        raise RuntimeError(f"{func}: a generator of the {generator.device} for a tensor elsewhere")
    if wanted is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    if kwargs.get("pin_memory"):
        kwargs = kwargs | {"pin_memory": False}
    inner_args = [convert(x, unwrap) for x in args]
    inner_kwargs = {name: convert(x, unwrap) for name, x in kwargs.items()}
    with torch.inference_mode(False), torch.no_grad():
        result = func(*inner_args, **inner_kwargs)
        return convert(result, lambda x: rewrap(x, tensors)) if on_device else result


def tensors_in(values: Iterable[Any]) -> list[Tensor]:
    """The tensors among arguments, those in lists included."""
    found: list[Tensor] = []
    for x in values:
        if isinstance(x, Tensor):
            found.append(x)
        elif isinstance(x, list | tuple):
            found += tensors_in(x)
    return found


def convert(x: Any, function: Callable[[Tensor], Any]) -> Any:
    """A value with what a function makes of its tensors, those in lists included."""
    if isinstance(x, Tensor):
        return function(x)
    if isinstance(x, list | tuple):
        return [convert(part, function) for part in x]
    return x


def check_devices(func: Any, args: tuple[Any, ...], tensors: list[Tensor]) -> None:
    """RuntimeError where tensors of both devices meet in an operation."""
    if func in COPIES:
        return
    if func in INDEXED:
        tensors = [args[0], *args[2:3]]
    for x in tensors:
        if isinstance(x, Tensor) and not isinstance(x, PretendTensor) and x.ndim > 0:
            shapes = [tuple(t.shape) for t in tensors]
            raise RuntimeError(f"{func}: tensors on the CPU and on {NAME} meet: {shapes}")


def unwrap(x: Any) -> Any:
    return x.inner if isinstance(x, PretendTensor) else x


def rewrap(x: Tensor, given_tensors: list[Tensor]) -> Tensor:
    """A result on the device; the argument itself where an operation was in place."""
    for given in given_tensors:
        if isinstance(given, PretendTensor) and given.inner is x:
            return given
    return PretendTensor(x)


class Backend(_DummyBackendModule):
    """What torch asks of a device's module."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


def register() -> torch.library.Library:
    """Make torch know the device, before its first gradient. Operations that no mode
    sees, as where torch copies numbers of Python lists, come to the same place.
    """
    _setup_privateuseone_for_python_backend(NAME, Backend())
    library = torch.library.Library("aten", "IMPL")
    for func in UNSEEN:
        library.impl(func, partial(call, func), "PrivateUse1")
    return library


def call(func: Any, *args: Any, **kwargs: Any) -> Any:
    """`execute` of a call as it was written."""
    return execute(func, args, kwargs)


LIBRARY = register()


@contextmanager
def pretend_device() -> Iterator[torch.device]:
    """The device, for as long as the context lasts."""
    swaps = torch.__future__.get_swap_module_params_on_conversion()
    # modules keep their parameters when they are moved, as they do on CUDA
    torch.__future__.set_swap_module_params_on_conversion(True)
    try:
        with PretendMode():
            yield torch.device(NAME, 0)
    finally:
        torch.__future__.set_swap_module_params_on_conversion(swaps)
