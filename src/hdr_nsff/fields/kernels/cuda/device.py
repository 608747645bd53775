"""Functions that CUDA kernels call: those that numba compiles for the CPU, and parts of
the kernels themselves.

Nothing imports this module unless kernels are compiled.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from types import FunctionType, ModuleType
from typing import Any

from numba import cuda
from numba.core import config
from numba.core.dispatcher import Dispatcher


@cache
def device_functions(
    module: ModuleType, fastmath: bool, arrays: bool = False
) -> dict[str, Callable[..., Any]]:
    """The functions of a module that numba compiles for the CPU, as device functions.

    With `fastmath`, the compiler assumes that no number is NaN. The simulator calls the
    CPU's compiled functions or, where they take its `arrays`, Python.
    """
    compiled: dict[str, Any] = {k: v for k, v in vars(module).items() if isinstance(v, Dispatcher)}
    if config.ENABLE_CUDASIM and not arrays:
        return compiled
    names = dict(vars(module))
    for name, function in compiled.items():
        home = sys.modules[function.py_func.__module__]
        if home is not module:
            names[name] = device_functions(home, fastmath, arrays)[function.__name__]
            continue
        again = FunctionType(function.py_func.__code__, names, name)
        if not config.ENABLE_CUDASIM:
            again = cuda.jit(device=True, fastmath=fastmath)(again)
        names[name] = again
    return {name: names[name] for name in compiled}


def device(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator: a part of the kernels `forward` and `backward`, in which no number is
    NaN. In the simulator, it stays a Python function.
    """
    if config.ENABLE_CUDASIM:
        return function
    return cuda.jit(device=True, fastmath=True)(function)


def exact_device(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator: a part of kernels that meet numbers which are not finite."""
    if config.ENABLE_CUDASIM:
        return function
    return cuda.jit(device=True)(function)
