"""Images of recorded values: PNG, JPEG and TIFF of 8 or 16 bits, and pictures of maps.

An image is float32 rgb (H, W, 3) in [0, 1]. Reading checks and refuses in one sentence
(`InputError`); writing clips, because a PNG is for looking at or a recorded image.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np

from hdr_nsff.core import tiff
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic, how_to_restore
from hdr_nsff.core.picture_size import check_size, encoded_size

PNG_END = b"IEND\xaeB`\x82"
JPEG_START = b"\xff\xd8"
# of a JPEG: markers, but for those that stand alone before its end (RST, SOI, TEM)
JPEG_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")
JPEG_END = 0xD9
TURBO_PERCENTILES = (2, 98)  # of a map: the ends of its colors (hand-chosen on depth maps)
FLOW_PERCENTILE = 98  # of the lengths: full saturation (hand-chosen on rendered scenes)


def encode(path: Path | str, image: np.ndarray) -> None:
    """Write 8- or 16-bit (H, W) or (H, W, 3) RGB through OpenCV, atomically."""
    bgr = image[..., ::-1] if image.ndim == 3 else image
    data = np.ascontiguousarray(bgr)
    with atomic(path) as temporary:
        ok, buffer = cv2.imencode(Path(path).suffix, data)
        assert ok, f"could not encode {path}"
        temporary.write_bytes(buffer.tobytes())


def write_png(path: Path | str, rgb: np.ndarray, bits: int = 8) -> None:
    """Write rgb (H, W, 3) or gray (H, W) in [0, 1], or a bool mask (H, W).

    `bits`: 8 or 16. Values outside [0, 1] are clipped.
    """
    if rgb.dtype == bool:
        encode(path, rgb.astype(np.uint8) * 255)
        return
    top = 2**bits - 1
    dtype = np.uint8 if bits == 8 else np.uint16
    encode(path, np.rint(np.clip(rgb, 0, 1) * top).astype(dtype))


def read_image(path: Path | str, over: float | None = None) -> np.ndarray:
    """A PNG, JPEG or TIFF of 8 or 16 bits as float32 rgb (H, W, 3) in [0, 1].

    `over` is the gray in [0, 1] that shows through transparent pixels; with None
    transparency is ignored.
    """
    path = Path(path)
    image = decode(path, transparency=over is not None)
    top = 255 if image.dtype == np.uint8 else 65535
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, -1)
    rgb = np.ascontiguousarray(image[..., 2::-1]).astype(np.float32) / top
    if image.shape[2] < 4:
        return rgb
    alpha = image[..., 3:].astype(np.float32) / top
    return rgb * alpha + np.float32(over or 0.0) * (1 - alpha)


def read_codes(path: Path | str) -> np.ndarray:
    """The codes of a PNG, JPEG or TIFF as they are stored, rgb (H, W, 3), uint8 or
    uint16; transparency is ignored.
    """
    image = decode(Path(path), transparency=False)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, -1)
    return np.ascontiguousarray(image[..., 2::-1])


def codes_to_rgb(codes: np.ndarray) -> np.ndarray:
    """Codes (H, W, 3) uint8 or uint16 as float32 rgb in [0, 1]."""
    return codes.astype(np.float32) / np.iinfo(codes.dtype).max


def decode(path: Path, transparency: bool) -> np.ndarray:
    """The pixels of an image file, uint8 or uint16, (H, W) or (H, W, 3 or 4).

    BGR, with `transparency` BGRA where the file has it. InputError where it is
    no image.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such image; put it back or correct the name")
    data = path.read_bytes()
    suffix = path.suffix.lower()
    if suffix == ".png" and not data.rstrip(b"\0").endswith(PNG_END):
        raise InputError(f"{path}: the PNG is cut short; {how_to_restore(path)}")
    if suffix in {".jpg", ".jpeg"} and not has_jpeg_end(data):
        raise InputError(f"{path}: the JPEG is cut short; {how_to_restore(path)}")
    size = encoded_size(data)
    if size is not None:
        check_size(path, *size)
    if size is not None and data[:4] in tiff.STARTS:
        data = tiff.decodable_tiff(path, data)
    opaque = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
    flags = cv2.IMREAD_UNCHANGED if transparency else opaque
    try:
        image = None if size is None else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(
            f"{path}: not a readable image (PNG, JPEG or TIFF); {how_to_restore(path)}"
        )
    if image.dtype not in (np.uint8, np.uint16):
        advice = "convert to 8 or 16 bits, or to EXR for linear data"
        raise InputError(f"{path}: {image.dtype} pixels; {advice}")
    return image


def has_jpeg_end(data: bytes) -> bool:
    """Whether a JPEG holds its picture to the end marker. Anything may follow: phones
    append data of their own, further pictures, and videos.

    Segments are passed over by their lengths, since thumbnails in them end like this.
    """
    if not data.startswith(JPEG_START):
        return False
    place = len(JPEG_START)
    while (found := JPEG_MARKER.search(data, place)) is not None:
        place = found.end()
        if data[place - 1] == JPEG_END:
            return True
        place += int.from_bytes(data[place : place + 2], "big")
    return False


def read_mask(path: Path | str) -> np.ndarray:
    """A mask image as bool (H, W): true above half of white, in the mean of rgb;
    transparency is ignored.
    """
    return mask_gray(path) > 0.5


def mask_gray(path: Path | str) -> np.ndarray:
    """The mean of rgb (H, W) of a mask image in [0, 1]; transparency is ignored."""
    codes = decode(Path(path), transparency=False)
    gray = codes if codes.ndim == 2 else codes.mean(-1)
    return np.asarray(gray / np.iinfo(codes.dtype).max)


def contact_sheet(
    rows: list[list[np.ndarray]], gap: int = 4, background: float = 0.12
) -> np.ndarray:
    """One picture (H, W, 3) of a table of pictures with `gap` pixels between them.

    Gray pictures (H, W) become rgb; all cells take the size of the largest.
    """
    cells = [[gray_to_rgb(cell) for cell in row] for row in rows]
    h = max(cell.shape[0] for row in cells for cell in row)
    w = max(cell.shape[1] for row in cells for cell in row)
    columns = max(len(row) for row in cells)
    size = (len(cells) * (h + gap) + gap, columns * (w + gap) + gap, 3)
    sheet = np.full(size, background, np.float32)
    for i, row in enumerate(cells):
        for j, cell in enumerate(row):
            y = gap + i * (h + gap)
            x = gap + j * (w + gap)
            sheet[y : y + cell.shape[0], x : x + cell.shape[1]] = cell
    return sheet


def gray_to_rgb(image: np.ndarray) -> np.ndarray:
    """(H, W) as (H, W, 3); (H, W, 3) as it is."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, -1)


def colorize(
    values: np.ndarray,
    low: float | None = None,
    high: float | None = None,
    valid: np.ndarray | None = None,
) -> np.ndarray:
    """A scalar map (H, W) as rgb (H, W, 3) in [0, 1] through matplotlib's turbo.

    Colors span `low` to `high`, by default the percentiles 2 and 98 of the pixels in
    `valid` (H, W) bool; pixels outside it are black.
    """
    import matplotlib

    known = values.reshape(-1)
    if valid is not None and valid.any():
        known = values[valid]
    if low is None:
        low = float(np.percentile(known, TURBO_PERCENTILES[0]))
    if high is None:
        high = float(np.percentile(known, TURBO_PERCENTILES[1]))
    share = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    rgb = matplotlib.colormaps["turbo"](share)[..., :3].astype(np.float32)
    return rgb if valid is None else rgb * valid[..., None]


def colorize_flow(flow: np.ndarray, maximum: float | None = None) -> np.ndarray:
    """Optical flow (H, W, 2) px as rgb (H, W, 3).

    Hue is direction, saturation is length up to `maximum` px (98th percentile).
    """
    length = np.linalg.norm(flow, axis=-1)
    maximum = maximum or max(float(np.percentile(length, FLOW_PERCENTILE)), 1e-6)
    angle = np.degrees(np.arctan2(flow[..., 1], flow[..., 0]))
    hue = (angle % 360).astype(np.float32)
    saturation = np.clip(length / maximum, 0, 1).astype(np.float32)
    hsv = np.stack([hue, saturation, np.ones_like(hue)], -1)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
