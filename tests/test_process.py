"""The command line sets up the process, and importing the package changes nothing.
Processes end with their parent.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

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


def comes_true(fact: Callable[[], bool]) -> bool:
    """Whether something becomes true within ten seconds."""
    for _ in range(100):
        if fact():
            return True
        time.sleep(0.1)
    return False


def outlives_its_parent(code: str, *arguments: str) -> bool:
    """Whether a process that watches its parent lives on where that is killed."""
    command = [sys.executable, "-c", code, *arguments]
    start = f"import subprocess; print(subprocess.Popen({command}).pid, flush=True); input()"
    pipe = subprocess.PIPE
    parent = subprocess.Popen([sys.executable, "-c", start], stdin=pipe, stdout=pipe, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    comes_true(lambda: len(os.listdir(f"/proc/{child}/task")) > 1)  # it watches
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    if comes_true(lambda: not os.path.exists(f"/proc/{child}")):
        return False
    os.kill(child, signal.SIGKILL)
    return True


def test_a_process_does_not_outlive_its_parent() -> None:
    watch = "from hdr_nsff.core.process import die_with_parent; die_with_parent(); "
    assert not outlives_its_parent(f"{watch}import time; time.sleep(60)")
