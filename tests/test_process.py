"""The command line sets up the process; importing the package changes nothing."""

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
FRESH_PAGES = 20 * 1000  # page faults where every picture allocates fresh memory


def output_of(code: str) -> str:
    """What a new process prints."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, check=True, text=True).stdout


def page_faults(setup: str) -> int:
    """Page faults of a new process that makes the same pictures 20 times."""
    return int(output_of(setup + PICTURES))


@pytest.mark.skipif(not keep_memory(), reason="not glibc's allocator")
def test_a_prepared_process_requests_memory_once() -> None:
    prepare = "from hdr_nsff.core.process import prepare_process; prepare_process()"
    assert page_faults(prepare) < 1000
    assert page_faults("") > FRESH_PAGES  # otherwise there is nothing to keep


@pytest.mark.skipif(not keep_memory(), reason="not glibc's allocator")
def test_importing_the_package_leaves_the_allocator_alone() -> None:
    assert page_faults("import hdr_nsff, hdr_nsff.cli, hdr_nsff.core.process") > FRESH_PAGES


def test_importing_the_package_leaves_the_environment_alone() -> None:
    compare = """
import os, cv2  # which changes LD_LIBRARY_PATH itself
before = dict(os.environ)
import hdr_nsff, hdr_nsff.pipeline
print(dict(os.environ) == before)
"""
    assert output_of(compare) == "True\n"


def test_idle_threads_sleep_unless_the_user_sets_otherwise() -> None:
    wait = "import os; from hdr_nsff.core.process import prepare_process; prepare_process()"
    show = "\nprint(os.environ['OMP_WAIT_POLICY'])"
    assert output_of(wait + show) == "PASSIVE\n"
    given = "import os; os.environ['OMP_WAIT_POLICY'] = 'ACTIVE'\n"
    assert output_of(given + wait + show) == "ACTIVE\n"
