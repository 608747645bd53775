"""Arrays of `.npy` files are what numpy wrote, in any number of threads."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hdr_nsff.core.npy import map_npy


@pytest.mark.parametrize(
    "array",
    [
        np.float32(3.5) * np.ones(()),
        np.arange(6, dtype=np.float16).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.array([True, False]),
        np.arange(4, dtype=">u2"),
        np.array(["text"]),
    ],
    ids=["scalar", "half", "fortran", "bool", "big endian", "text"],
)
@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_an_array_is_what_numpy_wrote(tmp_path, array, version):
    path = tmp_path / "a.npy"
    with open(path, "wb") as file:
        np.lib.format.write_array(file, array, version=version)
    read = map_npy(path)
    assert read.dtype == array.dtype
    np.testing.assert_array_equal(read, array)
    assert not read.flags.writeable


@pytest.mark.parametrize(
    "array",
    [np.array([{}], dtype=object), np.zeros(2, [("a", "f4"), ("b", "f4")])],
    ids=["objects", "records"],
)
def test_objects_and_records_are_refused(tmp_path, array):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(ValueError, match="its header is"):
        map_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("kept", range(0, 140, 4))
def test_a_file_that_was_cut_short_is_refused(tmp_path, kept):
    path = tmp_path / "a.npy"
    np.save(path, np.arange(4.0))
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises((ValueError, OSError)):
        map_npy(path)


def test_many_threads_read_at_once(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.arange(4.0))
    switch = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            sums = list(pool.map(lambda _: float(map_npy(path).sum()), range(2000)))
    finally:
        sys.setswitchinterval(switch)
    assert sums == [6.0] * 2000
