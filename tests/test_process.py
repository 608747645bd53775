"""Freed memory stays with the process."""

import subprocess
import sys

import pytest

from hdr_nsff.core.process import keep_memory

PICTURES = """
import resource
import numpy as np

def pictures():
    held = [np.ones(345_600 * 3, np.float32) for _ in range(8)]  # 1,013 pages each

for _ in range(3):
    pictures()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    pictures()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(first: str) -> int:
    """Page faults of a new process that makes the same pictures 20 times."""
    return int(
        subprocess.run(
            [sys.executable, "-c", first + PICTURES], capture_output=True, check=True, text=True
        ).stdout
    )


@pytest.mark.skipif(not keep_memory(), reason="not glibc's allocator")
def test_what_a_picture_needs_is_asked_of_the_system_once() -> None:
    assert faults("import hdr_nsff") < 1000
    assert faults("") > 20 * 1000  # or there were nothing to keep
