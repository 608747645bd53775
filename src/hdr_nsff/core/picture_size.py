"""The size of a picture by its header, before anything is decoded.

A picture of zeros packs a thousandfold: half a megabyte of PNG can ask for gigabytes of
memory. Nobody's camera makes such pictures, so one size limit serves all formats.
"""

from __future__ import annotations

import struct
from pathlib import Path

from hdr_nsff.core import tiff
from hdr_nsff.core.errors import InputError

# above the largest sensors (150 megapixels); takes 2.4 GB as single-precision rgb
MAX_MEGAPIXELS = 200
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers SOF0 to SOF15


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
        if data[:4] in tiff.STARTS:
            return tiff_size(data)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return webp_size(data)
    except (struct.error, IndexError, OverflowError):  # it ends before its size
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
    tags = tiff.tiff_tags(data)
    if tiff.WIDTH not in tags or tiff.HEIGHT not in tags:
        raise IndexError("no size in the first directory")
    return tags[tiff.WIDTH][0], tags[tiff.HEIGHT][0]


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
