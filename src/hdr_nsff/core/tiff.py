"""Tags of TIFF files, and which of these OpenCV would decode to other values."""

from __future__ import annotations

import struct
from pathlib import Path

from hdr_nsff.core.errors import InputError

STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # TIFF and BigTIFF
INTEGERS = {3: "H", 4: "I", 16: "Q"}  # field types
# tags of TIFF 6.0
WIDTH = 256
HEIGHT = 257
BITS_PER_SAMPLE = 258
PHOTOMETRIC = 262
SAMPLES_PER_PIXEL = 277
PLANAR_CONFIGURATION = 284
TILE_WIDTH = 322
EXTRA_SAMPLES = 338
# their values
WHITE_IS_ZERO = 0
BLACK_IS_ZERO = 1
PLANES = 2
UNASSOCIATED_ALPHA = 2


def tiff_tags(data: bytes) -> dict[int, tuple[int, int]]:
    """The integer tags in the first directory of a TIFF: the first value of each, and
    its place in `data`. struct.error where these end before.
    """
    order = "<" if data[:2] == b"II" else ">"
    if b"+" in data[:4]:  # BigTIFF
        (place,) = struct.unpack_from(f"{order}Q", data, 8)
        (count,) = struct.unpack_from(f"{order}Q", data, place)
        first = place + 8
        offset = f"{order}Q"
    else:
        (place,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, place)
        first = place + 2
        offset = f"{order}I"
    value_bytes = struct.calcsize(offset)
    entry_bytes = 4 + 2 * value_bytes  # tag, type, number of values, value or its place
    found = {}
    for start in range(first, first + count * entry_bytes, entry_bytes):
        tag, kind = struct.unpack_from(f"{order}HH", data, start)
        if kind not in INTEGERS:
            continue
        (values,) = struct.unpack_from(offset, data, start + 4)
        place = start + 4 + value_bytes
        if values * struct.calcsize(order + INTEGERS[kind]) > value_bytes:
            (place,) = struct.unpack_from(offset, data, place)
        (value,) = struct.unpack_from(order + INTEGERS[kind], data, place)
        found[tag] = value, place
    return found


def decodable_tiff(path: Path, data: bytes) -> bytes:
    """A TIFF of which OpenCV decodes the colors as they are stored.

    It multiplies colors of 8 bits by an alpha that is tagged as unassociated, and not
    by one without a meaning, so that this becomes the tag. InputError for what it would
    decode to other values.
    """
    tags = {tag: value for tag, (value, _) in tiff_tags(data).items()}
    bits = tags.get(BITS_PER_SAMPLE, 1)
    samples = tags.get(SAMPLES_PER_PIXEL, 1)
    photometric = tags.get(PHOTOMETRIC)
    planes = tags.get(PLANAR_CONFIGURATION) == PLANES and samples > 1
    if bits > 8 and photometric == WHITE_IS_ZERO:
        raise InputError(f"{path}: {bits} bits in which white is 0; save it with black as 0")
    if bits > 8 and planes:
        advice = "save it with interleaved channels, as by `tiffcp -p contig`"
        raise InputError(f"{path}: {bits} bits in one plane per channel; {advice}")
    gray_with_more = photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO) and samples > 1
    if gray_with_more and (bits > 8 or (TILE_WIDTH in tags and not planes)):
        raise InputError(f"{path}: gray with further channels; save it as RGB or as gray only")
    if bits > 8 or tags.get(EXTRA_SAMPLES) != UNASSOCIATED_ALPHA:
        return data
    _, place = tiff_tags(data)[EXTRA_SAMPLES]
    return data[:place] + bytes(2) + data[place + 2 :]
