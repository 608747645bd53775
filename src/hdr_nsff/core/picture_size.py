"""The size of a picture by its header, before anything is decoded.

A picture of zeros packs a thousandfold: half a megabyte of PNG can ask for gigabytes of
memory. Nobody's camera makes such pictures, so one size limit serves all formats.
"""

from __future__ import annotations

import struct
from pathlib import Path

from hdr_nsff.core.errors import InputError

# above the largest sensors (150 megapixels); takes 2.4 GB as single-precision rgb
MAX_MEGAPIXELS = 200
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers SOF0 to SOF15
TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # TIFF and BigTIFF
TIFF_WIDTH = 256  # tags of TIFF 6.0
TIFF_HEIGHT = 257
TIFF_INTEGERS = {3: "H", 4: "I", 16: "Q"}  # field types


def check_size(path: Path | str, width: int, height: int) -> None:
    """InputError for a picture of more than `MAX_MEGAPIXELS`."""
    if width * height > MAX_MEGAPIXELS * 1_000_000:
        raise InputError(
            f"{path}: {width}x{height} pixels, more than the {MAX_MEGAPIXELS} megapixels "
            "that are read; make it smaller"
        )


def encoded_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that the header of a PNG, JPEG, TIFF or WebP claims; None where
    it is damaged or of another format.
    """
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        if data.startswith(b"\xff\xd8"):
            return jpeg_size(data)
        if data[:4] in TIFF_STARTS:
            return tiff_size(data)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return webp_size(data)
    except (struct.error, IndexError):  # it ends before its size
        return None
    return None


def jpeg_size(data: bytes) -> tuple[int, int]:
    """The size in the first frame header (SOF) of a JPEG; IndexError without one."""
    place = 2
    while True:
        if data[place] != 0xFF:
            raise IndexError(f"no marker at byte {place}")
        marker = data[place + 1]
        if marker == 0xFF:  # a fill byte
            place += 1
        elif marker in JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        else:
            (length,) = struct.unpack_from(">H", data, place + 2)
            place += 2 + length


def tiff_size(data: bytes) -> tuple[int, int]:
    """The size in the first directory of a TIFF; IndexError without one."""
    order = "<" if data[:2] == b"II" else ">"
    if b"+" in data[:4]:  # BigTIFF
        (place,) = struct.unpack_from(f"{order}Q", data, 8)
        (count,) = struct.unpack_from(f"{order}Q", data, place)
        first = place + 8
        entry_bytes = 20
        value_bytes = 8
    else:
        (place,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, place)
        first = place + 2
        entry_bytes = 12
        value_bytes = 4
    value_offset = entry_bytes - value_bytes  # the value ends an entry
    found = {}
    for start in range(first, first + count * entry_bytes, entry_bytes):
        tag, kind = struct.unpack_from(f"{order}HH", data, start)
        if tag in (TIFF_WIDTH, TIFF_HEIGHT) and kind in TIFF_INTEGERS:
            value = struct.unpack_from(order + TIFF_INTEGERS[kind], data, start + value_offset)
            found[tag] = value[0]
    if len(found) < 2:
        raise IndexError("no size in the first directory")
    return found[TIFF_WIDTH], found[TIFF_HEIGHT]


def webp_size(data: bytes) -> tuple[int, int]:
    """The size in the first chunk of a WebP; IndexError without one."""
    match data[12:16]:
        case b"VP8X":  # extended: two times 24 bits, less 1
            low, high = data[24:27], data[27:30]
            return 1 + int.from_bytes(low, "little"), 1 + int.from_bytes(high, "little")
        case b"VP8L":  # lossless: two times 14 bits, less 1
            (bits,) = struct.unpack_from("<I", data, 21)
            return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
        case b"VP8 ":  # lossy: two times 14 bits
            width, height = struct.unpack_from("<HH", data, 26)
            return width & 0x3FFF, height & 0x3FFF
    raise IndexError("no picture in the first chunk")
