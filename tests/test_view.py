"""The verb `view`, and `train --view`."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any, ClassVar

import pytest
from bad_input import call, training
from test_process import outlives_its_parent

from hdr_nsff import view as module
from hdr_nsff.core.errors import InputError
from hdr_nsff.rendering.served_run import newest_checkpoint
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.view import ViewConfig, view, watched
from hdr_nsff.viewer.page_file import ENTRY, FOLDER


class FakeProcess:
    """Remembers the commands that would have been started."""

    commands: ClassVar[list[list[str]]] = []
    ended = 0

    def __init__(self, command: list[str], **options: Any) -> None:
        self.commands.append(command)

    def terminate(self) -> None:
        FakeProcess.ended += 1

    def wait(self, timeout: float | None = None) -> int:
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


@pytest.mark.parametrize(
    ("options", "seconds"),
    [
        ([], 15),
        (["--checkpoint-seconds", 40], 40),
        (["--checkpoint_seconds=60"], 60),
        (["--set", "checkpoint_seconds=7"], 7),
    ],
)
def test_a_run_that_is_watched_saves_often_unless_told_otherwise(
    toy_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: list[object],
    seconds: float,
) -> None:
    monkeypatch.setattr(module.subprocess, "Popen", FakeProcess)
    assert call(*training(toy_folder, tmp_path / "run", 1), "--view", *options) == 0
    stored = json.loads((tmp_path / "run/config.json").read_text())
    assert stored["checkpoint_seconds"] == seconds


def test_checkpoints_that_come_faster_stay_as_they_are() -> None:
    config = replace(PRESETS["splat"], checkpoint_seconds=4.0)
    assert watched(config, []) == config


def test_a_run_goes_on_with_and_without_the_viewer(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module.subprocess, "Popen", FakeProcess)
    for more in ([], ["--view"], []):
        assert call(*training(toy_folder, tmp_path / "run", 1), *more) == 0


def test_the_viewer_waits_for_two_looks_of_the_page() -> None:
    found = re.search(r"FOLLOW_MILLISECONDS = (\d+);", (FOLDER / ENTRY).read_text())
    assert found is not None
    assert 2 * int(found[1]) <= 1000 * module.END_SECONDS


def test_versions_are_served_while_a_run_trains_and_after_its_end(
    toy_folder: Path, tmp_path: Path
) -> None:
    command = [*training(toy_folder, tmp_path / "run", 1), "--view", "--checkpoint-seconds", 1]
    place = command.index("--steps")
    command[place : place + 2] = ["--minutes", 0.25]
    process = subprocess.Popen(
        [sys.executable, "-c", "from hdr_nsff.cli import main; main()", *map(str, command)],
        env={**os.environ, "COLUMNS": "200", "BROWSER": "true"},  # a browser that shows nothing
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    lines: list[str] = []
    Thread(target=lines.extend, args=(process.stderr,), daemon=True).start()
    versions = []
    while process.poll() is None:
        address = re.search(r"http://127\.0\.0\.1:\d+/", "".join(lines))
        with suppress(OSError):  # not yet, or no longer
            if address is not None:
                answer = urllib.request.urlopen(f"{address[0]}version").read().decode()
                versions += [answer] if answer not in versions else []
        time.sleep(0.2)
    assert process.returncode == 0, lines
    assert versions[-1] == newest_checkpoint(tmp_path / "run")
    assert len(versions) >= 3 and versions == sorted(versions)
    text = "".join(lines)
    assert text.index("training has ended") < text.index("opens it again")
