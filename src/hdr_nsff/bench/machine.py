"""The machine and the program that a run was trained with, for the record."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

import torch

import hdr_nsff
from hdr_nsff import __version__
from hdr_nsff.core.notes import Machine

GIT_TIMEOUT_S = 10
PROGRAM = (".", ":!benchmarks/results", ":!docs")  # pathspecs; numbers and prose are none


def this_machine() -> Machine:
    """The machine that this process runs on."""
    return Machine(
        cpu=cpu_name(),
        cores=os.cpu_count() or 1,
        memory=memory_bytes(),
        system=platform.platform(),
        python=platform.python_version(),
        torch=torch.__version__,
        version=__version__,
        commit=commit_of(Path(hdr_nsff.__file__).parent),
    )


def cpu_name() -> str:
    """The processor's name, or its architecture where the system does not say."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(errors="replace").splitlines() if info.is_file() else []
    for line in lines:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def memory_bytes() -> int | None:
    """The size of the memory; None where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def commit_of(package: Path) -> str | None:
    """The commit of the checkout that `package` is in as src/PACKAGE, with "-dirty"
    where files of the program have changed; None where it is installed elsewhere.
    """
    root = package.parents[1]
    if package.parent.name != "src" or not (root / ".git").exists():
        return None
    try:
        commit = git(root, "rev-parse", "HEAD")
        changes = git(root, "status", "--porcelain", "--untracked-files=no", "--", *PROGRAM)
    except (OSError, subprocess.SubprocessError):  # no git, or a checkout of another user
        return None
    return f"{commit}-dirty" if changes else commit


def git(root: Path, *arguments: str) -> str:
    """The output of a git command in a checkout."""
    command = ["git", "-C", str(root), *arguments]
    result = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=GIT_TIMEOUT_S
    )
    return result.stdout.strip()
