"""A full disk, Ctrl-C and kills: complete files stay, nothing is half-written, and the
same command goes on.
"""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bad_input import (
    WORKING_VERBS,
    Capture,
    call,
    clip,
    commands,
    poses,
    recorded,
    refused,
    snapshot,
)

from hdr_nsff import cli
from hdr_nsff.bench import plan
from hdr_nsff.bench.config import BenchConfig
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import HOST, remove_leftovers, write_npy, writing_to
from hdr_nsff.flow_training import finetune_flow
from hdr_nsff.footage.datasets import held_out
from hdr_nsff.synth import synth
from hdr_nsff.synth.settings import SynthConfig

# A full disk


def full(handle: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.usefixtures("flow_data")
@pytest.mark.parametrize("verb", WORKING_VERBS)
def test_a_full_disk_is_one_sentence(
    verb: str, run_folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    footage, out = clip(tmp_path / "clip", recorded(3)), tmp_path / "out"
    before = snapshot(run_folder)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert "the disk is full" in refused(capsys, *commands(run_folder, footage, out)[verb])
    assert not snapshot(out) and snapshot(run_folder) == before


@pytest.mark.usefixtures("flow_data")
def test_a_disk_that_fills_up_while_a_flow_network_learns_loses_no_checkpoint(
    run_folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, sync = tmp_path / "out", os.fsync
    command = commands(run_folder, tmp_path, out)["finetune-flow"]

    def filled(handle: int) -> None:
        full(handle) if list(out.glob("checkpoints/step_*")) else sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", filled)
        assert "the disk is full" in refused(capsys, *command)
    assert [p.name for p in (out / "checkpoints").iterdir()] == ["step_00000001.safetensors"]
    assert call(*command) == 0 and (out / "weights.safetensors").is_file()


@pytest.mark.parametrize("layout", ["hdr-gopro", "nerfstudio"])
def test_a_full_disk_is_one_sentence_for_every_layout_of_a_scene(
    layout: str, run_folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = snapshot(run_folder.parent)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert "the disk is full" in refused(
            capsys, "export", run_folder, tmp_path / "out", "--layout", layout
        )
    assert not snapshot(tmp_path / "out") and snapshot(run_folder.parent) == before


def test_a_disk_that_fills_up_in_the_middle_of_a_map_is_said_to_be_full(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(InputError, match="the disk is full"), writing_to(tmp_path):
            write_npy(tmp_path / "map.npy", np.zeros(500))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


FAILING = """
import gc, pathlib, sys
import numpy as np
from hdr_nsff.core.io import write_npy


def broken(self, data):
    view = memoryview(data)
    raise OSError(28, "No space left on device")

gc.disable()
pathlib.Path.write_bytes = broken
try:
    write_npy(sys.argv[1], np.zeros(50))
except OSError as error:
    error.itself = error  # a cycle: the traceback is left to the collector
gc.collect()
"""


def test_a_failed_write_of_a_map_does_not_crash_python_later(
    tmp_path: Path,
) -> None:
    path = os.pathsep.join([str(Path(cli.__file__).parents[1]), *sys.path])
    command = [sys.executable, "-c", FAILING, str(tmp_path / "map.npy")]
    assert subprocess.run(command, env=os.environ | {"PYTHONPATH": path}).returncode == 0


# Ctrl-C


@pytest.mark.parametrize("verb", ["prepare", "render", "export", "evaluate", "reexpose"])
def test_ctrl_c_loses_nothing_and_the_same_command_continues(
    verb: str, run_folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    footage, out, sync = clip(tmp_path / "clip"), tmp_path / "out", os.fsync
    command = commands(run_folder, footage, out)[verb]
    if verb == "prepare":
        command += ["--poses", poses(tmp_path / "poses_bounds.npy")]
    calls: list[int] = []

    def interrupted(handle: int) -> None:
        calls.append(handle)
        if len(calls) == 6:
            raise KeyboardInterrupt
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupted)
        assert call(*command) == 130
    error = capsys.readouterr().err
    assert "Traceback" not in error and "the same command continues where it was" in error
    suffixes = {".png", ".exr", ".npy", ".ply"}
    if verb == "evaluate":
        suffixes.remove(".png")  # it always draws its comparisons
    files = [p for p in tmp_path.rglob("*") if p.suffix in suffixes]
    kept = {p: p.stat().st_mtime_ns for p in files}
    assert kept and not list(tmp_path.rglob(".partial-*"))
    assert call(*command) == 0
    assert all(p.stat().st_mtime_ns == kept[p] for p in kept)


def test_ctrl_c_while_the_libraries_load_leaves_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "tyro.py").write_text("raise KeyboardInterrupt\n")
    path = os.pathsep.join([str(tmp_path), str(Path(cli.__file__).parents[1])])
    command = [sys.executable, "-c", "from hdr_nsff.cli import main; main()", "prepare", "a", "b"]
    environment = os.environ | {"PYTHONPATH": path}
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 130 and result.stderr == ""


# Kills

LEFTOVER = f".partial-{HOST}-{2**22 + 1}-00000000-abcd_123.png"  # of no process


@pytest.mark.parametrize(
    ("verb", "folders"),
    [
        ("render", ["out", "out/fixed"]),
        ("export", ["out"]),
        ("evaluate", ["run", "run/evaluation"]),
        ("report", ["out"]),
        ("train", ["out", "out/checkpoints", "out/previews"]),
    ],
)
def test_what_a_killed_process_left_is_removed_by_the_same_command(
    verb: str, folders: list[str], run_folder: Path, tmp_path: Path
) -> None:
    places = {"out": tmp_path / "out", "run": run_folder}
    command = commands(run_folder, clip(tmp_path / "clip", recorded(3)), tmp_path / "out")[verb]
    paths = []
    for name in folders:
        first, _, rest = name.partition("/")
        folder = places[first] / rest
        folder.mkdir(parents=True, exist_ok=True)
        paths.append(folder / LEFTOVER)
        paths[-1].write_bytes(b"half")
    mine = paths[0].with_name(".partial-mine.png")
    mine.write_text("mine")
    call(*command)
    assert not any(path.exists() for path in paths) and mine.read_text() == "mine"


@pytest.mark.parametrize(("name", "works"), [(LEFTOVER, True), (".partial-mine.png", False)])
def test_reexpose_writes_into_a_folder_that_holds_leftovers_of_killed_processes_alone(
    name: str, works: bool, run_folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    command = commands(run_folder, clip(tmp_path / "clip", recorded(3)), out)["reexpose"]
    out.mkdir()
    (out / name).write_bytes(b"half")
    call(*command)
    assert (out / name).exists() != works and (out / "reexpose.json").exists() == works


def claim_of(verb: str, out: Path, scene: Path) -> Callable[[], object]:
    """What a verb does first: it makes the folder `out` its own."""
    match verb:
        case "bench":
            return lambda: plan.claim(plan.make_plan(BenchConfig(out, str(scene), "tiny")))
        case "finetune-flow":
            return lambda: finetune_flow.claim_folder(finetune_flow.FinetuneConfig(out))
        case "synth":
            return lambda: synth.claim(SynthConfig("lamp", out))
    return lambda: held_out.claim_folder(out, "a" * 64)


@pytest.mark.parametrize("verb", ["bench", "finetune-flow", "synth", "prepare"])
def test_a_verb_that_was_killed_while_it_claimed_its_folder_claims_it_again(
    verb: str, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    claim, replace = claim_of(verb, out, toy_folder), os.replace

    def killed(source: Path, target: Path) -> None:
        replace(source, Path(target).parent / LEFTOVER)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            claim()
    assert [path.name for path in out.rglob("*") if path.is_file()] == [LEFTOVER]
    remove_leftovers.cache_clear()  # as in another process
    claim()
    assert [path.suffix for path in out.rglob("*") if path.is_file()] == [".json"]
