"""What this process asks of its machine: how idle threads wait, how many threads torch
uses, how freed memory is kept; and that it ends with its parent.

Importing `hdr_nsff` changes none of it. The command line calls `prepare_process` before
it imports a verb; a program that uses the package as a library may do the same.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys
import threading
import time
from pathlib import Path

# Parameters of glibc's mallopt, from malloc.h.
M_TRIM_THRESHOLD, M_TOP_PAD = -1, -2
M_MMAP_THRESHOLD, M_ARENA_MAX = -3, -8

LARGEST_KEPT_BYTES = 32 << 20  # larger pieces go back at once; glibc allows no more
KEPT_BYTES = 512 << 20  # free memory that stays with the process (hand-chosen)
AHEAD_BYTES = 64 << 20  # requested beyond what is needed (hand-chosen)


def prepare_process() -> None:
    """Set up threads and memory of this process. Call it before torch or numba is
    imported: OpenMP reads its settings when it starts. Child processes inherit the
    settings of threads, not those of memory.

    torch and numba each keep a pool of OpenMP threads. While one pool works, idle
    threads of the other would spin on the same cores: on 2 loaded cores a training step
    took 3.7 s with spinning threads and 0.35 s with sleeping ones.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    keep_memory()


def keep_memory() -> bool:
    """Let freed memory stay with the process, because every training step and picture
    allocates the same sizes again. False where the allocator has no such setting.

    By default glibc returns pieces of a picture's size to the system and gets them
    anew, with a page fault for every 4 KB: up to 10 of the 11 ms that a picture of
    720x480 takes. All threads share one heap: with a heap each, what one of them freed
    was lost to the others (flow of 1280x720 took 4.5 GB instead of 1.7, and no less
    time).
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    if mallopt is None:
        return False
    settings = {
        M_MMAP_THRESHOLD: LARGEST_KEPT_BYTES,
        M_TRIM_THRESHOLD: KEPT_BYTES,
        M_TOP_PAD: AHEAD_BYTES,
        M_ARENA_MAX: 1,
    }
    accepted = [mallopt(name, value) == 1 for name, value in settings.items()]
    return all(accepted)


def limit_torch_threads(count: int) -> None:
    """Let torch use `count` threads; 0 leaves the number as it is. Call it before every
    step or frame: numba's kernels set the thread count of the OpenMP library that both
    share.
    """
    if count == 0:
        return
    import torch

    torch.set_num_threads(count)


def die_with_parent() -> None:
    """End this process soon after its parent is gone (killed, too)."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def usable_cores() -> int:
    """The number of CPU cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):  # Linux only
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def peak_memory() -> int:
    """The most memory that this process has used so far, in bytes; 0 where the system
    does not count it (Windows).
    """
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # macOS counts bytes, Linux KiB


def cpu_seconds() -> float:
    """Processor time in seconds, of this process and of its children that ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def cpu_name() -> str:
    """The name of the CPU, as its maker writes it where the system knows it."""
    info = Path("/proc/cpuinfo")  # Linux
    lines = info.read_text(errors="replace").splitlines() if info.is_file() else []
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip() in ("model name", "Hardware", "Processor"):
            return value.strip()
    return platform.processor() or platform.machine()
