"""How this process's allocator deals with freed memory."""

import ctypes
import sys

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3  # of glibc's malloc.h
LARGEST = 32 << 20  # bytes: larger pieces go back at once; glibc allows no more
KEPT = 512 << 20  # bytes of free memory that stay with the process
AHEAD = 64 << 20  # bytes asked for beyond what is needed


def keep_memory() -> bool:
    """Let freed memory stay with the process, as every step and picture asks for the
    same pieces again; whether the allocator can be told.

    glibc gives pieces of a picture's size back to the system and gets them anew, a page
    fault for every 4 KB: up to 10 ms of a picture of 720x480 that takes 11.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    if mallopt is None:
        return False
    settings = (M_MMAP_THRESHOLD, LARGEST), (M_TRIM_THRESHOLD, KEPT), (M_TOP_PAD, AHEAD)
    return all([mallopt(name, value) == 1 for name, value in settings])
