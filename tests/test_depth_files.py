"""Depth of other programs: a damaged file is read or refused in one sentence."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from mutations import check_reader

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.footage.depth_files import DepthKind, read_depth_files

DEPTH = np.random.default_rng(0).uniform(1, 5, (6, 8)).astype(np.float32)


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".png"])
def test_damaged_depth_is_read_or_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"depth{suffix}"
    match suffix:
        case ".npy":
            np.save(path, DEPTH)
        case ".exr":
            write_exr(path, {"Z": DEPTH})
        case _:
            write_png(path, DEPTH / 5, bits=16)
    check_reader(path, lambda: read_depth_files([path], "metric", DEPTH.shape), 100)


def test_a_depth_too_small_for_a_disparity_is_no_measurement(tmp_path: Path) -> None:
    path = tmp_path / "depth.npy"
    np.save(path, np.where(DEPTH > 3, DEPTH, 1e-30))
    disparity, confidence = read_depth_files([path], "metric", DEPTH.shape)
    assert disparity.max() < 1 / 3 and np.array_equal(confidence[0] > 0, DEPTH > 3)


@pytest.mark.parametrize("channels", [1, 3])
def test_metric_depth_in_16_bits_is_in_millimeters(tmp_path: Path, channels: int) -> None:
    path = tmp_path / "depth.png"
    codes = np.full((6, 8), 8000, np.uint16)
    codes[0, 0] = 0  # not measured
    cv2.imwrite(str(path), np.repeat(codes[..., None], channels, -1))
    disparity, confidence = read_depth_files([path], "metric", codes.shape)
    assert np.allclose(disparity, 1 / 8)
    assert np.array_equal(confidence[0] > 0, codes > 0)


@pytest.mark.parametrize("kind", ["disparity", "relative"])
def test_other_maps_in_a_png_are_shares_of_white(tmp_path: Path, kind: DepthKind) -> None:
    for bits in (8, 16):
        path = tmp_path / f"{bits}.png"
        write_png(path, DEPTH / 5, bits=bits)
        disparity, confidence = read_depth_files([path], kind, DEPTH.shape)
        assert np.abs(disparity[0] - DEPTH / 5).max() < 0.6 / 2**bits
        assert (confidence == 1).all()


def test_metric_depth_in_8_bits_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "depth.png"
    write_png(path, DEPTH / 5)
    with pytest.raises(InputError, match="8 bits hold no metric depth; write millimeters in 16"):
        read_depth_files([path], "metric", DEPTH.shape)


def test_disparity_below_0_is_unknown(tmp_path: Path) -> None:
    path = tmp_path / "disparity.npy"
    values = np.full((6, 8), 0.5, np.float32)
    values[:, :2] = -1
    values[:, 6:] = 0  # far away
    np.save(path, values)
    disparity, confidence = read_depth_files([path], "disparity", values.shape)
    assert np.array_equal(confidence[0], (values >= 0).astype(np.float32))
    assert np.array_equal(disparity[0, :, 2:], values[:, 2:])
    assert np.allclose(disparity[0, :, :2], 0.5)  # as around it
    assert np.array_equal(read_depth_files([path], "relative", values.shape)[0][0], values)
