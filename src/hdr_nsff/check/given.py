"""Exposures that are written down for the frames of a clip, as `prepare` takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.footage.exposure_lists import ev_in_list, read_exif_ev, read_exposure_csv
from hdr_nsff.footage.footage import Footage
from hdr_nsff.footage.gpmf import read_gopro
from hdr_nsff.prepare.exposures import EXIF, GOPRO, MIN_DRIFT_EV
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.radiometry.dropped_frames import find_cycle


@dataclass(frozen=True)
class GivenExposures:
    """Where the exposures of frames are written down, and what they are."""

    source: str  # the name of a list, `EXIF` or `GOPRO`
    ev: list[float]  # (T,) to any reference

    @property
    def follows_no_cycle(self) -> bool:
        """Whether they are too many for a cycle, of a GoPro, or EXIF of less than a
        step: auto exposure.
        """
        if self.source == EXIF and max(self.ev) - min(self.ev) < exposure.MIN_STEP:
            return True
        if self.source == GOPRO:
            return True
        return len(exposure.brackets_by_ev(self.ev)[1]) > exposure.MAX_CYCLE

    def cycle(self) -> tuple[exposure.Cycle, tuple[int, ...]]:
        """Their cycle, and the frames before which it skips some.

        Of auto exposure, the cycle is that of an alternation below it, if any.
        """
        gapped = find_cycle(np.diff(self.ev), np.ones(len(self.ev) - 1, int))
        if self.follows_no_cycle:
            return gapped.cycle, gapped.gaps
        brackets, ev = exposure.brackets_by_ev(self.ev)
        relative = [value - min(ev) for value in ev]
        order = np.argsort(ev, kind="stable").tolist()
        length = exposure.period(brackets)
        if gapped.gaps:
            length = gapped.cycle.length
        return exposure.Cycle(length, brackets, order, relative, 1.0), gapped.gaps

    def drift(self) -> float:
        """The range in EV by which auto exposure leaves the brackets of its cycle."""
        if not self.follows_no_cycle:
            return 0.0
        brackets = np.array(self.cycle()[0].brackets)
        left = np.array(self.ev)
        for bracket in np.unique(brackets):
            left[brackets == bracket] -= left[brackets == bracket].mean()
        return float(np.ptp(left))


def given_exposures(footage: Footage, count: int) -> list[GivenExposures | None]:
    """The exposures of the first `count` frames of every camera or track; None where
    none are written down, or metadata give all of these frames the same.

    InputError for a list that is not understood, or lacks one of these frames.
    """
    table = read_exposure_csv(footage)
    if table is not None:
        path, rows = table
        advice = "add it, or rename the list to ignore it"
        return [
            GivenExposures(
                path.name,
                [
                    ev_in_list(path, rows, source, i, footage.same_camera, advice)
                    for i, source in enumerate(frame_names(footage, camera, count))
                ],
            )
            for camera in range(len(footage.cameras))
        ]
    known = [metadata_ev(footage, camera, count) for camera in range(len(footage.cameras))]
    all_known = [ev for own in known for ev in own]
    complete = all(len(own) == count for own in known)
    if not complete or max(all_known) - min(all_known) < MIN_DRIFT_EV:
        return [None] * len(known)
    source = GOPRO if footage.video else EXIF
    return [GivenExposures(source, own) for own in known]


def frame_names(footage: Footage, camera: int, count: int) -> list[str]:
    """The names of the first `count` frames of a camera, as in a list."""
    files = footage.cameras[camera]
    known = count if footage.video else min(count, len(files))
    return [footage.frame_name(files, number) for number in range(known)]


def metadata_ev(footage: Footage, camera: int, count: int) -> list[float]:
    """The EVs of those of the first `count` frames of a camera whose metadata have
    one.
    """
    files = footage.cameras[camera]
    if footage.video:
        written = read_gopro(files[0], max(footage.count, count))
        return [] if written is None else written.ev[:count].tolist()
    known = [read_exif_ev(path) for path in files[:count]]
    return [ev for ev in known if ev is not None]
