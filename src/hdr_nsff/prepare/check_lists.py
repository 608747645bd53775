"""The list of exposures and times beside the frames, checked before any is decoded."""

from __future__ import annotations

from collections.abc import Iterator

from hdr_nsff.footage.datasets.capture import Capture
from hdr_nsff.footage.exposure_lists import ev_in_list, parse_exposures, read_exposure_csv
from hdr_nsff.footage.footage import Footage
from hdr_nsff.footage.ingest import MAX_MISSING_FRAMES
from hdr_nsff.footage.timestamps import read_timestamps
from hdr_nsff.prepare.work import PrepareConfig


def check_lists(config: PrepareConfig, footage: Footage, capture: Capture | None) -> None:
    """InputError for a list beside the frames that is not understood, or has no row for
    a frame that is used.

    Exposures count where neither options nor a data set replace them.
    """
    if capture is not None and capture.parts()["exposures"]:
        return
    if capture is None:
        read_timestamps(footage)
    chosen = parse_exposures(config.exposures, config.ev)
    if chosen is not None or "auto" in (config.exposures, config.ev):
        return
    table = read_exposure_csv(footage)
    if table is not None:
        for source, number in frames_to_use(config, footage):
            ev_in_list(*table, source, number, footage.same_camera)


def frames_to_use(config: PrepareConfig, footage: Footage) -> Iterator[tuple[str, int]]:
    """Names of the frames, and their numbers in the footage of their camera; of a video
    those that it has for certain.
    """
    for files in footage.cameras:
        certain = footage.count - MAX_MISSING_FRAMES if footage.video else len(files)
        stop = certain if config.end is None else min(certain, config.end)
        for number in range(config.start, stop, config.stride):
            yield footage.frame_name(files, number), number
