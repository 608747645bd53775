"""Gaps in the timestamps of frames."""

from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.footage.timestamps import frame_gaps, read_timestamps


def test_a_gap_of_twice_the_usual_time_is_one_missing_frame() -> None:
    jitter = np.random.default_rng(0).normal(0, 1e-3, 20)
    seconds = np.delete(np.arange(20) / 25 + jitter, [7, 12, 13])
    found = frame_gaps(seconds.tolist())
    assert found is not None and found.tolist() == [*[1] * 6, 2, *[1] * 3, 3, *[1] * 5]


def test_with_a_stride_a_missing_frame_is_part_of_a_step() -> None:
    seconds = np.delete(np.arange(21) / 25, [7])[::2]
    found = frame_gaps(seconds.tolist(), stride=2)
    assert found is not None and found.tolist() == [1, 1, 1, 1.5, 1, 1, 1, 1, 1]


def test_pulldown_and_a_rate_that_varies_leave_no_gaps() -> None:
    pulldown = np.cumsum([2, 3] * 10) / 60
    assert frame_gaps(pulldown.tolist()) == pytest.approx(np.ones(19))
    assert frame_gaps(np.cumsum([1, 2, 1, 3, 1] * 4).tolist()) is None
    assert frame_gaps([0.0, 1.0, None]) is None
    assert frame_gaps([0.0, 2.0, 1.0, 3.0]) is None


def test_timestamps_of_a_csv_go_by_name_or_number(tmp_path: Path) -> None:
    for t in range(3):
        write_png(tmp_path / f"{t}.png", np.full((16, 16, 3), 0.5))
    footage = open_footage(tmp_path)
    path = tmp_path / "exposures.csv"
    assert read_timestamps(footage) == {}
    path.write_text("file,ev\n0.png,0\n")
    assert read_timestamps(footage) == {}
    path.write_text("file,ev,timestamp_ns\n0.png,0,0\n1.png,0,40000000\n")
    assert read_timestamps(footage) == {"0.png": 0.0, "1.png": pytest.approx(0.04)}
    path.write_text("frame,ev,timestamp_ns\n0,0,5e9\n")
    assert read_timestamps(footage) == {"#0": 5.0}
    path.write_text("frame,ev,timestamp_ns\n0,0,now\n")
    with pytest.raises(InputError, match="line 2: 'now' is not a number"):
        read_timestamps(footage)


def test_times_that_are_rounded_to_milliseconds_show_long_gaps_exactly() -> None:
    for fps, missing in ((60, 31), (240, 21), (30, 61)):
        frames = np.delete(np.arange(150), np.s_[40 : 40 + missing])
        gaps = frame_gaps((np.round(frames / fps * 1000) / 1000).tolist())
        assert gaps is not None and gaps.max() == missing + 1
