"""Test files that need numba-cuda's simulator, in a process of their own: numba reads
NUMBA_ENABLE_CUDASIM when it is imported.
"""

import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path


def names_in(path: Path) -> list[str]:
    """The names of the tests in a file."""
    return re.findall(r"^def (test_\w+)", path.read_text(), re.M)


@cache
def output_of(*paths: Path) -> str:
    """What pytest prints of these files' tests in the simulator, a line each."""
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
    command = [sys.executable, "-m", "pytest", "-rA", "--tb=short", "-p", "no:xdist", *paths]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    return result.stdout + result.stderr


def assert_passed(path: Path, name: str, *paths: Path) -> None:
    """AssertionError with all of the output where a test of a file, one of `paths` that
    are run together, did not pass.
    """
    output, test = output_of(*paths), rf"\S*{re.escape(path.name)}::{name}\b"
    passed = re.findall(rf"^PASSED {test}", output, re.M)
    assert passed and not re.findall(rf"^(FAILED|ERROR) {test}", output, re.M), output
