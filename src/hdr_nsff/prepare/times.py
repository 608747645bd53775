"""Times of the frames of a clip from which some are missing: a gap in time is a gap."""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.progress import say
from hdr_nsff.footage.exposure_lists import row_of
from hdr_nsff.footage.footage import MAX_RATE_DIFFERENCE
from hdr_nsff.footage.timestamps import (
    frame_gaps,
    read_timestamps,
    timestamps_problem,
    usual_gap,
    variable_rate,
)
from hdr_nsff.prepare.work import Work
from hdr_nsff.scene.manifest import FrameEntry


def leave_gaps(work: Work, entries: list[FrameEntry], seconds: list[float | None]) -> int:
    """Count the frames that are missing by timestamps in the times of `entries`, in
    place; how many there are. `seconds`: of the entries, by a video's own clock.

    The CSV beside the frames decides before the video. Each camera has gaps of its own.
    Where these put cameras at times that none shares, they are taken as evenly spaced,
    and so are tracks that disagree, and the pictures of data sets.
    """
    if work.capture is not None:
        return 0
    written = read_timestamps(work.footage)
    stride = work.config.stride
    problems: list[str | None] = []
    lines: dict[tuple[int, int], list[int]] = {}
    for k, entry in enumerate(entries):
        lines.setdefault((entry.camera_id, entry.track), []).append(k)
    found: list[np.ndarray | None] = []
    for line in lines.values():
        known = [seconds[k] for k in line]
        if written:
            known = [seconds_of(work, entries[k], written) for k in line]
            problems.append(timestamps_problem(known, [entries[k].source for k in line]))
        problems.append(variable_rate(known))
        found.append(frame_gaps(known, stride))
    if problem := next(filter(None, problems), None):
        say(f"frames: {problem}; all count as evenly spaced")
    gaps = [own for own in found if own is not None]
    if len(gaps) < len(found):
        return 0
    if problem := disagreement(gaps, any(entry.track for entry in entries)):
        say(f"frames: {problem}; all count as evenly spaced")
        return 0
    for line, own in zip(lines.values(), gaps, strict=True):
        times = np.concatenate([[0.0], np.cumsum(own)])
        for k, time in zip(line, times.tolist(), strict=True):
            entries[k].time = round(time, 6)
    return max(round(float((own - 1).sum() * stride)) for own in gaps)


def disagreement(gaps: list[np.ndarray], tracks: bool) -> str | None:
    """Why the gaps (T-1,) of cameras, or `tracks` of one, have no common times, in
    words; None where they have.
    """
    if all(np.array_equal(own, gaps[0]) for own in gaps):
        return None
    if tracks:
        return "the tracks miss different frames by their timestamps"
    if any((own % 1).any() for own in gaps):
        return "the cameras miss different frames by their timestamps, which needs --stride 1"
    return None


def frame_seconds(
    work: Work, entries: list[FrameEntry], seconds: list[float | None]
) -> float | None:
    """Seconds from one frame of the footage to the next, by timestamps or the clock of
    a video; None where nothing shows them. `seconds` as of `leave_gaps`.
    """
    if work.capture is not None:
        return None
    stride = work.config.stride
    written = read_timestamps(work.footage)
    if written:
        known = [seconds_of(work, entries[k], written) for k in first_line(entries)]
        return usual_gap(known, stride)
    if not work.footage.video:
        return None
    return usual_gap([seconds[k] for k in first_line(entries)], stride) or 1 / work.footage.fps


def frame_rate(work: Work, entries: list[FrameEntry], seconds: list[float | None]) -> float:
    """Frames as used a second. `seconds` as of `leave_gaps`.

    The rate in the header of a video is an average, to which gaps and held frames
    count. Its clock corrects it, unless the rate varies as a whole.
    """
    stride, rate = work.config.stride, work.footage.fps
    own = [seconds[k] for k in first_line(entries)]
    usual = usual_gap(own, stride)
    if usual is None or frame_gaps(own, stride) is None:
        return rate / stride
    agrees = abs(rate * usual - 1) <= MAX_RATE_DIFFERENCE  # times are rounded
    return (rate if agrees else 1 / usual) / stride


def first_line(entries: list[FrameEntry]) -> list[int]:
    """The places of the frames of the first camera, or its first track."""
    return [k for k, e in enumerate(entries) if (e.camera_id, e.track) == (0, 0)]


def seconds_of(work: Work, entry: FrameEntry, written: dict[str, float]) -> float | None:
    """The seconds of a frame in a CSV, by its name or number; None without."""
    number = work.config.start + int(entry.time) * work.config.stride
    return row_of(written, entry.source, number)


def by_timestamps(work: Work) -> bool:
    """Whether the times of the frames have gaps that timestamps show."""
    step = work.manifest.steps.get("frames")
    return step is not None and bool(step.details.get("missing", 0))


def evenly_spaced(work: Work) -> list[float]:
    """The times of all frames if none were missing."""
    frames, numbers = work.manifest.frames, work.frame_numbers()
    return [work.time_of(f.source, number) for f, number in zip(frames, numbers, strict=True)]


def times_of_slots(work: Work, slots: tuple[float, ...]) -> list[float]:
    """The time of every frame: by timestamps where these have gaps, else by its place
    `slots` (T,) in the exposure cycle where frames are missing from it.
    """
    if work.capture is not None or by_timestamps(work):
        return [f.time for f in work.manifest.frames]
    return list(slots) or evenly_spaced(work)
