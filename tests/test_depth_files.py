"""Depth of other programs: a damaged file is read or refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest
from mutations import check_reader

from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.footage.depth_files import read_depth_files

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
