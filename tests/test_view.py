"""The verb `view`, and `train --view`."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any, ClassVar

import pytest
from bad_input import call, training
from test_process import outlives_its_parent

from hdr_nsff import view as module
from hdr_nsff.core.errors import InputError
from hdr_nsff.view import ViewConfig, view


class FakeProcess:
    """Remembers the commands that would have been started."""

    commands: ClassVar[list[list[str]]] = []
    ended = 0

    def __init__(self, command: list[str], **options: Any) -> None:
        self.commands.append(command)

    def terminate(self) -> None:
        FakeProcess.ended += 1

    def wait(self) -> int:
        return 0


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a run folder"):
        view(ViewConfig(tmp_path, browser=False, device="cpu"))


def test_training_can_be_watched(
    toy_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(module.subprocess, "Popen", FakeProcess)
    assert subprocess.Popen is FakeProcess
    assert call(*training(toy_folder, tmp_path / "run", 1), "--view") == 0
    (command,) = FakeProcess.commands
    assert command[4:] == ["view", str(tmp_path / "run"), "--wait", "--device", "cpu"]
    assert FakeProcess.ended == 1
    assert "opens it again" in capsys.readouterr().err


def test_the_viewer_ends_where_training_is_killed(tmp_path: Path) -> None:
    assert not outlives_its_parent(module.VIEWER, "view", str(tmp_path), "--wait")


def test_a_run_that_never_began_is_not_offered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module.subprocess, "Popen", FakeProcess)
    assert call(*training(tmp_path / "none", tmp_path / "run", 1), "--view") == 2
    lines = capsys.readouterr().err
    assert "the viewer has closed" in lines and "opens it again" not in lines


def test_other_verbs_have_no_such_option(tmp_path: Path) -> None:
    assert call("report", tmp_path, "--view") == 2
