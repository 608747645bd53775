"""Images of 8 and 16 bits, masks and pictures of maps, against computed values."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import (
    colorize,
    colorize_flow,
    contact_sheet,
    encode,
    read_image,
    read_mask,
    write_png,
)

RGB = np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)
MASK = np.indices((16, 24))[1] > 10  # the right of the picture
MASK[:5] = False


@pytest.mark.parametrize("bits", [8, 16])
def test_a_png_keeps_rgb_to_half_a_step(bits: int, tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", RGB, bits)
    assert np.abs(read_image(tmp_path / "a.png") - RGB).max() <= 0.5001 / (2**bits - 1)


def test_values_outside_the_recorded_range_are_clipped(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.array([[-1.0, 0.0, 2.0]]))
    assert read_image(tmp_path / "a.png")[0, :, 1].tolist() == [0, 0, 1]


def test_a_mask_is_read_back(tmp_path: Path) -> None:
    mask = RGB[..., 0] > 0.5
    write_png(tmp_path / "a.png", mask)
    assert np.array_equal(read_mask(tmp_path / "a.png"), mask)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_a_mask_of_any_kind_is_read(mode: str, tmp_path: Path) -> None:
    Image.fromarray(np.uint8(255 * MASK)).convert(mode).save(tmp_path / "a.png")
    assert np.array_equal(read_mask(tmp_path / "a.png"), MASK)


def test_a_mask_of_16_bits_is_read(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.uint16(65535 * MASK))
    assert np.array_equal(read_mask(tmp_path / "a.png"), MASK)


def test_a_mask_is_turned_as_its_picture_is(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x112] = 6  # a quarter turn, clockwise
    Image.fromarray(np.uint8(255 * MASK)).save(tmp_path / "a.jpg", exif=exif, quality=95)
    assert np.array_equal(read_mask(tmp_path / "a.jpg"), np.rot90(MASK, -1))


def test_gray_shows_through_transparent_pixels(tmp_path: Path) -> None:
    bgra = np.array([[[0, 0, 255, 255], [0, 0, 255, 0]]], np.uint8)  # red: opaque, transparent
    cv2.imwrite(str(tmp_path / "a.png"), bgra)
    assert read_image(tmp_path / "a.png", over=0.25).tolist() == [[[1, 0, 0], [0.25] * 3]]
    assert read_image(tmp_path / "a.png").tolist() == [[[1, 0, 0], [1, 0, 0]]]


def test_images_that_are_missing_cut_short_or_damaged_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such image"):
        read_image(tmp_path / "none.png")
    for name in ("a.png", "a.jpg"):
        encode(tmp_path / name, (255 * RGB).astype(np.uint8))
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-20])
        with pytest.raises(InputError, match="cut short"):
            read_image(tmp_path / name)
    (tmp_path / "a.tif").write_bytes(b"II*\0 no image")
    with pytest.raises(InputError, match="not a readable image"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("bigtiff", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("alpha", [[], ["unassalpha"]])
def test_colors_of_a_tiff_are_read_as_stored(
    alpha: list[str], dtype: type, bigtiff: bool, order: str, tmp_path: Path
) -> None:
    """OpenCV alone would multiply those of 8 bits by their alpha."""
    tifffile = pytest.importorskip("tifffile")
    top = np.iinfo(dtype).max
    codes = np.random.default_rng(0).integers(0, top, (5, 7, 3 + len(alpha)), dtype)
    options = {"bigtiff": bigtiff, "byteorder": order, "extrasamples": alpha}
    tifffile.imwrite(tmp_path / "a.tif", codes, photometric="rgb", **options)
    assert np.allclose(read_image(tmp_path / "a.tif"), codes[..., :3] / top)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("shape", "kind", "what"),
    [
        ((3, 5, 7), {"photometric": "rgb", "planarconfig": "separate"}, "one plane per channel"),
        ((5, 7), {"photometric": "miniswhite"}, "white is 0"),
        ((5, 7, 2), {"photometric": "minisblack", "planarconfig": "contig"}, "further channels"),
    ],
)
def test_a_tiff_of_16_bits_that_would_be_decoded_wrongly_is_refused(
    shape: tuple[int, ...], kind: dict[str, str], what: str, order: str, tmp_path: Path
) -> None:
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "a.tif", np.ones(shape, np.uint16), byteorder=order, **kind)
    with pytest.raises(InputError, match=rf"a\.tif: .*{what}.*; save it"):
        read_image(tmp_path / "a.tif")


def test_a_tiff_of_8_bits_may_have_planes_or_white_as_0(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    codes = np.random.default_rng(0).integers(0, 255, (3, 5, 7), np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", codes, photometric="rgb", planarconfig="separate")
    assert np.allclose(read_image(tmp_path / "a.tif"), np.moveaxis(codes, 0, -1) / 255)
    tifffile.imwrite(tmp_path / "a.tif", codes[0], photometric="miniswhite")
    assert np.allclose(read_image(tmp_path / "a.tif")[..., 0], 1 - codes[0] / 255)


@pytest.mark.parametrize("progressive", [False, True])
def test_what_follows_the_end_of_a_jpeg_is_no_damage(progressive: bool, tmp_path: Path) -> None:
    """Phones append data of their own, and motion photos a video."""
    image = Image.fromarray((255 * RGB).astype(np.uint8))
    image.save(tmp_path / "a.jpg", progressive=progressive)
    picture = (tmp_path / "a.jpg").read_bytes()
    for trailer in (b"\0" * 100, b"\0\0\0\x18ftypmp42" + b"\xff\xda\xff\x12" * 5000, picture[:-9]):
        (tmp_path / "b.jpg").write_bytes(picture + trailer)
        assert np.array_equal(read_image(tmp_path / "b.jpg"), read_image(tmp_path / "a.jpg"))


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_cut_after_its_thumbnail_is_refused(progressive: bool, tmp_path: Path) -> None:
    """The thumbnail, in a segment before the picture, is a whole JPEG itself."""
    image = Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8))
    image.resize((16, 12)).save(tmp_path / "small.jpg")
    exif = b"Exif\0\0" + (tmp_path / "small.jpg").read_bytes()
    image.save(tmp_path / "a.jpg", exif=exif, progressive=progressive)
    assert read_image(tmp_path / "a.jpg").shape == (64, 96, 3)
    whole = (tmp_path / "a.jpg").read_bytes()
    for end in range(len(exif) + 20, len(whole) - 1, 50):
        (tmp_path / "a.jpg").write_bytes(whole[:end])
        with pytest.raises(InputError, match="cut short"):
            read_image(tmp_path / "a.jpg")


def test_a_contact_sheet_places_its_cells(tmp_path: Path) -> None:
    sheet = contact_sheet([[np.ones((2, 3)), np.zeros((1, 1, 3))], [np.ones((2, 3, 3))]], gap=1)
    assert sheet.shape == (7, 9, 3)  # two rows of 2 and two columns of 3, with gaps of 1
    assert (sheet[1:3, 1:4] == 1).all() and (sheet[4:6, 1:4] == 1).all()
    assert (sheet[1, 5] == 0).all() and sheet[1, 6, 0] == pytest.approx(0.12)


def test_a_map_is_colored_from_low_to_high_and_black_where_it_is_not_valid() -> None:
    valid = np.array([[True, True, False]])
    rgb = colorize(np.array([[0.0, 1.0, 9.0]]), 0.0, 1.0, valid)
    blue, red, black = rgb[0]
    assert blue[2] > blue[0] and red[0] > red[2] and not black.any()


def test_flow_is_colored_by_direction_and_length() -> None:
    rgb = colorize_flow(np.array([[[1.0, 0.0], [0.5, 0.0], [0.0, 0.0]]]), maximum=1.0)
    assert np.allclose(rgb[0], [[1, 0, 0], [1, 0.5, 0.5], [1, 1, 1]])  # red to the right
