"""Arrays of other programs: every file is read as numbers or refused in a sentence."""

import io
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from mutations import check_reader

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage import arrays
from hdr_nsff.footage.arrays import read_array, read_arrays


def test_numbers_are_returned_in_the_requested_type(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[1, 2], [3, 4]], np.int16))
    found = read_array(tmp_path / "a.npy", np.float64)
    assert found.dtype == np.float64
    assert found.tolist() == [[1, 2], [3, 4]]


def test_numbers_too_large_for_single_precision_become_infinite(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([1e300, 1.0]))
    assert read_array(tmp_path / "a.npy").tolist() == [np.inf, 1]


def claim(path: Path, shape: tuple[int, ...]) -> None:
    """A `.npy` of four numbers whose header claims `shape`."""
    header = io.BytesIO()
    fields = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, fields)
    path.write_bytes(header.getvalue() + bytes(32))


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda p: claim(p, (10**6, 10**6)), "not a readable .npy"),
        (lambda p: p.write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'for"), "not a readable"),
        (lambda p: p.write_bytes(b"\x93NUMPY\x01\x00\x10\x00{'descr': ('<f8'"), "not a readable"),
        (lambda p: np.save(p, np.array(["one", "two"])), "holds <U3, not numbers"),
        (lambda p: np.save(p, np.array([None]), allow_pickle=True), "not a readable"),
        (lambda p: p.write_bytes(b""), "not a readable"),
        (lambda p: p.unlink(missing_ok=True), "missing"),
        (lambda p: (p.unlink(missing_ok=True), os.mkfifo(p)), "missing"),
    ],
)
def test_a_file_without_numbers_is_one_sentence(tmp_path: Path, write, words: str) -> None:
    write(tmp_path / "a.npy")
    with pytest.raises(InputError, match=f"a.npy: {words}"):
        read_array(tmp_path / "a.npy")


def test_an_archive_needs_all_of_its_arrays(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", flow=np.ones(3))
    (flow,) = read_arrays(tmp_path / "a.npz", ("flow",), "flow file")
    assert flow.tolist() == [1, 1, 1]
    with pytest.raises(InputError, match="not a flow file with `flow` and `mask`"):
        read_arrays(tmp_path / "a.npz", ("flow", "mask"), "flow file")


def test_an_archive_that_unpacks_to_too_much_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrays, "MAX_UNPACKED", 1000)
    np.savez_compressed(tmp_path / "a.npz", flow=np.zeros(1000))
    with pytest.raises(InputError, match=r"flow\.npy unpacks to"):
        read_arrays(tmp_path / "a.npz", ("flow",), "flow file")


def test_an_archive_that_claims_more_than_it_holds(tmp_path: Path) -> None:
    claim(tmp_path / "flow.npy", (10**6, 10**6))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "flow.npy", "flow.npy")
    with pytest.raises(InputError, match="not a flow file"):
        read_arrays(tmp_path / "a.npz", ("flow",), "flow file")


@pytest.mark.parametrize("seed", range(3))
def test_damaged_arrays_are_read_or_refused(tmp_path: Path, seed: int) -> None:
    values = np.random.default_rng(0).normal(size=(6, 8, 2))
    np.save(tmp_path / "a.npy", values)
    np.savez_compressed(tmp_path / "a.npz", flow=values)
    check_reader(tmp_path / "a.npy", lambda: read_array(tmp_path / "a.npy"), 100, seed)
    check_reader(
        tmp_path / "a.npz",
        lambda: read_arrays(tmp_path / "a.npz", ("flow",), "flow file"),
        100,
        seed,
    )
