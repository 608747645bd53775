"""Flow made by other tools: two layouts of a folder, and a sentence for bad files."""

from pathlib import Path

import numpy as np
import pytest
from mutations import check_reader

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import write_npy
from hdr_nsff.footage.flow_files import read_flow_files

H, W = 64, 96


def constant(dx: float, dy: float) -> np.ndarray:
    """A flow (H, W, 2) that is the same everywhere."""
    return np.broadcast_to(np.float32([dx, dy]), (H, W, 2)).copy()


def test_a_folder_of_maps_is_checked_against_its_reverse(tmp_path):
    """Column 38 lands on column 40, where the reverse disagrees."""
    left = np.arange(W)[:, None] < 40
    write_npy(tmp_path / "00004_00005.npy", constant(2, 0))
    write_npy(tmp_path / "00005_00004.npy", np.where(left, constant(-2, 0), constant(0, 0)))
    found, valid = read_flow_files(tmp_path, [(4, 5)], (H, W))
    assert np.allclose(found[0], [2, 0])
    assert valid[0, :, :37].all() and not valid[0, :, 39:].any()


def test_a_folder_in_the_public_layout_is_read(tmp_path):
    mask = np.zeros((H, W))
    mask[:5] = 1
    np.savez(tmp_path / "00007_fwd.npz", flow=constant(1, 2), mask=mask)
    np.savez(tmp_path / "00008_bwd.npz", flow=constant(-1, -2), mask=mask)
    found, valid = read_flow_files(tmp_path, [(7, 8), (8, 7)], (H, W))
    assert np.allclose(found[0], [1, 2]) and np.allclose(found[1], [-1, -2])
    assert valid[:, :5].all() and not valid[:, 5:].any()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda d: None, "no flow from frame 0 to frame 1"),
        (lambda d: write_npy(d / "00000_00001.npy", np.zeros((H, W - 1, 2))), "shape"),
        (lambda d: write_npy(d / "00000_00001.npy", np.full((H, W, 2), np.nan)), "NaN"),
        (lambda d: write_npy(d / "00000_00001.npy", constant(1e30, 0)), "more than 1e"),
        (lambda d: (d / "00000_00001.npy").write_text("no array"), "not a readable"),
        (lambda d: (d / "00000_fwd.npz").write_text("no archive"), "not a flow file"),
        (
            lambda d: (
                write_npy(d / "00000_00001.npy", constant(0, 0)),
                write_png(d / "00000_00001_valid.png", np.ones((3, 3), bool)),
            ),
            "its mask",
        ),
    ],
)
def test_a_bad_flow_folder_is_one_sentence(tmp_path, make, words):
    make(tmp_path)
    with pytest.raises(InputError, match=words):
        read_flow_files(tmp_path, [(0, 1)], (H, W))


def test_a_missing_flow_folder_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_flow_files(tmp_path / "nowhere", [(0, 1)], (H, W))


# Damaged files


SIZE = (6, 8)
FLOW = np.random.default_rng(0).normal(size=(*SIZE, 2)).astype(np.float32)


def write_folder(folder: Path) -> Path:
    """Flow between frames 0 and 1, with a mask beside it, and between 1 and 2."""
    folder.mkdir()
    np.save(folder / "00000_00001.npy", FLOW)
    write_png(folder / "00000_00001_valid.png", np.ones(SIZE, bool))
    np.savez_compressed(folder / "00001_fwd.npz", flow=FLOW, mask=np.ones(SIZE, np.float32))
    return folder


@pytest.mark.parametrize("name", ["00000_00001.npy", "00000_00001_valid.png", "00001_fwd.npz"])
def test_damaged_flow_is_read_or_refused(tmp_path: Path, name: str) -> None:
    folder = write_folder(tmp_path / "flow")
    check_reader(folder / name, lambda: read_flow_files(folder, [(0, 1), (1, 2)], SIZE), 200)


def test_flow_of_text_is_one_sentence(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "flow")
    np.save(folder / "00000_00001.npy", np.full((*SIZE, 2), "left"))
    with pytest.raises(InputError, match="holds <U4, not numbers"):
        read_flow_files(folder, [(0, 1)], SIZE)
