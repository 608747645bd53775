"""OpenEXR: linear values of any range are read back as they were written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr, write_exr

RGB = np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)


def test_radiance_is_kept_to_half_precision_and_depth_to_single(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"RGB": 100 * RGB, "Z": RGB[..., 0]})
    seen = read_exr(tmp_path / "a.exr")
    assert np.allclose(seen["RGB"], 100 * RGB, rtol=2**-11)
    assert np.array_equal(seen["Z"], RGB[..., 0])


def test_radiance_beyond_half_precision_is_kept(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"RGB": 1e6 * RGB})
    assert np.array_equal(read_exr(tmp_path / "a.exr")["RGB"], np.float32(1e6) * RGB)


def test_arrays_that_are_not_contiguous_are_written_correctly(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"RGB": RGB[:, ::-1]}, half=False)
    assert np.array_equal(read_exr(tmp_path / "a.exr")["RGB"], RGB[:, ::-1])


def test_nan_is_neither_written_nor_read(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="NaN"):
        write_exr(tmp_path / "a.exr", {"RGB": RGB * np.nan})
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": RGB[..., 0] * np.float32(np.nan)}) as file:
        file.write(str(tmp_path / "nan.exr"))
    with pytest.raises(InputError, match="channel Z holds NaN or Inf"):
        read_exr(tmp_path / "nan.exr")


def test_files_that_are_missing_or_cut_short_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_exr(tmp_path / "none.exr")
    write_exr(tmp_path / "a.exr", {"RGB": RGB})
    (tmp_path / "a.exr").write_bytes((tmp_path / "a.exr").read_bytes()[:-40])
    with pytest.raises(InputError, match="copy it again"):
        read_exr(tmp_path / "a.exr")


def test_pixels_that_are_not_square_are_refused(tmp_path: Path) -> None:
    picture = {"RGB": np.ones((4, 6, 3), np.float32)}
    write_exr(tmp_path / "a.exr", picture, {"pixelAspectRatio": 2.0})
    with pytest.raises(InputError, match=r"a\.exr: pixels 2 times as wide as high"):
        read_exr(tmp_path / "a.exr")


def test_nothing_is_printed_of_damaged_pixels(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, {"RGB": np.tile(RGB, (9, 9, 1))})
    data = path.read_bytes()
    path.write_bytes(data[:-40] + b"\xff" * 40)  # OpenEXR warns of what it cannot decode
    with pytest.raises(InputError, match="damaged"):
        read_exr(path)
    assert capfd.readouterr() == ("", "")
