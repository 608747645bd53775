"""Arrays in files that other programs wrote: `.npy` and `.npz`.

Such a file may be cut short, damaged, of text, or claim more numbers than it holds.
numpy answers with a dozen unrelated exceptions, or allocates what the header claims;
here each of these is one sentence. Pickles are never opened.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.npy import map_npy

NUMBERS = "biuf"  # kinds of numpy's dtypes: truth values, integers, floats
# bytes of one array in a .npz, unpacked: flow of 200 megapixels in double precision
MAX_UNPACKED = 2 * 8 * 200_000_000


def read_array(path: Path, dtype: type = np.float32) -> np.ndarray:
    """The array of a `.npy` as `dtype`; values that it cannot hold become Inf.

    InputError for a file that is missing, no `.npy`, cut short, or not of numbers.
    """
    check_file(path)
    try:
        # mapped, so that what the header claims is compared with the file's length
        array = map_npy(path)
    except Exception as error:  # many unrelated types, for a damaged header alone
        raise InputError(
            f"{path}: not a readable .npy array ({shorten(error)}); copy it again"
        ) from error
    return convert_numbers(path, array, dtype)


def read_arrays(path: Path, names: Sequence[str], kind: str) -> list[np.ndarray]:
    """The arrays `names` of a `.npz` as float32.

    InputError as in `read_array`; `kind` is what it calls the file.
    """
    check_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = [read_member(archive, f"{name}.npy") for name in names]
    except Exception as error:  # of zipfile, zlib and numpy: many unrelated types
        wanted = " and ".join(f"`{name}`" for name in names)
        raise InputError(
            f"{path}: not a {kind} with {wanted} ({shorten(error)}); copy it again"
        ) from error
    return [convert_numbers(path, array, np.float32) for array in arrays]


def check_file(path: Path) -> None:
    """InputError where there is no file; a pipe would be waited for."""
    if not path.is_file():
        raise InputError(f"{path}: missing; copy it again")


def read_member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """One array of an open `.npz`; ValueError for one that unpacks to too much."""
    member = archive.getinfo(name)
    if member.file_size > MAX_UNPACKED:
        raise ValueError(f"{name} unpacks to {member.file_size / 1e9:.0f} GB")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def convert_numbers(path: Path, array: np.ndarray, dtype: type) -> np.ndarray:
    """A copy of `array` as `dtype`; InputError where it does not hold numbers."""
    if array.dtype.kind not in NUMBERS:
        raise InputError(f"{path}: holds {shorten(array.dtype)}, not numbers; copy it again")
    with np.errstate(over="ignore"):
        return np.array(array, dtype)
