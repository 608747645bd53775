"""The file of a clip, or its folder of frames: size, bits, transfer, timing."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from hdr_nsff.check.facts import FileFacts
from hdr_nsff.core.video import frame_times, video_info
from hdr_nsff.footage.exposure_lists import row_of
from hdr_nsff.footage.footage import TRANSFER_NAMES, Footage
from hdr_nsff.footage.gpmf import stabilized
from hdr_nsff.footage.ingest import MAX_FRAMES, read_frames
from hdr_nsff.footage.timestamps import (
    frame_gaps,
    read_timestamps,
    timestamps_problem,
    usual_gap,
)


def describe_file(footage: Footage) -> FileFacts:
    """The file's header, or the first frame of a folder."""
    first = footage.cameras[0][0]
    kind = "linear" if footage.linear else "recorded"
    if footage.transfer is not None:
        kind = TRANSFER_NAMES[footage.transfer]
    frame = next(read_frames(footage, 0, 1, 1, MAX_FRAMES))
    height, width = frame.rgb.shape[:2]
    bits = 8
    if footage.video:
        bits = video_info(first).bits
    elif not footage.linear:
        depth = cv2.imread(str(first), cv2.IMREAD_UNCHANGED)
        bits = 16 if depth is not None and depth.dtype == np.uint16 else 8
    else:
        bits = 16
    return FileFacts(
        name=footage.path.name,
        frames=footage.count,
        cameras=len(footage.cameras),
        width=width,
        height=height,
        fps=footage.fps,
        bits=bits,
        kind=kind,
        bars=footage.bars.sentence() if footage.bars else "",
        interlaced=footage.interlaced,
        same_camera=footage.same_camera,
        stabilized=stabilized(first) if footage.video else None,
        **measure_timing(footage),
    )


def measure_timing(footage: Footage) -> dict[str, Any]:
    """The fields of `FileFacts` on times of the first camera's frames, by the column
    `timestamp_ns` of the list beside them, else by a video's own clock.

    InputError for a column that is not understood.
    """
    files, written = footage.cameras[0], read_timestamps(footage)
    seconds: list[float | None] = []
    problem = None
    if written:
        names = [footage.frame_name(files, number) for number in range(footage.count)]
        seconds = [row_of(written, name, number) for number, name in enumerate(names)]
        problem = timestamps_problem(seconds, names)
    elif footage.video:
        seconds = [*frame_times(files[0]).tolist()]
    if problem is not None:
        return {"interval_ms": None, "timestamps_problem": problem}
    known = np.array(seconds, np.float64)
    if len(known) < 2:
        return {"interval_ms": None}
    usual, steps = usual_gap(seconds), frame_gaps(seconds)
    if steps is None:
        steps = np.ones(len(known) - 1)
    gaps = np.diff(known) / steps * 1000
    return {
        "interval_ms": (round(float(gaps.min()), 2), round(float(gaps.max()), 2)),
        "frame_ms": None if usual is None else round(1000 * usual, 2),
        "missing": round(float((steps - 1).sum())),
    }
