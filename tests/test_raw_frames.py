"""Raw photographs (DNG) are linear light, all in the white balance of daylight."""

from pathlib import Path

import numpy as np
import pytest
from test_ingest import all_frames

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.exposure_lists import read_exif_ev
from hdr_nsff.footage.still_frames import read_frame


def write_dng(
    path: Path, level: float, seconds: tuple[int, int] | None = None, green: float = 1.0
) -> None:
    """A small raw photograph of a gray card in daylight, its upper half at half `level`
    of the sensor's range; with its exposure time, and a white balance as shot.
    """
    tifffile = pytest.importorskip("tifffile")
    # XYZ to the camera's own colors; LibRaw's gain of green is not 1
    matrix = (1.0405, -0.3755, -0.1270, -0.5461, 1.3787, 0.1793, -0.1040, 0.2015, 0.6785)
    gray = np.reshape(matrix, (3, 3)) @ (0.9505, 1, 1.089)
    r, g, b = gray / gray.max()
    raw = np.tile([[r, g], [g, b]], (32, 48)) * level * 65535
    raw[:32] /= 2

    def ratios(values: tuple[float, ...]) -> tuple[int, ...]:
        return tuple(n for v in values for n in (round(v * 10000), 10000))

    tags = [
        (50706, "B", 4, (1, 4, 0, 0)),  # DNG version
        (50708, "s", 5, "Test"),  # camera
        (33421, "H", 2, (2, 2)),  # a Bayer pattern ...
        (33422, "B", 4, (0, 1, 1, 2)),  # ... of red green / green blue
        (50721, "2i", 9, ratios(matrix)),
        (50728, "2I", 3, ratios((1, green, 1))),  # neutral as shot
        (50778, "H", 1, 21),  # under daylight
        (50717, "H", 1, 65535),  # white level
    ]
    if seconds is not None:
        tags += [(33434, "2I", 1, seconds), (34855, "H", 1, 400), (33437, "2I", 1, (28, 10))]
    tifffile.imwrite(path, np.uint16(raw), photometric=32803, extratags=[(*t, True) for t in tags])


def test_raw_photographs_are_linear_and_share_a_white_balance(tmp_path):
    pytest.importorskip("rawpy")
    for i, level in enumerate((0.1, 0.4)):
        write_dng(tmp_path / f"{i}.dng", level)
    dark, bright = (f.rgb[48, 48] ** 2.2 for f in all_frames(tmp_path))
    assert np.allclose(bright / dark, 4, rtol=0.01)
    half = all_frames(tmp_path)[1].rgb[16, 48] ** 2.2
    assert np.allclose(bright / half, 2, rtol=0.01)


def test_a_gray_card_in_daylight_is_gray_in_a_raw_photograph(tmp_path):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.dng", 0.4)
    card = read_frame(tmp_path / "a.dng")[40:56, 8:-8]
    assert np.allclose(card, 0.4, atol=0.001)


def test_raw_photographs_are_scaled_by_white_and_not_by_their_brightest_pixel(tmp_path):
    pytest.importorskip("rawpy")
    light = []
    for level in (0.5, 0.76, 0.9):
        write_dng(tmp_path / f"{level}.dng", level)
        light.append(read_frame(tmp_path / f"{level}.dng")[16, 48] / level)
    assert np.allclose(light, light[0], rtol=0.01)


def test_the_tags_of_a_raw_photograph_are_its_exposure(tmp_path):
    write_dng(tmp_path / "a.dng", 0.1, (1, 250))
    expected = np.log2(1 / 250 * 400 / 100 / 2.8**2)
    assert read_exif_ev(tmp_path / "a.dng") == pytest.approx(expected)


def test_the_white_balance_as_shot_does_not_color_raw_frames(tmp_path):
    pytest.importorskip("rawpy")
    for i, green in enumerate((1.0, 0.5)):
        write_dng(tmp_path / f"{i}.dng", 0.2, green=green)
    first, second = (f.rgb for f in all_frames(tmp_path))
    assert np.array_equal(first, second)


def test_a_broken_raw_photograph_is_named(tmp_path):
    pytest.importorskip("rawpy")
    (tmp_path / "a.dng").write_bytes(b"II*\x00 not a photograph")
    with pytest.raises(InputError, match=r"a.dng: not a readable DNG"):
        all_frames(tmp_path)
