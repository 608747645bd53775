"""The size of a picture is read from its header, in every format."""

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.core.picture_size import MAX_MEGAPIXELS, check_size, encoded_size


def encode(suffix: str, dtype: type = np.uint8, channels: int = 3) -> bytes:
    """A picture of 7 x 5 pixels."""
    return cv2.imencode(suffix, np.zeros((5, 7, channels), dtype))[1].tobytes()


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_png_and_tiff(suffix: str, dtype: type, channels: int) -> None:
    assert encoded_size(encode(suffix, dtype, channels)) == (7, 5)


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_jpeg_and_webp(suffix: str) -> None:
    assert encoded_size(encode(suffix)) == (7, 5)


@pytest.mark.parametrize("options", [{"lossless": True}, {"exif": b"Exif\0\0"}, {"quality": 5}])
def test_all_kinds_of_webp(options: dict[str, object]) -> None:
    file = io.BytesIO()
    Image.new("RGB", (300, 200)).save(file, "webp", **options)
    assert encoded_size(file.getvalue()) == (300, 200)


@pytest.mark.parametrize("options", [{"progressive": True}, {"exif": b"Exif\0\0" + bytes(400)}])
def test_all_kinds_of_jpeg(options: dict[str, object]) -> None:
    file = io.BytesIO()
    Image.new("RGB", (300, 200)).save(file, "jpeg", **options)
    assert encoded_size(file.getvalue()) == (300, 200)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("bigtiff", [False, True])
def test_all_kinds_of_tiff(order: str, bigtiff: bool) -> None:
    tifffile = pytest.importorskip("tifffile")
    file = io.BytesIO()
    tifffile.imwrite(file, np.zeros((200, 300), np.uint16), byteorder=order, bigtiff=bigtiff)
    assert encoded_size(file.getvalue()) == (300, 200)


NOWHERE = b"II+\0\x08\0\0\0" + b"\xff" * 8  # a BigTIFF whose directory is beyond all files


@pytest.mark.parametrize(
    "data", [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"II*\0", NOWHERE, b"text"]
)
def test_no_header_has_no_size(data: bytes) -> None:
    assert encoded_size(data) is None


def test_the_limit_is_inclusive() -> None:
    check_size("a.png", MAX_MEGAPIXELS * 1000, 1000)
    with pytest.raises(InputError, match=r"a\.png: .* more than the 200 megapixels"):
        check_size("a.png", MAX_MEGAPIXELS * 1000, 1001)


def test_a_huge_tiff_is_refused_by_its_header(tmp_path: Path) -> None:
    data = encode(".tif", np.uint16)
    tag = struct.pack("<HHI", 256, 4, 1)  # the width, one 32-bit number
    place = data.find(struct.pack("<H", 256), struct.unpack("<I", data[4:8])[0])
    (tmp_path / "a.tif").write_bytes(
        data[:place] + tag + struct.pack("<I", 10**8) + data[place + 12 :]
    )
    with pytest.raises(InputError, match="100000000x5 pixels"):
        read_image(tmp_path / "a.tif")


def test_a_huge_exr_is_refused_by_its_header(tmp_path: Path) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.zeros((5, 7, 3), np.float32)}) as file:
        file.write(str(tmp_path / "a.exr"))
    data = (tmp_path / "a.exr").read_bytes()
    window = struct.pack("<4i", 0, 0, 6, 4)
    assert data.count(window) == 2  # data window and display window
    (tmp_path / "a.exr").write_bytes(data.replace(window, struct.pack("<4i", 0, 0, 49999, 4999)))
    with pytest.raises(InputError, match="50000x5000 pixels"):
        read_exr(tmp_path / "a.exr")
