"""HDR stills with a PQ signal: AVIF of 10 bits through PyAV, and PNG of 16 bits.

Both are tagged as BT.2100 PQ by the codes of H.273 (CICP).
"""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hdr_nsff.core.hdr_video import (
    ENCODERS,
    PIXELS,
    REC2020_PRIMARIES,
    TRANSFERS,
    LightLevels,
    Planes,
    check_side,
    tag_rec2020,
    to_frame,
)
from hdr_nsff.core.io import atomic

# Constant quality of SVT-AV1 (hand-chosen on a textured room: luma within 1.5 codes of
# 1023 in the mean; 8 doubles that, 1 doubles the size)
AVIF_CRF = 4
AVIF_PRESET = 6  # of 0 (slow) to 13
RGB_MATRIX, FULL_RANGE = 0, 1  # H.273: no luma and chroma, codes from 0 to 65535
PNG_START_BYTES = 8 + 12 + 13  # the signature and the first chunk, IHDR
LIGHT_UNITS = 10000  # of cLLI, in one nit


def write_avif(path: Path | str, planes: Planes) -> None:
    """Write planes Y (H, W), Cb, Cr (H/2, W/2) of 10 bits as PQ AVIF, atomically.

    H and W are even. InputError where this PyAV has no such encoder.
    """
    import av

    height, width = planes[0].shape
    check_side(path, width, height)
    os.environ.setdefault("SVT_LOG", "1")  # errors only: SVT-AV1 prints banners otherwise
    parameters = "avif=1:color-primaries=9:matrix-coefficients=9:color-range=0"
    parameters += f":transfer-characteristics={TRANSFERS['pq']}"
    options = {"crf": str(AVIF_CRF), "preset": str(AVIF_PRESET), "svtav1-params": parameters}
    with atomic(path) as temporary, av.open(str(temporary), "w", format="avif") as container:
        stream: Any = container.add_stream(ENCODERS["av1"], rate=1, options=options)
        stream.width, stream.height = width, height
        stream.pix_fmt = PIXELS
        tag_rec2020(stream.codec_context, "pq")
        container.mux(stream.encode(to_frame(planes, "pq")))
        container.mux(stream.encode())


def write_pq_png(path: Path | str, signal: np.ndarray, light: LightLevels) -> None:
    """Write a PQ signal (H, W, 3) in [0, 1] as 16-bit PNG, atomically.

    Primaries are those of BT.2020. The chunks cICP and cLLI (PNG, third edition) hold
    the tags and the light levels.
    """
    codes = np.rint(np.clip(signal, 0, 1) * 65535).astype(np.uint16)
    ok, buffer = cv2.imencode(".png", np.ascontiguousarray(codes[..., ::-1]))
    assert ok, f"could not encode {path}"
    data = buffer.tobytes()
    tags = struct.pack("4B", REC2020_PRIMARIES, TRANSFERS["pq"], RGB_MATRIX, FULL_RANGE)
    levels = [round(light.max_cll * LIGHT_UNITS), round(light.max_fall * LIGHT_UNITS)]
    chunks = chunk(b"cICP", tags) + chunk(b"cLLI", struct.pack(">II", *levels))
    with atomic(path) as temporary:
        temporary.write_bytes(data[:PNG_START_BYTES] + chunks + data[PNG_START_BYTES:])


def chunk(name: bytes, content: bytes) -> bytes:
    """A chunk of a PNG."""
    check = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", check)
