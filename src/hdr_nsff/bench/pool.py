"""Processes: so many at once, each with its share of the threads or a device of its
own, each with its own log.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from hdr_nsff.core.process import usable_cores

PARENT = "HDR_NSFF_BENCH_PARENT"  # environment: whose end is that of this process
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
PAUSE = 0.2  # seconds between looks at the processes
LOOK = 2.0  # and at how far they are
GRACE = 5.0  # seconds to end by itself
COMMAND = (sys.executable, "-c", "from hdr_nsff.cli import main; main()")


@dataclass(frozen=True)
class Job:
    """A command of this package to be run."""

    name: str
    arguments: Sequence[str]  # what follows `hdr-nsff`
    log: Path
    environment: dict[str, str]


def shell_line(arguments: Sequence[str]) -> str:
    """The command, for a shell."""
    return shlex.join(["hdr-nsff", *arguments])


def slots(jobs: int, devices: str | None) -> list[dict[str, str]]:
    """Per process at once, what its environment has of its own: a share of the threads
    (unless the user's environment says how many), a device.
    """
    names = [d.strip() for d in devices.split(",")] if devices else []
    count = len(names) or jobs
    share = str(max(1, usable_cores() // count))
    threads = {
        name: os.environ.get(name) or os.environ.get("OMP_NUM_THREADS") or share for name in THREADS
    }
    return [threads | ({"CUDA_VISIBLE_DEVICES": names[i]} if names else {}) for i in range(count)]


def run_jobs(
    jobs: Sequence[Job],
    places: Sequence[dict[str, str]],
    ended: Callable[[Job, int], None],
    look: Callable[[set[str]], None],
) -> None:
    """Run all jobs, as many at once as there are `places`. `ended` gets each with its
    exit code; `look` now and then the names of those that run. Whatever ends this
    function ends them.
    """
    waiting, free, looked = list(jobs), list(places), 0.0
    running: list[tuple[Job, subprocess.Popen[bytes], dict[str, str]]] = []
    try:
        while waiting or running:
            while waiting and free:
                place = free.pop(0)
                job = waiting.pop(0)
                running.append((job, start(job, place), place))
            for entry in [e for e in running if e[1].poll() is not None]:
                job, process, place = entry
                running.remove(entry)
                free.insert(0, place)
                ended(job, process.returncode)
            if time.monotonic() - looked > LOOK or not running:
                look({job.name for job, _, _ in running})
                looked = time.monotonic()
            if running:
                time.sleep(PAUSE)
    finally:
        stop([process for _, process, _ in running])


def start(job: Job, place: dict[str, str]) -> subprocess.Popen[bytes]:
    """The job, begun: in a session of its own, so that all it starts ends with it."""
    job.log.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | place | job.environment | {PARENT: str(os.getpid())}
    with open(job.log, "ab") as log:
        log.write(f"$ {shell_line(job.arguments)}\n".encode())
        log.flush()
        return subprocess.Popen(
            [*COMMAND, *job.arguments],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def stop(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """End these processes and all that they have started."""
    for force in (False, True):
        for process in processes:
            if process.poll() is None:
                end(process, force)
        deadline = time.monotonic() + GRACE
        while any(p.poll() is None for p in processes) and time.monotonic() < deadline:
            time.sleep(PAUSE / 4)


def end(process: subprocess.Popen[bytes], force: bool) -> None:
    """Ask a process and its children to end, or with `force` make them end."""
    if not hasattr(os, "killpg"):  # Windows (not tried), where its children stay
        process.kill()
        return
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL if force else signal.SIGTERM)


def end_with_parent() -> None:
    """In a process that `run_jobs` started: end it where the one that waits for it was
    killed.
    """
    parent = int(os.environ.get(PARENT) or 0)
    if not parent or not hasattr(os, "killpg"):
        return

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os.killpg(os.getpgid(0), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def last_words(log: Path, code: int) -> str:
    """Why a process failed: its last sentence, or the signal that ended it."""
    if code < 0:
        name = signal.Signals(-code).name
        return f"killed by {name}{', as where memory runs out' if name == 'SIGKILL' else ''}"
    lines = [
        line
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines()
        if line.strip()
    ]
    return lines[-1].removeprefix("hdr-nsff: ").strip() if lines else f"exit code {code}"
