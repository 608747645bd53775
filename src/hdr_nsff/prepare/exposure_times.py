"""The exposure time of every frame in seconds, where options or metadata have it.

Exposures (EV) count sensitivity and aperture too. How long the shutter was open, and so
how far motion blurs, is a matter of time alone.
"""

from __future__ import annotations

from hdr_nsff.footage.exposure_lists import read_exif_seconds, read_listed, row_of
from hdr_nsff.prepare.exposures import FrameExposures, gopro_metadata
from hdr_nsff.prepare.work import Work


def exposure_times(work: Work, found: FrameExposures) -> list[float | None]:
    """Seconds of every frame, from where the exposures `found` come from; None where
    that has no times.

    Where brightness decided, metadata count if the clip has one exposure.
    """
    unknown: list[float | None] = [None] * len(work.manifest.frames)
    c = work.config
    if work.capture is not None or "auto" in (c.exposures, c.ev) or c.ev is not None:
        return unknown
    if c.exposures is not None:
        known = [found.ev[bracket] for bracket in found.brackets]
        drift = found.drift or [0.0] * len(known)
        return [None if ev is None else 2.0 ** (ev + d) for ev, d in zip(known, drift, strict=True)]
    if found.estimated and len(found.ev) > 1:
        return unknown
    return times_in_metadata(work)


def times_in_metadata(work: Work) -> list[float | None]:
    """Seconds of every frame in the CSV, else in a GoPro's videos, else in EXIF."""
    frames, numbers = work.manifest.frames, work.frame_numbers()
    table = read_listed(work.footage)
    if table is not None:
        whole_name = work.manifest.num_tracks > 1
        listed = [
            row_of(table[1], f.source, n, whole_name) for f, n in zip(frames, numbers, strict=True)
        ]
        return [None if row is None else row.seconds for row in listed]
    if not work.footage.video:
        files = work.footage.files
        return [read_exif_seconds(files[f.source]) for f in frames]
    seconds: list[float | None] = [None] * len(frames)
    for own, written in zip(work.camera_frames(), gopro_metadata(work), strict=True):
        if written is not None:
            for i in own:
                seconds[i] = float(written.seconds[numbers[i]])
    return seconds
