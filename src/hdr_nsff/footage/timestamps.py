"""Times of frames by their timestamps: a gap in time is a gap in time.

Timestamps jitter, and phones vary their frame rate a little. Frames count as evenly
spaced, and only where a gap is longer by most of a frame are frames missing.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.exposure_lists import find_csv, frame_key, parse_number, read_utf8
from hdr_nsff.footage.footage import Footage

COLUMN = "timestamp_ns"
# frames by which a gap is longer than the usual one before a frame counts as missing
# (hand-chosen: pulldown of 24 to 60 frames a second has gaps half a frame longer)
MIN_EXTRA = 0.75
# of gaps with missing frames above which the frame rate varies as a whole
MAX_SHARE = 0.2


def read_timestamps(footage: Footage) -> dict[str, float]:
    """Seconds of every frame in the column `timestamp_ns` of the CSV beside the frames,
    by file name or `#number`; empty without.
    """
    path = find_csv(footage)
    if path is None:
        return {}
    reader = csv.DictReader(io.StringIO(read_utf8(path), newline=""), skipinitialspace=True)
    seconds = {}
    try:
        columns = reader.fieldnames or []
        name = next((c for c in ("file", "frame") if c in columns), None)
        if name is None or COLUMN not in columns:
            return {}
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            key = frame_key(name, row[name] or "")
            seconds[key] = 1e-9 * parse_number(row[COLUMN] or "", where)
    except csv.Error as error:
        line = reader.line_num + 1
        raise InputError(
            f"{path}, line {line}: no readable CSV ({error}); correct the line"
        ) from error
    return seconds


def timestamps_problem(seconds: Sequence[float | None], names: Sequence[str]) -> str | None:
    """Why the timestamps of frames do not show when these were taken, in words; None
    where they do. `seconds` and `names` (T,) of the frames in order.
    """
    for k, (here, name) in enumerate(zip(seconds, names, strict=True)):
        if here is None:
            return f"frame {name} has no {COLUMN}"
        before = seconds[k - 1] if k else None
        if before is not None and here <= before:
            return f"the {COLUMN} of frame {name} is not above that of frame {names[k - 1]}"
    return None


def variable_rate(seconds: Sequence[float | None]) -> str | None:
    """That the frame rate varies as a whole, in words; None where it does not, or
    timestamps do not show it. `seconds` (T,) of the frames in order.
    """
    if usual_gap(seconds) is None or frame_gaps(seconds) is not None:
        return None
    gaps = np.diff(np.array(seconds, np.float64)) * 1000
    return f"variable frame rate: {gaps.min():.0f} to {gaps.max():.0f} ms from frame to frame"


def usual_gap(seconds: Sequence[float | None], stride: int = 1) -> float | None:
    """Seconds from one frame of the footage to the next, of those that are not longer
    because frames are missing; None where timestamps do not show it.

    `stride`: every how manyth frame of the footage has its `seconds`.
    """
    if len(seconds) < 3 or any(s is None for s in seconds):
        return None
    gaps = np.diff(np.array(seconds, np.float64))
    median = float(np.median(gaps))
    if not median > 0 or gaps.min() <= 0:
        return None
    # finer than the median: times are rounded
    return float(gaps[gaps < (1 + MIN_EXTRA / stride) * median].mean()) / stride


def frame_gaps(seconds: Sequence[float | None], stride: int = 1) -> np.ndarray | None:
    """By how many used frames each of the used ones follows the one before (T-1,): 1,
    or more where frames are missing; None where timestamps do not show it.

    `stride`: every how manyth frame of the footage is used.
    """
    usual = usual_gap(seconds, stride)
    if usual is None:
        return None
    frames = np.diff(np.array(seconds, np.float64)) / usual
    longer = frames - stride > MIN_EXTRA
    if longer.mean() > MAX_SHARE:
        return None
    return np.where(longer, np.round(frames), stride) / stride
