"""Freed memory stays with the process."""

import resource
import sys

import numpy as np
import pytest

from hdr_nsff.memory import keep_memory


@pytest.mark.skipif(not sys.platform.startswith("linux") or not keep_memory(), reason="not glibc's allocator")
def test_a_pictures_memory_is_asked_for_once() -> None:
    def picture() -> None:
        np.ones(345_600 * 3, np.float32)  # 1,013 pages

    for _ in range(3):
        picture()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        picture()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < 2000
