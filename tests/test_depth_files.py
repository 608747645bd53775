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
