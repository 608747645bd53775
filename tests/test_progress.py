"""What progress says of the rest, on a terminal and elsewhere."""

from collections.abc import Iterator
from io import StringIO

import pytest
from rich.console import Console
from rich.progress import Progress

from hdr_nsff.core import progress
from hdr_nsff.core.progress import TimeLeftColumn, progress_of, seconds_left, time_left, track


class Time:
    """A clock that a test moves on."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Time:
    """The clock of progress, where no terminal is."""
    time = Time()
    monkeypatch.setattr(progress, "time", time)
    monkeypatch.setattr(progress, "console", Console(file=StringIO(), force_terminal=False))
    return time


def lines(
    clock: Time, capsys: pytest.CaptureFixture[str], seconds: float, total: int | None, count: int
) -> list[str]:
    """What `count` items of so many seconds print."""

    def items() -> Iterator[int]:
        yield from range(count)

    for _ in track(items(), "flow", total):
        clock.now += seconds
    return capsys.readouterr().err.splitlines()


def test_time_left_follows_the_time_so_far() -> None:
    assert progress_of(2, 8, 3.0) == " of 8, 9 s left"
    assert progress_of(1, 101, 9.0) == " of 101, 15 min left"
    assert time_left(299.0) == "299 s left"


def test_without_a_total_or_beyond_it_nothing_is_left_to_say() -> None:
    assert progress_of(2, None, 3.0) == ""
    assert progress_of(9, 8, 3.0) == ""
    assert seconds_left(0, 8, 3.0) is None


def test_the_first_item_says_how_long_all_of_them_take(
    clock: Time, capsys: pytest.CaptureFixture[str]
) -> None:
    found = lines(clock, capsys, 1.0, 30, 30)
    assert found[0] == "flow: 1 of 30, 29 s left"
    assert found[1:] == ["flow: 12 of 30, 18 s left", "flow: 23 of 30, 7 s left"]  # every 10 s


def test_what_is_short_or_of_unknown_length_needs_no_first_line(
    clock: Time, capsys: pytest.CaptureFixture[str]
) -> None:
    assert lines(clock, capsys, 0.1, 20, 20) == []
    assert lines(clock, capsys, 4.0, None, 3) == ["flow: 3"]
    assert lines(clock, capsys, 4.0, 1, 1) == []


def test_a_bar_has_the_time_left_from_the_first_item() -> None:
    now = 0.0
    bar = Progress(console=Console(file=StringIO()), get_time=lambda: now)
    column = TimeLeftColumn()
    bar.add_task("poses", total=5)
    (task,) = bar.tasks
    assert column.render(task).plain == "-:--:--"
    now = 60.0
    bar.advance(task.id)
    assert column.render(task).plain == "0:04:00"
    now = 90.0  # the second item takes its time
    assert column.render(task).plain == "0:03:30"
    bar.update(task.id, left=12.0)
    assert column.render(task).plain == "0:00:12"
