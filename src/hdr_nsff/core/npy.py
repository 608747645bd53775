"""Arrays of `.npy` files, memory-mapped by any number of threads at once.

numpy parses the header with `ast.literal_eval`, which fails now and then where two
threads call it at once (CPython 3.11.7: "AST constructor recursion depth mismatch",
python/cpython#106905). Here a pattern reads it.

Source: numpy.lib.format, versions 1 to 3 of the format.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

MAGIC = b"\x93NUMPY"
LENGTH_BYTES = {1: 2, 2: 4, 3: 4}  # by version: of the number that is the header's length
HEADER = re.compile(
    r"\{'descr': '(?P<dtype>[<>|=][biufcSU]\d+)', "
    r"'fortran_order': (?P<fortran>True|False), "
    r"'shape': \((?P<shape>[\d, ]*)\), ?\}\s*"
)
MAX_HEADER = 10_000  # bytes; numpy's own limit


def map_npy(path: Path | str) -> np.ndarray:
    """The array of a `.npy` file, memory-mapped, read-only.

    ValueError or OSError where the file is no `.npy`, holds records or Python objects,
    or is shorter than its header claims.
    """
    with open(path, "rb") as file:
        magic = file.read(8)
        if len(magic) < 8 or magic[:6] != MAGIC or magic[6] not in LENGTH_BYTES:
            raise ValueError("no .npy of version 1, 2 or 3")
        length = int.from_bytes(file.read(LENGTH_BYTES[magic[6]]), "little")
        header = file.read(min(length, MAX_HEADER)).decode("latin1")
        offset = file.tell()
    found = HEADER.fullmatch(header)
    if found is None:
        raise ValueError(f"its header is {header.strip()!r}")
    shape = tuple(int(size) for size in re.findall(r"\d+", found["shape"]))
    dtype = np.dtype(found["dtype"])
    if found["fortran"] == "True":
        return np.memmap(path, dtype, "r", offset, shape, "F")
    return np.memmap(path, dtype, "r", offset, shape)
