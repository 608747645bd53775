"""The machine and the program in the records of a benchmark."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
import torch

from hdr_nsff import __version__
from hdr_nsff.bench.machine import commit_of, this_machine


def test_this_machine_has_a_processor_and_the_versions_of_its_libraries() -> None:
    machine = this_machine()
    assert machine.cpu and machine.cores == os.cpu_count()
    assert machine.torch == torch.__version__ and machine.version == __version__


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package in a git checkout of one commit."""
    for role in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{role}_NAME", "somebody")
        monkeypatch.setenv(f"GIT_{role}_EMAIL", "somebody@example.org")
    package = tmp_path / "src/package"
    package.mkdir(parents=True)
    (package / "a.py").write_text("a = 1\n")
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    return package


def test_the_commit_of_a_checkout_is_known_and_changes_are_marked(checkout: Path) -> None:
    commit = commit_of(checkout)
    assert commit is not None and len(commit) == 40
    numbers = checkout.parents[1] / "benchmarks" / "results" / "a.json"
    numbers.parent.mkdir(parents=True)
    numbers.write_text("{}")
    subprocess.run(["git", "-C", str(checkout), "add", str(numbers)], check=True)
    assert commit_of(checkout) == commit  # numbers are no program
    (checkout / "a.py").write_text("a = 2\n")
    assert commit_of(checkout) == f"{commit}-dirty"


def test_a_package_installed_inside_another_checkout_has_no_commit(checkout: Path) -> None:
    installed = checkout.parents[1] / "venv/lib/site-packages/package"
    installed.mkdir(parents=True)
    assert commit_of(installed) is None
