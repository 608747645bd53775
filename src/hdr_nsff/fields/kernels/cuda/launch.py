"""Launches the CUDA kernels on torch's tensors, where they lie and on torch's current
stream, by the driver's own interface.

A launch packs its arguments into one buffer of eight-byte numbers, as numba-cuda's
kernels take them: an array is (0, 0, number of items, bytes of an item, address, shape,
strides). That takes a few microseconds, where numba-cuda's launcher takes about ten for
every array. Tensors on the CPU are for tests: with NUMBA_ENABLE_CUDASIM=1 a simulator
of CUDA runs the kernels on them, in Python.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Sequence
from functools import cache
from threading import Lock
from typing import Any

import torch
from torch import Tensor

from hdr_nsff.fields.kernels.cuda.compile import SIGNATURES, kernel_function, load_kernel
from hdr_nsff.fields.kernels.cuda.layout import MAX_BLOCKS, THREADS

# the driver's keys of a launch's extra values (CU_LAUNCH_PARAM_...)
BUFFER_END, BUFFER_POINTER, BUFFER_SIZE = 0, 1, 2
# the types in `compile.SIGNATURES`
DTYPES = {"f": torch.float32, "d": torch.float64, "s": torch.int32, "i": torch.int64}
DTYPES["b"] = torch.uint8


def launch(name: str, grid: tuple[int, int], threads: int, *arguments: Tensor | float) -> None:
    """Run a kernel in `grid` blocks of `threads`, all tensors on one device.

    Tensors are contiguous, and of the types in `compile.SIGNATURES`.
    """
    if 0 in grid:
        return
    device = check_arguments(name, arguments)
    if device.type == "cpu":
        simulate(name, grid, threads, *arguments)
        return
    with torch.cuda.device(device):
        index = torch.cuda.current_device()
        stream = torch.cuda.current_stream().cuda_stream
        function = loaded_kernel(name, index)
        driver().launch(index, function, grid, threads, stream, pack(*arguments))


def check_arguments(name: str, arguments: Sequence[Tensor | float]) -> torch.device:
    """The device on which all tensors among a kernel's arguments are.

    TypeError where one is elsewhere, or an argument is not what the kernel takes: it
    would read and write anywhere.
    """
    device = next(a.device for a in arguments if isinstance(a, Tensor))
    for i, (a, (dtype, ndim)) in enumerate(zip(arguments, kinds_of(name), strict=True)):
        if isinstance(a, Tensor):
            fits = a.dtype == dtype and a.ndim == ndim and a.device == device
        else:
            fits = ndim == 0 and isinstance(a, float) == dtype.is_floating_point
        if not fits:
            found = f"{a.dtype} {tuple(a.shape)} on {a.device}" if isinstance(a, Tensor) else a
            wanted = f"{dtype} of {ndim} dimensions, tensors on {device}"
            raise TypeError(f"{name}: argument {i} is {found}, and has to be {wanted}")
    return device


@cache
def kinds_of(name: str) -> list[tuple[torch.dtype, int]]:
    """The type of each argument of a kernel, and its dimensions, 0 for a number."""
    return [(DTYPES[code[0]], int(code[1])) for code in SIGNATURES[name].split()]


def blocks_for(count: int) -> tuple[int, int]:
    """The grid of a kernel with a thread for each of `count`, THREADS in a block."""
    return -(-count // THREADS), 1


def few_blocks(count: int) -> tuple[int, int]:
    """The grid of a kernel whose threads take several of `count`, if there are many."""
    return min(blocks_for(count)[0], MAX_BLOCKS), 1


ZEROS = 2**18  # numbers that are cleared at a time, and then given out in small parts
unused_zeros: dict[tuple[torch.device, int], Tensor] = {}  # by device and stream
zeros_lock = Lock()  # gradients are made by a thread of their own


def few_zeros(like: Tensor, *shape: int) -> Tensor:
    """Float32 zeros on the device of `like`, for sums of a few numbers.

    They are parts of a block that was cleared at once: a launch for each such sum would
    take longer than most kernels.
    """
    device, count = like.device, math.prod(shape)
    stream = torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
    with zeros_lock, torch.inference_mode(False), torch.no_grad():
        left = unused_zeros.get((device, stream))
        if left is None or len(left) < count:
            left = torch.zeros(max(ZEROS, count), device=device)
        unused_zeros[device, stream] = left[count:]
        return left[:count].view(shape).data  # to autograd, it is no part of the block


def pack(*arguments: Tensor | float) -> bytes:
    """Arguments as a kernel's parameters lie in memory."""
    numbers: list[float] = []
    kinds = ""
    for a in arguments:
        if isinstance(a, Tensor):
            assert a.is_contiguous(), f"strides {a.stride()} of shape {tuple(a.shape)}"
            size = a.element_size()
            numbers += (0, 0, a.numel(), size, a.data_ptr(), *a.shape)
            numbers += (stride * size for stride in a.stride())
            kinds += "q" * (5 + 2 * a.ndim)
        else:
            numbers.append(a)
            kinds += "d" if isinstance(a, float) else "q"
    return struct.pack(kinds, *numbers)


@cache
def loaded_kernel(name: str, device: int) -> ctypes.c_void_p:
    """A kernel in the memory of a CUDA device, which is the current one."""
    image = load_kernel(name, torch.cuda.get_device_capability(device))
    return driver().load(image, name, device)


def load_all(device: torch.device) -> None:
    """Compile every kernel for a CUDA device, and load it there."""
    with torch.cuda.device(device):
        for name in SIGNATURES:
            loaded_kernel(name, torch.cuda.current_device())


@cache
def driver() -> Driver:
    """NVIDIA's driver."""
    return Driver(ctypes.CDLL("libcuda.so.1"))


class Driver:
    """The few functions of NVIDIA's driver that launches take; `library` is libcuda."""

    def __init__(self, library: Any) -> None:
        self.library = library
        self.contexts: dict[int, ctypes.c_void_p] = {}  # by device

    def call(self, function: str, *arguments: Any) -> None:
        """Call a function of the driver; RuntimeError where it fails."""
        code = getattr(self.library, function)(*arguments)
        if code:
            text = ctypes.c_char_p()
            self.library.cuGetErrorString(code, ctypes.byref(text))
            reason = (text.value or b"unknown error").decode()
            raise RuntimeError(f"{function} failed: {reason} ({code})")

    def load(self, image: bytes, name: str, device: int) -> ctypes.c_void_p:
        """The function `name` of an image of machine code or PTX, on a device."""
        self.make_current(device)
        module, function = ctypes.c_void_p(), ctypes.c_void_p()
        self.call("cuModuleLoadData", ctypes.byref(module), image)
        self.call("cuModuleGetFunction", ctypes.byref(function), module, name.encode())
        return function

    def make_current(self, device: int) -> None:
        """Make the context of a device, the one that torch uses, this thread's.

        A thread has none before torch's first kernel in it.
        """
        if device not in self.contexts:
            context, handle = ctypes.c_void_p(), ctypes.c_int()
            self.call("cuInit", 0)
            self.call("cuDeviceGet", ctypes.byref(handle), device)
            self.call("cuDevicePrimaryCtxRetain", ctypes.byref(context), handle)
            self.contexts[device] = context
        self.call("cuCtxSetCurrent", self.contexts[device])

    def launch(
        self,
        device: int,
        function: ctypes.c_void_p,
        grid: tuple[int, int],
        threads: int,
        stream: int,
        parameters: bytes,
    ) -> None:
        """Put a kernel with packed `parameters` on a stream of a device."""
        self.make_current(device)
        buffer = ctypes.create_string_buffer(parameters, len(parameters))
        size = ctypes.c_size_t(len(parameters))
        extra = (ctypes.c_void_p * 5)(
            BUFFER_POINTER,
            ctypes.addressof(buffer),
            BUFFER_SIZE,
            ctypes.addressof(size),
            BUFFER_END,
        )
        blocks = *grid, 1, threads, 1, 1
        shared_bytes = 0  # besides those that the kernels declare
        queue = ctypes.c_void_p(stream)
        self.call("cuLaunchKernel", function, *blocks, shared_bytes, queue, None, extra)


def simulate(name: str, grid: tuple[int, int], threads: int, *arguments: Tensor | float) -> None:
    """Run a kernel on tensors of the CPU by numba-cuda's simulator, in Python."""
    from numba import cuda
    from numba.core import config

    if not config.ENABLE_CUDASIM:
        raise RuntimeError("CUDA kernels take tensors of the CPU with NUMBA_ENABLE_CUDASIM=1")
    kernel = cuda.jit(kernel_function(name))
    values = (a.detach().numpy() if isinstance(a, Tensor) else a for a in arguments)
    kernel[grid, threads](*values)
