"""Ultra HDR JPEG: an SDR picture that every program shows, and a gain map behind it.

Two JPEGs in one file, listed by CIPA's multi-picture format (DC-007). What the gains
mean stands there twice: as ISO 21496-1, and as the older `hdrgm` XMP of Adobe and
Android, which older readers look for.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdr_nsff.core.io import atomic

# Added to both pictures, so that black has a gain: 1/64, the default of the standard's
# examples and of the `hdrgm` metadata
OFFSET = 1 / 64
QUALITY = 95  # of both JPEGs (hand-chosen: 90 doubles the error, 98 the size)
DENOMINATOR = 1 << 20  # of the fractions of ISO 21496-1
ISO_NAME = b"urn:iso:std:iso:ts:21496:-1\0"
XMP_NAME = b"http://ns.adobe.com/xap/1.0/\0"
ISO_VERSION = struct.pack(">HH", 0, 0)  # of the least reader and of the writer
MULTI_CHANNEL, BASE_COLORS = 0x80, 0x40  # flags of ISO 21496-1
MPF_NAME = b"MPF\0"
MPF_PRIMARY = 0x030000  # DC-007: a baseline primary picture
XMP_HEAD = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    'xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0"'
)
XMP_TAIL = "</rdf:Description></rdf:RDF></x:xmpmeta>"


@dataclass(frozen=True)
class GainMap:
    """Gains of a picture, per channel."""

    codes: np.ndarray  # (H, W, 3) in [0, 1]: from the minimum to the maximum
    minimum: np.ndarray  # (3,) log2 of the gain at code 0
    maximum: np.ndarray  # (3,) log2 of the gain at code 1
    headroom: float  # stops above SDR white at which the whole gain applies
    offset: float = OFFSET


def write_ultra_hdr(
    path: Path | str, picture: np.ndarray, gains_of: Callable[[np.ndarray], GainMap]
) -> None:
    """Write an sRGB picture (H, W, 3) in [0, 1] with its gain map, atomically.

    `gains_of` makes the gains from the picture as readers see it, after JPEG: so the
    gains undo what JPEG did to the picture.
    """
    base = encode_jpeg(picture)
    gains = gains_of(decode_jpeg(base))
    with atomic(path) as temporary:
        temporary.write_bytes(join(base, encode_jpeg(gains.codes), gains))


def encode_jpeg(picture: np.ndarray) -> bytes:
    """A picture (H, W, 3) in [0, 1] as JPEG with full chroma."""
    from PIL import Image

    codes = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(codes).save(buffer, "JPEG", quality=QUALITY, subsampling=0)
    return buffer.getvalue()


def decode_jpeg(data: bytes) -> np.ndarray:
    """The picture (H, W, 3) in [0, 1] of a JPEG."""
    from PIL import Image

    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB"), np.float32) / 255


def join(base: bytes, gain_jpeg: bytes, gains: GainMap) -> bytes:
    """The file: both JPEGs with their metadata."""
    second = insert(gain_jpeg, [xmp_segment(gain_xmp(gains)), iso_segment(iso_metadata(gains))])
    first = [xmp_segment(base_xmp(len(second))), iso_segment(ISO_VERSION)]
    # The list of pictures counts from its own head, so its place comes first.
    before = insert(base, first)
    size = len(before) + len(mpf_segment(0, 0, 0))
    start = head_bytes(base) + sum(map(len, first)) + MPF_HEAD_BYTES
    listed = mpf_segment(size, len(second), size - start)
    return insert(base, [*first, listed]) + second


def insert(jpeg: bytes, segments: list[bytes]) -> bytes:
    """A JPEG with `segments` after its first one, JFIF."""
    place = head_bytes(jpeg)
    return jpeg[:place] + b"".join(segments) + jpeg[place:]


def head_bytes(jpeg: bytes) -> int:
    """The bytes of the start mark and of the first segment, JFIF."""
    assert jpeg[:4] == b"\xff\xd8\xff\xe0", jpeg[:4]
    return 4 + struct.unpack(">H", jpeg[4:6])[0]


def segment(mark: int, content: bytes) -> bytes:
    """A segment of a JPEG: APP1 is `mark` 1."""
    return struct.pack(">BBH", 0xFF, 0xE0 + mark, len(content) + 2) + content


def iso_segment(content: bytes) -> bytes:
    """Metadata of ISO 21496-1 in a JPEG."""
    return segment(2, ISO_NAME + content)


def xmp_segment(text: str) -> bytes:
    """XMP in a JPEG."""
    return segment(1, XMP_NAME + text.encode())


def iso_metadata(gains: GainMap) -> bytes:
    """ISO 21496-1, annex C: fractions of three channels."""
    head = struct.pack("B", MULTI_CHANNEL | BASE_COLORS)
    stops = fraction(0, "I") + fraction(gains.headroom, "I")  # of the SDR and HDR pictures
    channels = [
        fraction(low, "i")
        + fraction(high, "i")
        + fraction(1, "I")  # gamma of the codes
        + fraction(gains.offset, "i") * 2  # of the SDR and HDR pictures
        for low, high in zip(gains.minimum, gains.maximum, strict=True)
    ]
    return ISO_VERSION + head + stops + b"".join(channels)


def fraction(value: float, kind: str) -> bytes:
    """A fraction of two 32-bit integers; `kind` is that of the upper one."""
    return struct.pack(f">{kind}I", round(float(value) * DENOMINATOR), DENOMINATOR)


def gain_xmp(gains: GainMap) -> str:
    """The `hdrgm` XMP of the gain map."""
    single = {
        "HDRCapacityMin": 0.0,
        "HDRCapacityMax": gains.headroom,
        "OffsetSDR": gains.offset,
        "OffsetHDR": gains.offset,
        "Gamma": 1.0,
    }
    attributes = "".join(f' hdrgm:{name}="{value:.6f}"' for name, value in single.items())
    lists = channel_list("GainMapMin", gains.minimum) + channel_list("GainMapMax", gains.maximum)
    return f'{XMP_HEAD}{attributes} hdrgm:BaseRenditionIsHDR="False">{lists}{XMP_TAIL}'


def channel_list(name: str, values: np.ndarray) -> str:
    """Three numbers in XMP."""
    items = "".join(f"<rdf:li>{value:.6f}</rdf:li>" for value in values)
    return f"<hdrgm:{name}><rdf:Seq>{items}</rdf:Seq></hdrgm:{name}>"


def base_xmp(gain_bytes: int) -> str:
    """The XMP of the SDR picture: what follows it, and how long that is."""
    names = (
        ' xmlns:Container="http://ns.google.com/photos/1.0/container/"'
        ' xmlns:Item="http://ns.google.com/photos/1.0/container/item/"'
    )
    primary = container_item("Primary", "")
    gain_map = container_item("GainMap", f' Item:Length="{gain_bytes}"')
    directory = f"<Container:Directory><rdf:Seq>{primary}{gain_map}</rdf:Seq></Container:Directory>"
    return f"{XMP_HEAD}{names}>{directory}{XMP_TAIL}"


def container_item(meaning: str, length: str) -> str:
    """One picture of the file in XMP."""
    item = f'<Container:Item Item:Semantic="{meaning}" Item:Mime="image/jpeg"{length}/>'
    return f'<rdf:li rdf:parseType="Resource">{item}</rdf:li>'


MPF_HEAD_BYTES = 4 + len(MPF_NAME)  # before the place that offsets count from


def mpf_segment(first_bytes: int, second_bytes: int, second_offset: int) -> bytes:
    """The list of two pictures (CIPA DC-007), a small TIFF directory."""
    entries = struct.pack(">IIIHH", MPF_PRIMARY, first_bytes, 0, 0, 0)
    entries += struct.pack(">IIIHH", 0, second_bytes, second_offset, 0, 0)
    tags = struct.pack(">HHI4s", 0xB000, 7, 4, b"0100")  # the version
    tags += struct.pack(">HHII", 0xB001, 4, 1, 2)  # two pictures
    place = 8 + 2 + 3 * 12 + 4
    tags += struct.pack(">HHII", 0xB002, 7, len(entries), place)
    directory = b"MM\0*" + struct.pack(">IH", 8, 3) + tags + struct.pack(">I", 0)
    return segment(2, MPF_NAME + directory + entries)
