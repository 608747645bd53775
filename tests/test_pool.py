"""Processes of a benchmark: the environment of each, and why one has failed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hdr_nsff.bench.pool import THREADS, failure_reason, slots


@pytest.fixture(autouse=True)
def eight_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight cores, and no number of threads in the environment."""
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))


def test_threads_are_shared_between_processes() -> None:
    assert [slot["OMP_NUM_THREADS"] for slot in slots(3, None)] == ["2", "2", "2"]
    assert slots(16, None)[0]["NUMBA_NUM_THREADS"] == "1"


def test_every_process_has_another_device() -> None:
    assert [slot["CUDA_VISIBLE_DEVICES"] for slot in slots(1, "0, 3")] == ["0", "3"]
    assert "CUDA_VISIBLE_DEVICES" not in slots(1, None)[0]


def test_the_number_of_threads_of_the_user_takes_precedence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    slot = slots(4, None)[0]
    assert slot["OMP_NUM_THREADS"] == slot["NUMBA_NUM_THREADS"] == "5"


def test_the_reason_of_a_failure_is_the_last_line_or_the_signal(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text("$ hdr-nsff bench\nTraceback\n\nFloatingPointError: step 3\n\n")
    assert failure_reason(log, 1) == "FloatingPointError: step 3"
    log.write_text("hdr-nsff: x.png: cut short\n")
    assert failure_reason(log, 2) == "x.png: cut short"
    assert failure_reason(log, -9) == "killed by SIGKILL; the memory may have run out"
    log.write_text("")
    assert failure_reason(log, 2) == "exit code 2"
