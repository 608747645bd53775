"""Atomic writes, what a killed process leaves of them, and the sentences for errors of
the disk.
"""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from mutations import check_reader

from hdr_nsff import core
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import (
    FOREIGN_AGE_S,
    HOST,
    TOKEN,
    atomic,
    holds_nothing,
    is_leftover,
    read_json,
    read_npy,
    write_half,
    write_json,
    write_npy,
    write_text,
    writing_to,
)

DEAD = 2**22 + 1  # above the largest process number of Linux


def leftover(folder: Path, host: str = HOST, pid: int = DEAD, token: str = "0" * 8) -> Path:
    """A temporary file as `atomic` calls it."""
    path = folder / f".partial-{host}-{pid}-{token}-abcd_123.png"
    path.write_bytes(b"half")
    return path


def test_a_folder_with_unfinished_files_of_killed_processes_alone_holds_nothing(
    tmp_path: Path,
) -> None:
    (tmp_path / "exact").mkdir()
    leftover(tmp_path), leftover(tmp_path / "exact")
    assert holds_nothing(tmp_path) and not holds_nothing(leftover(tmp_path))
    (tmp_path / "exact/notes.txt").write_text("mine")
    assert not holds_nothing(tmp_path) and not holds_nothing(tmp_path / "missing")


# Atomic writes


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(RuntimeError), atomic(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
        raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


KILLED = """
import os, signal, sys
from hdr_nsff.core.io import atomic
with atomic(sys.argv[1]) as temporary:
    temporary.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_is_removed_by_the_next_that_writes(tmp_path: Path) -> None:
    source = str(Path(core.__file__).parents[2])
    command = [sys.executable, "-c", KILLED, str(tmp_path / "a.txt")]
    killed = subprocess.run(command, env=os.environ | {"PYTHONPATH": source})
    assert killed.returncode == -signal.SIGKILL
    assert [is_leftover(p) for p in tmp_path.iterdir()] == [True]
    write_text(tmp_path / "b.txt", "whole")
    assert [p.name for p in tmp_path.iterdir()] == ["b.txt"]


def test_a_leftover_is_a_file_of_a_process_that_has_ended(tmp_path: Path) -> None:
    assert is_leftover(leftover(tmp_path))
    assert not is_leftover(leftover(tmp_path, pid=os.getppid()))
    assert not is_leftover(leftover(tmp_path, pid=os.getpid(), token=TOKEN))
    assert is_leftover(leftover(tmp_path, pid=os.getpid()))  # the number was given again


def test_a_leftover_of_another_machine_is_kept_for_a_day(tmp_path: Path) -> None:
    path = leftover(tmp_path, host="0" * 8)
    assert not is_leftover(path)
    yesterday = time.time() - FOREIGN_AGE_S - 1
    os.utime(path, (yesterday, yesterday))
    assert is_leftover(path)


@pytest.mark.parametrize("name", [".partial-notes.txt", ".partial-12-ab.png", "partial.png"])
def test_a_file_that_the_user_named_so_stays(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine")
    write_text(tmp_path / "a.txt", "whole")
    assert (tmp_path / name).read_text() == "mine"


def test_leftovers_in_a_subfolder_stay_until_it_is_written_to(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    path = leftover(tmp_path / "below")
    write_text(tmp_path / "a.txt", "whole")
    assert path.exists()
    write_text(tmp_path / "below/a.txt", "whole")
    assert not path.exists()


# Errors of the disk


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "the disk is full"),
        (errno.EACCES, "check its permissions"),
        (errno.ENAMETOOLONG, "correct the path"),
        (errno.ENOENT, "no other hdr-nsff works there"),
        (errno.ENOTEMPTY, "no other hdr-nsff works there"),
        (errno.EIO, "check the disk"),
    ],
)
def test_errors_of_the_disk_are_one_sentence_that_names_the_place(code: int, words: str) -> None:
    with pytest.raises(InputError, match=words) as refusal, writing_to("out"):
        raise OSError(code, os.strerror(code))
    assert str(refusal.value).startswith("out: ")
    with pytest.raises(InputError, match=r"^other/file: "), writing_to("out"):
        raise OSError(code, os.strerror(code), "other/file")


@pytest.mark.parametrize(
    "allocate", [lambda: np.zeros(2**50), lambda: torch.zeros(2**50), lambda: bytearray(2**62)]
)
def test_too_little_memory_is_one_sentence(allocate: Callable[[], object], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the memory does not suffice"), writing_to(tmp_path):
        allocate()


def test_an_error_in_a_temporary_file_names_its_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"^{tmp_path}: "), writing_to("out"):
        raise OSError(errno.EIO, "Input/output error", str(leftover(tmp_path)))


def test_errors_of_other_causes_pass(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), writing_to(tmp_path):
        print(1 / 0)


# JSON and npy


def test_json_and_npy_are_read_back(tmp_path: Path) -> None:
    value = {"name": "Größe", "numbers": [1, 2.5, None]}
    write_json(tmp_path / "a.json", value)
    assert read_json(tmp_path / "a.json") == value
    array = np.arange(6, dtype=np.float16).reshape(2, 3)
    write_npy(tmp_path / "a.npy", array)
    assert np.array_equal(read_npy(tmp_path / "a.npy"), array)


def test_json_that_is_none_is_a_value_error(tmp_path: Path) -> None:
    for text in ("{", "[" * 100_000, ""):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(ValueError):
            read_json(tmp_path / "a.json")
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(ValueError, match="no ordinary file"):
        read_json(tmp_path / "pipe.json")


def test_arrays_that_are_missing_or_damaged_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="missing; run `hdr-nsff prepare` again"):
        read_npy(tmp_path / "none.npy")
    os.mkfifo(tmp_path / "pipe.npy")
    with pytest.raises(InputError, match="missing"):
        read_npy(tmp_path / "pipe.npy")
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(InputError, match=r"not a readable \.npy array"):
        read_npy(tmp_path / "a.npy")


def test_values_beyond_half_precision_are_kept(tmp_path: Path) -> None:
    for largest, dtype in ((100, np.float16), (70_000, np.float32)):
        write_half(tmp_path / "a.npy", np.array([1.0, largest]))
        found = read_npy(tmp_path / "a.npy")
        assert found.dtype == dtype and found[1] == largest


def test_damaged_arrays_are_read_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    write_npy(path, np.zeros(3))  # little but a header
    check_reader(path, lambda: np.array(read_npy(path)), 300)
