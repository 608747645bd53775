"""Flow of other programs: a damaged file is read or refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest
from mutations import check_reader

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_png
from hdr_nsff.footage.flow_files import read_flow

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
    check_reader(folder / name, lambda: read_flow(folder, [(0, 1), (1, 2)], SIZE), 200)


def test_flow_of_text_is_one_sentence(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "flow")
    np.save(folder / "00000_00001.npy", np.full((*SIZE, 2), "left"))
    with pytest.raises(InputError, match="holds <U4, not numbers"):
        read_flow(folder, [(0, 1)], SIZE)
