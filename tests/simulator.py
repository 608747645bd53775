"""Test files that need numba-cuda's simulator, each in its own process: numba reads
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
def output_of(path: Path) -> str:
    """What pytest prints of a file's tests in the simulator, a line each."""
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
    command = [sys.executable, "-m", "pytest", "-rA", "--tb=short", "-p", "no:xdist", path]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    return result.stdout + result.stderr


def assert_passed(path: Path, name: str) -> None:
    """AssertionError with all of the output where a test of a file did not pass."""
    output = output_of(path)
    passed = re.findall(rf"^PASSED \S+::{name}\b", output, re.M)
    assert passed and not re.findall(rf"^(FAILED|ERROR) \S+::{name}\b", output, re.M), output
