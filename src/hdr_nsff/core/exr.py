"""OpenEXR: linear maps of any range, channel by channel, float32 in memory.

Reading checks and refuses in one sentence (`InputError`); writing never clamps.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic
from hdr_nsff.core.picture_size import check_size

# Names of motion channels: to the next frame or time, to the one before.
MOTION_DIRECTIONS = {1: "forward", -1: "backward"}
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # chromaticities of R, G, B and white


def write_exr(
    path: Path | str,
    channels: dict[str, np.ndarray],
    header: dict[str, Any] | None = None,
    half: bool = True,
) -> None:
    """Write channels {name: (H, W)} or {"RGB": (H, W, 3)}, never clamped.

    NaN and Inf are an error. With `half`, channels take 16 bits, but depth `Z`, ids of
    Cryptomatte and radiance beyond 65504 keep 32. Keys of `header` (str, float, tuples)
    become attributes; without `chromaticities`, the file claims none. Compression is
    ZIP.
    """
    arrays = {}
    for name, array in channels.items():
        assert np.isfinite(array).all(), f"{path}: channel {name} holds NaN or Inf"
        exact = name == "Z" or name.startswith("Crypto")
        arrays[name] = to_pixels(array, half and not exact)
    full = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **(header or {}),
    }
    with atomic(path) as temporary, OpenEXR.File(full, arrays) as file:
        file.write(str(temporary))


def to_pixels(array: np.ndarray, half: bool) -> np.ndarray:
    """An array as float16 where asked for and where every value fits, else float32.

    Contiguous, because OpenEXR writes wrong pixels for anything else.
    """
    if half:
        with np.errstate(over="ignore"):
            small = np.ascontiguousarray(array, dtype=np.float16)
        if not np.isinf(small).any():
            return small
    return np.ascontiguousarray(array, dtype=np.float32)


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps what OpenEXR prints of a damaged file away from the terminal: warnings on
    Python's stdout, errors of its C library on stderr. Not for several threads at once.

    The error that it raises names the same problem.
    """
    with open(os.devnull, "wb") as nowhere, redirect_stdout(StringIO()):
        stderr = os.dup(2)
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Errors of OpenEXR as InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # OpenEXR raises several unrelated types
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{path}: not a readable EXR ({reason}); copy it again") from error


def read_header(path: Path) -> dict[str, Any]:
    """The attributes of an EXR."""
    with quiet(), OpenEXR.File(str(path), header_only=True) as file:
        return dict(file.header())


def read_origin(path: Path) -> tuple[int, int]:
    """Left and top of the data window of an EXR."""
    with refusing(path):
        (left, top), _ = read_header(path)["dataWindow"]
        return int(left), int(top)


def read_exr(path: Path | str, used: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Channels of an EXR as float32: {"RGB": (H, W, 3)}, {name: (H, W)} for the others.

    InputError for a file cut short, pixels that are not square, and NaN or Inf, looked
    for in the channels that are `used`, by default all.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; put it back or correct the name")
    with refusing(path):
        header = read_header(path)
        if (aspect := header.get("pixelAspectRatio", 1.0)) != 1:
            raise InputError(f"{path}: pixels {aspect:g} times as wide as high; write square ones")
        (left, top), (right, bottom) = header["dataWindow"]
        check_size(path, int(right) - int(left) + 1, int(bottom) - int(top) + 1)
        with quiet(), OpenEXR.File(str(path)) as file:
            if not file.parts:
                raise InputError(f"{path}: the EXR is cut short or damaged; copy it again")
            channels = {n: np.array(c.pixels, dtype=np.float32) for n, c in file.channels().items()}
    if "RGB" not in channels and "RGBA" in channels:
        channels["RGB"] = np.ascontiguousarray(channels["RGBA"][..., :3])
    for name, array in channels.items():
        if (used is None or name in used) and not np.isfinite(array).all():
            advice = "correct it in the program that wrote it"
            raise InputError(f"{path}: channel {name} holds NaN or Inf; {advice}")
    return channels
