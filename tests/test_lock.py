"""Two processes never write one output at once; a killed one leaves no lock."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hdr_nsff.core import lock
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.lock import lock_output

HOLD = """
import sys, time
from hdr_nsff.core.lock import lock_output
with lock_output(sys.argv[1]):
    print("locked", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def holder(output: Path, seconds: float = 60.0) -> subprocess.Popen[str]:
    """A process that has locked `output`."""
    command = [sys.executable, "-c", HOLD, str(output), str(seconds)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "locked\n"
    return process


def test_a_second_process_is_refused_and_learns_who_works_there(tmp_path: Path) -> None:
    first = holder(tmp_path / "out")
    with pytest.raises(InputError, match=r"another hdr-nsff works in .*out") as refusal:
        lock_output(tmp_path / "out").__enter__()
    assert f"process {first.pid} on " in str(refusal.value)
    first.kill()
    first.wait()


def test_outputs_beside_each_other_do_not_disturb(tmp_path: Path) -> None:
    first = holder(tmp_path / "out")
    with lock_output(tmp_path / "other"), lock_output(tmp_path):
        assert first.poll() is None
    first.kill()
    first.wait()


def test_a_killed_process_does_not_block(tmp_path: Path) -> None:
    first = holder(tmp_path / "out")
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert [p.name for p in tmp_path.iterdir()] == [".out.lock"]  # it could not tidy up
    with lock_output(tmp_path / "out"):
        pass
    assert not list(tmp_path.iterdir())


def test_one_that_waits_gets_its_turn(tmp_path: Path) -> None:
    first = holder(tmp_path / "out", seconds=1.0)
    with lock_output(tmp_path / "out", wait=True):
        assert first.wait(timeout=10) == 0


def test_locks_nest_in_one_process_and_the_outermost_one_counts(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("out")
    with lock_output(tmp_path / "out"):
        with lock_output(tmp_path / "out"), lock_output(tmp_path / "link"):
            pass
        assert (tmp_path / ".out.lock").is_file()


def test_an_output_that_was_never_written_leaves_no_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="bad"), lock_output(tmp_path / "a/b/out"):
        assert (tmp_path / "a/b/.out.lock").is_file()
        raise InputError("bad")
    assert not list(tmp_path.iterdir())


def test_other_processes_of_torchrun_share_the_lock_of_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = holder(tmp_path / "out")
    monkeypatch.setenv("RANK", "1")
    with lock_output(tmp_path / "out"):
        assert first.poll() is None  # the first still holds it
        first.kill()
    first.wait()


def test_beside_an_unwritable_place_the_lock_is_in_the_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(lock.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    with lock_output(tmp_path / "file/out"):
        assert len(list((tmp_path / "temporary").iterdir())) == 1


def test_work_continues_on_a_file_system_without_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(file: object) -> None:
        raise OSError(os.strerror(38), 38)

    monkeypatch.setattr(lock, "take_lock", no_locks)
    entered = False
    with lock_output(tmp_path / "out"):
        entered = True
    assert entered


APPEND = """
import sys, time
from hdr_nsff.core import lock
lock.POLL_SECONDS = 0.001
for _ in range(20):
    with lock.lock_output(sys.argv[1], wait=True), open(sys.argv[1], "a+") as file:
        file.seek(0)
        before = file.read()
        time.sleep(0.001)
        file.truncate(0)
        file.write(before + "x")
"""


def test_of_many_processes_at_once_one_works_at_a_time(tmp_path: Path) -> None:
    command = [sys.executable, "-c", APPEND, str(tmp_path / "file")]
    processes = [subprocess.Popen(command) for _ in range(4)]
    assert [p.wait(timeout=60) for p in processes] == [0] * 4
    assert (tmp_path / "file").read_text() == "x" * 80


def test_the_same_command_twice_at_once_works_once(toy_folder: Path, tmp_path: Path) -> None:
    arguments = ["train", "tiny", "--scene", str(toy_folder), "--out", str(tmp_path / "run")]
    command = [sys.executable, "-c", "from hdr_nsff.cli import main; main()", *arguments]
    first = subprocess.Popen([*command, "--steps", "100000", "--checkpoint-seconds", "0"])
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("run/checkpoints/*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    second = subprocess.run([*command, "--steps", "100000"], capture_output=True, text=True)
    first.kill()
    first.wait()
    assert second.returncode == 2
    assert f"another hdr-nsff works in {tmp_path / 'run'}" in second.stderr
