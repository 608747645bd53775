"""Ultra HDR JPEGs, read by Pillow, by libultrahdr, and by a decoder written from the
standards that shares no code with the writer.
"""

from __future__ import annotations

import io
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hdr_nsff.core.ultra_hdr import write_ultra_hdr
from hdr_nsff.maths.gain_map import make_gain_map

HEADROOM = 2.3
MAX_ERROR = 0.06  # relative, of light above 0.05: half a step of 8 bits twice, and JPEG


def pictures() -> tuple[np.ndarray, np.ndarray]:
    """An SDR picture (sRGB values) and its HDR light: smooth, colored, up to 4.9."""
    y, x = np.mgrid[:64, :96] / 96
    hdr = np.stack([0.05 + 4.85 * x**2, 0.1 + 2 * x * y + y, 0.05 + 0.8 * (1 - x)], -1)
    sdr = hdr / (1 + hdr)
    return sdr ** (1 / 2.2), hdr


def write(path: Path) -> np.ndarray:
    """A file at `path`; its HDR light."""
    picture, hdr = pictures()
    write_ultra_hdr(path, picture, lambda seen: make_gain_map(linear(seen), hdr, HEADROOM))
    return hdr


def linear(srgb: np.ndarray) -> np.ndarray:
    """Light of sRGB values."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def second_picture(data: bytes) -> bytes:
    """The JPEG that the multi-picture format lists second."""
    with Image.open(io.BytesIO(data)) as image:
        listed = image._getmp()[0xB002]  # type: ignore[attr-defined]
    start = data.index(b"MPF\0") + 4 + listed[1]["DataOffset"]
    assert listed[0]["Size"] == start and start + listed[1]["Size"] == len(data)
    return data[start:]


def metadata(jpeg: bytes) -> dict[str, np.ndarray]:
    """ISO 21496-1 metadata of a gain map."""
    start = jpeg.index(b"urn:iso:std:iso:ts:21496:-1\0") + 28
    assert jpeg[start : start + 5] == b"\0\0\0\0\xc0"  # three channels, colors of the base
    words = jpeg[start + 5 : start + 5 + 4 * (4 + 30)]
    numbers = [np.array(struct.unpack(f">34{kind}", words)) for kind in "iI"]
    values = numbers[0][0::2] / numbers[1][1::2]
    names = ("minimum", "maximum", "gamma", "sdr_offset", "hdr_offset")
    per_channel = values[2:].reshape(3, 5).T
    return {"stops": values[:2], **dict(zip(names, per_channel, strict=True))}


def decode(data: bytes) -> np.ndarray:
    """HDR light by equation 1 of ISO 21496-1."""
    gain_jpeg = second_picture(data)
    known = metadata(gain_jpeg)
    base = np.asarray(Image.open(io.BytesIO(data)), float) / 255
    codes = np.asarray(Image.open(io.BytesIO(gain_jpeg)), float) / 255
    span = known["maximum"] - known["minimum"]
    stops = known["minimum"] + span * codes ** (1 / known["gamma"])
    return (linear(base) + known["sdr_offset"]) * 2**stops - known["hdr_offset"]


def test_an_independent_decoder_gets_the_light_back(tmp_path: Path) -> None:
    hdr = write(tmp_path / "a.jpg")
    found = decode((tmp_path / "a.jpg").read_bytes())
    error = np.abs(found / hdr - 1)
    assert np.median(error) < 0.015 and np.percentile(error, 99) < MAX_ERROR


def test_libultrahdr_gets_the_light_back(tmp_path: Path) -> None:
    imagecodecs = pytest.importorskip("imagecodecs")
    hdr = write(tmp_path / "a.jpg")
    found = imagecodecs.ultrahdr_decode((tmp_path / "a.jpg").read_bytes())[..., :3]
    error = np.abs(found.astype(float) / hdr - 1)
    assert np.median(error) < 0.015 and np.percentile(error, 99) < MAX_ERROR


def test_every_program_sees_the_sdr_picture(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg")
    with Image.open(tmp_path / "a.jpg") as image:
        assert image.format == "JPEG" and image.size == (96, 64)
        assert np.abs(np.asarray(image) / 255 - pictures()[0]).mean() < 0.01


def test_older_readers_find_the_same_numbers_in_xmp(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    gain_jpeg = second_picture(data)
    length = re.search(rb'Item:Semantic="GainMap"[^>]*Item:Length="(\d+)"', data)
    assert length is not None and int(length[1]) == len(gain_jpeg)
    known = metadata(gain_jpeg)
    text = gain_jpeg.decode("latin-1")
    for name, values in (("GainMapMin", "minimum"), ("GainMapMax", "maximum")):
        listed = re.search(rf"<hdrgm:{name}><rdf:Seq>(.*?)</rdf:Seq>", text)
        assert listed is not None
        found = [float(x) for x in re.findall(r"<rdf:li>(.*?)</rdf:li>", listed[1])]
        assert np.allclose(found, known[values], atol=1e-5)
    assert f'hdrgm:HDRCapacityMax="{HEADROOM:.6f}"' in text
    assert known["stops"] == pytest.approx([0, HEADROOM], abs=1e-5)
