"""Cryptomatte 1.2: mattes of named objects in EXR channels (Friedman and Jones 2015).

An object's id is the MurmurHash3 of its name, as the bits of a float. Every pixel lists
the ids of the objects that cover it, those of most coverage first, with their coverage.
Compositors pick an object by a click and get its matte, soft edges included.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence

import numpy as np

RANKS = 4  # ids of a pixel: two layers of two (objects beyond are left out)
WORD = 0xFFFFFFFF
EXPONENT_BIT = 1 << 23  # flipped in hashes that are no ordinary floats


def channels(layer: str, objects: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """EXR channels of coverages {name: (H, W)} in [0, 1], float32."""
    ids = np.array([object_id(name) for name in objects], np.float32)
    coverage = np.stack(list(objects.values()), -1).astype(np.float32)  # (H, W, objects)
    order = np.argsort(-coverage, axis=-1, kind="stable")[..., :RANKS]
    ranked = np.take_along_axis(coverage, order, -1)
    known = np.where(ranked > 0, ids[order], np.float32(0))
    result = {}
    for rank in range(RANKS):
        names = ("R", "G") if rank % 2 == 0 else ("B", "A")
        missing = rank >= ranked.shape[-1]
        empty = np.zeros(coverage.shape[:2], np.float32)
        prefix = f"{layer}{rank // 2:02d}"
        result[f"{prefix}.{names[0]}"] = empty if missing else known[..., rank]
        result[f"{prefix}.{names[1]}"] = empty if missing else ranked[..., rank]
    return result


def header(layer: str, names: Sequence[str]) -> dict[str, str]:
    """EXR attributes that describe the layer, with all names."""
    key = f"cryptomatte/{hash_text(layer):08x}"[: len("cryptomatte/") + 7]
    manifest = {name: f"{float_bits(name):08x}" for name in names}
    return {
        f"{key}/name": layer,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest, separators=(",", ":")),
    }


def object_id(name: str) -> float:
    """The id of an object: the bits of `float_bits` as a float."""
    return float(struct.unpack("<f", struct.pack("<I", float_bits(name)))[0])


def float_bits(name: str) -> int:
    """The hash of a name, made an ordinary float: neither NaN, Inf nor denormal."""
    value = hash_text(name)
    exponent = value >> 23 & 255
    return value ^ EXPONENT_BIT if exponent in (0, 255) else value


def hash_text(text: str) -> int:
    """MurmurHash3 of UTF-8 text, x86, 32 bits, seed 0 (Appleby)."""
    data = text.encode()
    whole = len(data) // 4 * 4
    value = 0
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        value ^= scramble(word)
        value = (rotate(value, 13) * 5 + 0xE6546B64) & WORD
    value ^= scramble(int.from_bytes(data[whole:], "little"))
    value ^= len(data)
    value = ((value ^ value >> 16) * 0x85EBCA6B) & WORD
    value = ((value ^ value >> 13) * 0xC2B2AE35) & WORD
    return value ^ value >> 16


def scramble(word: int) -> int:
    """A block of four bytes as MurmurHash3 adds it."""
    return (rotate(word * 0xCC9E2D51 & WORD, 15) * 0x1B873593) & WORD


def rotate(word: int, bits: int) -> int:
    """The bits of a 32-bit word, rotated to the left."""
    return (word << bits | word >> 32 - bits) & WORD
