"""A pool of processes, a few at a time.

Each has its share of the threads or a device of its own, and its own log.
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

PARENT = "HDR_NSFF_BENCH_PARENT"  # environment: the process whose end is that of this process
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
POLL_S = 0.2  # seconds between looks at the processes
PROGRESS_S = 2.0  # seconds between looks at their progress
GRACE_S = 5.0  # seconds that a process has to end by itself
COMMAND = (sys.executable, "-P", "-c", "from hdr_nsff.cli import main; main()")

Environment = dict[str, str]


@dataclass(frozen=True)
class Job:
    """A command of this package to be run."""

    name: str
    arguments: Sequence[str]  # the words after `hdr-nsff`
    log: Path
    environment: Environment


@dataclass(frozen=True)
class Running:
    """A job at work."""

    job: Job
    process: subprocess.Popen[bytes]
    slot: Environment


def shell_line(arguments: Sequence[str]) -> str:
    """The command, for a shell."""
    return shlex.join(["hdr-nsff", *arguments])


def slots(jobs: int, devices: str | None) -> list[Environment]:
    """The environments of parallel processes.

    Each has a share of the threads, unless the user's environment sets their number,
    and a device where `devices` names some.
    """
    names = [device.strip() for device in devices.split(",")] if devices else []
    count = len(names) or jobs
    share = str(max(1, num_cores() // count))
    threads = {}
    for name in THREADS:
        threads[name] = os.environ.get(name) or os.environ.get("OMP_NUM_THREADS") or share
    if not names:
        return [threads] * count
    return [threads | {"CUDA_VISIBLE_DEVICES": name} for name in names]


def num_cores() -> int:
    """Cores that this process may use; 1 where the system does not say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1


def run_jobs(
    jobs: Sequence[Job],
    slots: Sequence[Environment],
    ended: Callable[[Job, int], None],
    report_progress: Callable[[set[str]], None],
) -> None:
    """Run all jobs, as many in parallel as there are `slots`.

    `ended` gets each job with its exit code, `report_progress` every two seconds the
    names of those at work. When this function is left, by an error too, so are they.
    """
    waiting, free = list(jobs), list(slots)
    running: list[Running] = []
    reported = 0.0
    try:
        while waiting or running:
            while waiting and free:
                running.append(start(waiting.pop(0), free.pop(0)))
            for entry in [e for e in running if e.process.poll() is not None]:
                running.remove(entry)
                free.insert(0, entry.slot)
                ended(entry.job, entry.process.returncode)
            if time.monotonic() - reported > PROGRESS_S or not running:
                report_progress({entry.job.name for entry in running})
                reported = time.monotonic()
            if running:
                time.sleep(POLL_S)
    finally:
        stop([entry.process for entry in running])


def start(job: Job, slot: Environment) -> Running:
    """Start a job in a session of its own, so that all its processes end with it."""
    job.log.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | slot | job.environment | {PARENT: str(os.getpid())}
    with open(job.log, "ab") as log:
        log.write(f"$ {shell_line(job.arguments)}\n".encode())
        log.flush()
        process = subprocess.Popen(
            [*COMMAND, *job.arguments],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    return Running(job, process, slot)


def stop(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """End these processes and all that they have started."""
    for force in (False, True):
        for process in processes:
            if process.poll() is None:
                end(process, force)
        deadline = time.monotonic() + GRACE_S
        while any(p.poll() is None for p in processes) and time.monotonic() < deadline:
            time.sleep(POLL_S / 4)


def end(process: subprocess.Popen[bytes], force: bool) -> None:
    """Ask a process and its children to end, or with `force` make them end."""
    if not hasattr(os, "killpg"):  # Windows (not tried), where its children stay
        process.kill()
        return
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL if force else signal.SIGTERM)


def end_with_parent() -> None:
    """End this process once its parent is gone, even where that was killed.

    Only in a process that `run_jobs` started.
    """
    parent = int(os.environ.get(PARENT) or 0)
    if not parent or not hasattr(os, "killpg"):
        return

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os.killpg(os.getpgid(0), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def failure_reason(log: Path, code: int) -> str:
    """Why a process failed: the last line of its log, or the signal that ended it."""
    if code < 0:
        ended = f"killed by {signal.Signals(-code).name}"
        return f"{ended}; the memory may have run out" if code == -signal.SIGKILL else ended
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    words = [line for line in lines if line.strip()]
    if not words:
        return f"exit code {code}"
    return words[-1].removeprefix("hdr-nsff: ").strip()
