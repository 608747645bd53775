"""The exposures of all cameras of a rig, or of all tracks of one camera, on a few small
frames of each.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.check.facts import CameraExposure
from hdr_nsff.check.given import GivenExposures, given_exposures
from hdr_nsff.footage.footage import Footage
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.radiometry.camera_brackets import camera_levels, usual_cameras

NUM_FRAMES = 4 * exposure.MAX_CYCLE  # of each camera, in which a cycle shows


def measure_cameras(
    footage: Footage, max_size: int, low: float, high: float
) -> tuple[CameraExposure, ...]:
    """The exposures of every camera or track; none where there is but one.

    Recorded values beyond `low` and `high` are black and white. InputError for frames
    that cannot be read.
    """
    if len(footage.cameras) == 1:
        return ()
    videos = first_frames(footage, max_size)
    given = given_exposures(footage, min(map(len, videos)))
    cycles = [
        exposure.detect_cycle(video) if own is None else own.cycle()[0]
        for video, own in zip(videos, given, strict=True)
    ]
    levels = levels_of_cameras(videos, cycles, given)
    found = []
    for c, (video, cycle, own) in enumerate(zip(videos, cycles, given, strict=True)):
        white = (video > high).any(-1).mean((1, 2))  # (T,)
        black = (video < low).all(-1).mean((1, 2))
        brackets = np.array(cycle.brackets)
        first = footage.cameras[c][0]
        found.append(
            CameraExposure(
                name=first.name if footage.video else first.parent.name,
                cycle=cycle.length,
                level_ev=levels[c],
                white_share=round(float(white[brackets == cycle.order[0]].mean()), 4),
                black_share=round(float(black[brackets == cycle.order[-1]].mean()), 4),
                contradictions=tuple(contradictions(video, own)),
            )
        )
    return tuple(found)


def first_frames(footage: Footage, max_size: int) -> list[np.ndarray]:
    """The first frames (T, H, W, 3) of every camera or track."""
    frames: list[list[np.ndarray]] = [[] for _ in footage.cameras]
    for frame in read_frames(footage, 0, NUM_FRAMES, 1, max_size):
        frames[frame.track if footage.same_camera else frame.camera_id].append(frame.rgb)
    count = min(map(len, frames))
    return [np.stack(own[:count]) for own in frames]


def levels_of_cameras(
    videos: list[np.ndarray], cycles: list[exposure.Cycle], given: list[GivenExposures | None]
) -> list[float | None]:
    """By how many EV every camera is exposed more than the first, as it is given or by
    brightness; None where cycles differ in kind.
    """
    known = [float(np.mean(own.ev)) for own in given if own is not None]
    if len(known) == len(videos):
        return [round(level - known[0], 2) for level in known]
    compared = usual_cameras(cycles)
    if len(compared) < len(videos):
        return [None] * len(videos)
    return [round(level, 2) for level in camera_levels([*videos], cycles).tolist()]


def contradictions(video: np.ndarray, given: GivenExposures | None) -> list[str]:
    """What the pixels say against given exposures, in sentences."""
    return [] if given is None else exposure.contradictions(video, given.ev)
