"""The exposure of every frame of a clip in `prepare`: given, or by brightness.

Exposures come from the command line, a data set, a CSV, or EXIF or a GoPro's metadata,
in this order; where none of these has them, frames of one exposure are found by their
brightness, and training learns the exposures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.footage.exposure_lists import (
    ev_in_list,
    parse_exposures,
    read_exif_ev,
    read_exposure_csv,
)
from hdr_nsff.footage.gpmf import GoProFrames, read_gopro
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.prepare.times import by_timestamps, evenly_spaced
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.radiometry.camera_brackets import common_brackets, exposure_groups
from hdr_nsff.radiometry.dropped_frames import GappedCycle, find_cycle

# confidence of a cycle by brightness from which it refutes a list (hand-chosen)
MIN_CONFIDENCE = 0.8
GOPRO, EXIF = "GoPro's metadata", "EXIF"  # as sources of exposures
MIN_DRIFT_EV = 0.02  # of these; below it, they are one
MAX_LISTED = 5  # frames in a message
FRAMES_OF_START = 4 * exposure.MAX_CYCLE  # in which a cycle shows, none left out


@dataclass(frozen=True)
class FrameExposures:
    """The exposures of all frames."""

    source: str  # where they come from, for people
    brackets: list[int]  # per frame
    ev: list[float | None]  # per bracket, to any reference; None: to be learned
    given: bool
    estimated: bool  # the brackets were found by brightness
    reference: int | None = None  # bracket; None: the best exposed one
    notes: tuple[str, ...] = ()  # sentences for people
    drift: tuple[float, ...] = ()  # given, per frame: stops from its bracket; empty: none
    slots: tuple[float, ...] = ()  # where frames are missing: per frame its time
    cycle: int | None = None  # its length; None: as the brackets show it


def frame_exposures(work: Work) -> FrameExposures:
    """The exposures of all frames, as given, or by brightness."""
    source, given = given_exposures(work)
    gapped = cycle_with_gaps(work, given)
    found = exposures_by(work, source, given, gapped)
    listed = parse_exposures(work.config.exposures, work.config.ev)
    in_turn = work.manifest.num_tracks == 1 and work.capture is None and not found.drift
    if listed is not None and in_turn:
        found = replace(found, cycle=list_period(listed, work.config.stride))
    if gapped is None:
        return replace(found, notes=(*stride_notes(work, found), *found.notes))
    slots = tuple(gapped.slots.astype(float).tolist())
    notes = (*gap_notes(work, gapped), *found.notes)
    return replace(found, slots=slots, cycle=found.cycle or gapped.period(), notes=notes)


def exposures_by(
    work: Work, source: str, given: list[float] | None, gapped: GappedCycle | None
) -> FrameExposures:
    """The exposures of all frames from the EVs that a `source` gives, else from
    brightness; `gapped`: their cycle where frames are missing from it.
    """
    capture, frames = work.capture, work.manifest.frames
    if capture is not None and capture.exposures is not None and source == "data set":
        stored = capture.exposures
        brackets = [work.picture(frame).bracket or 0 for frame in frames]
        return FrameExposures(
            source, brackets, list(stored.ev), stored.given, False, stored.reference
        )
    cameras = work.camera_frames()
    if work.manifest.num_tracks > 1:
        return track_exposures(work, source, given)
    if given is None:
        cycles = [cycle_of_line(work, own) for own in cameras]
        if gapped is not None:
            cycles = [gapped.cycle]
        group = exposure_groups([work.video[own] for own in cameras], cycles)
        brackets = [b for camera in common_brackets(cycles, group) for b in camera]
        unknown: list[float | None] = [None] * (max(brackets) + 1)
        notes = cycle_notes(work, cycles, group)
        return FrameExposures(source, brackets, unknown, False, True, notes=tuple(notes))
    different = [len(exposure.brackets_by_ev([given[i] for i in own])[1]) for own in cameras]
    drifts = source in (GOPRO, EXIF) and max(given) - min(given) < exposure.MIN_STEP
    if source == GOPRO or drifts or max(different) > exposure.MAX_CYCLE:
        own = own_brackets(work, given) if gapped is None else gapped.cycle.brackets
        found = drifting_exposures(source, given, own)
        return replace(found, notes=(*found.notes, *contradictions(work, cameras, given)))
    brackets, known = exposure.brackets_by_ev(given)
    doubts = contradictions(work, cameras, given)
    return FrameExposures(source, brackets, [*known], True, False, notes=tuple(doubts))


def contradictions(work: Work, lines: list[list[int]], given: list[float]) -> list[str]:
    """What the brightness of frames contradicts in the `given` EV of all of them, in
    sentences; `lines` are the indices of frames that follow each other.
    """
    found = []
    for own in lines:
        found += exposure.contradictions(work.video[own], [given[i] for i in own])
    return found


def cycle_with_gaps(work: Work, given: list[float] | None) -> GappedCycle | None:
    """The cycle of a clip from which frames are missing, by the `given` EVs of its
    frames or else their brightness; None where none are missing, or nothing alternates.

    Looked for in the clip of one camera, every frame of it.
    """
    cameras = work.camera_frames()
    if work.capture is not None or work.config.stride != 1 or len(cameras) > 1:
        return None
    times = evenly_spaced(work)
    if by_timestamps(work):
        times = [f.time for f in work.manifest.frames]
    known = np.diff(times).astype(int)
    steps = np.diff(given) if given is not None else exposure.brightness_steps(work.video)
    gapped = find_cycle(steps, known)
    if gapped.cycle.length == 1 or (not gapped.gaps and (known == 1).all()):
        return None
    return gapped


def cycle_of_line(work: Work, own: list[int], given: list[float] | None = None) -> exposure.Cycle:
    """The exposure cycle of the frames `own` of a camera or track, by the `given` EVs
    of all frames, else by brightness. It goes on after gaps that timestamps show.
    """
    if given is not None:
        steps = np.diff([given[i] for i in own])
    else:
        steps = exposure.brightness_steps(work.video[own])
    known = np.diff([work.manifest.frames[i].time for i in own])
    if by_timestamps(work) and not (known % 1).any():
        return find_cycle(steps, known.astype(int)).cycle
    return exposure.cycle_of_steps(steps)


def gap_notes(work: Work, gapped: GappedCycle) -> list[str]:
    """A sentence on the frames that are missing, where the exposures show it."""
    if not gapped.gaps:
        return []
    numbers = work.frame_numbers()
    listed = ", ".join(str(numbers[t]) for t in gapped.gaps[:MAX_LISTED])
    more = ", ..." if len(gapped.gaps) > MAX_LISTED else ""
    sentence = f"frames are missing before frame {listed}{more}: the exposures skip a part "
    sentence += f"of their cycle of {gapped.cycle.length}"
    if by_timestamps(work):
        return [f"{sentence}; times are those of the timestamps"]
    return [f"{sentence}; times leave the gaps"]


def stride_notes(work: Work, found: FrameExposures) -> list[str]:
    """A sentence where `--stride` takes one exposure alone of a clip that alternates.

    The start of the clip shows it by its brightness.
    """
    c = work.config
    if c.stride == 1 or len(found.ev) > 1 or work.capture is not None:
        return []
    frames = read_frames(work.footage, c.start, c.start + FRAMES_OF_START, 1, c.max_size)
    own = takewhile(lambda frame: frame.camera_id == 0 and frame.track == 0, frames)
    length = exposure.detect_cycle(np.stack([frame.rgb for frame in own])).length
    if length == 1:
        return []
    kept = max(stride for stride in range(1, c.stride) if math.gcd(stride, length) == 1)
    return [
        f"--stride {c.stride} leaves frames of one exposure, and the clip alternates in a cycle "
        f"of {length}: use --stride {kept}, which keeps all exposures"
    ]


def track_exposures(work: Work, source: str, given: list[float] | None) -> FrameExposures:
    """Exposures of tracks that one camera records at the same times: each has brackets
    of its own, one unless it alternates; `given` EVs may drift from it.
    """
    brackets = own_brackets(work, given)
    if given is None:
        unknown: list[float | None] = [None] * (max(brackets) + 1)
        return FrameExposures(source, brackets, unknown, False, True)
    levels, drift = levels_and_drift(given, brackets)
    drifts = np.ptp(drift) > MIN_DRIFT_EV
    # frames of one time, one track after the other, show the step between tracks
    frames = work.manifest.frames
    side_by_side = sorted(range(len(frames)), key=lambda i: (frames[i].time, frames[i].track))
    notes = contradictions(work, [side_by_side], given)
    return FrameExposures(
        source,
        brackets,
        [*levels],
        True,
        False,
        notes=tuple(notes),
        drift=tuple(drift.tolist()) if drifts else (),
    )


def own_brackets(work: Work, given: list[float] | None) -> list[int]:
    """The bracket of every frame where each camera, and track of it, has brackets of
    its own: one unless it alternates, by the `given` EVs of frames, else by brightness.
    """
    brackets = [0] * len(work.manifest.frames)
    count = 0
    for own in work.camera_frames():
        cycle = cycle_of_line(work, own, given)
        for index, bracket in zip(own, cycle.brackets, strict=True):
            brackets[index] = count + bracket
        count += len(cycle.order)
    return brackets


def levels_and_drift(given: list[float], brackets: list[int]) -> tuple[list[float], np.ndarray]:
    """The mean EV of every bracket, and by how much each frame differs from it."""
    levels = []
    drift = np.array(given)
    for bracket in range(max(brackets) + 1):
        own = np.array(brackets) == bracket
        levels.append(float(drift[own].mean()))
        drift[own] -= drift[own].mean()
    return levels, drift


def drifting_exposures(source: str, given: list[float], brackets: list[int]) -> FrameExposures:
    """Given EVs of frames that are too many for a cycle: the level of their `brackets`,
    and the drift of every frame from its bracket.
    """
    known, drift = levels_and_drift(given, brackets)
    note = f"given exposures drift by {drift.min():+.2f} to {drift.max():+.2f} EV"
    return FrameExposures(
        source, brackets, [*known], True, False, notes=(note,), drift=tuple(drift.tolist())
    )


def given_exposures(work: Work) -> tuple[str, list[float] | None]:
    """Where the EVs of the frames come from, and the EV of each frame.

    The EVs are None where brightness has to show them, or a data set stores brackets.
    """
    c, frames = work.config, work.manifest.frames
    capture, tracks = work.capture, work.manifest.num_tracks
    numbers = work.frame_numbers()
    cycle = parse_exposures(c.exposures, c.ev)
    if cycle is not None and tracks > 1:
        return "flags", track_cycle(work, cycle)
    if cycle is not None:
        gapped = cycle_with_gaps(work, None)
        if gapped is not None and list_period(cycle) == gapped.cycle.length:
            return "flags", [cycle[(c.start + n) % len(cycle)] for n in gapped.slots]
        check_cycle(work, cycle)
        if by_timestamps(work):
            numbers = [c.start + round(f.time * c.stride) for f in frames]
        return "flags", [cycle[n % len(cycle)] for n in numbers]
    if "auto" in (c.exposures, c.ev):
        return "brightness", None
    if capture is not None and capture.parts()["exposures"]:
        if capture.exposures is not None:
            return "data set", None
        stored = [work.picture(f).ev for f in frames]
        return "data set", [ev for ev in stored if ev is not None]
    table = read_exposure_csv(work.footage)
    if table is not None:
        path, rows = table
        return path.name, [
            ev_in_list(path, rows, f.source, n, tracks > 1)
            for f, n in zip(frames, numbers, strict=True)
        ]
    if work.footage.video:
        source, known = GOPRO, gopro_exposures(work)
    else:
        source, known = EXIF, exif_exposures(work)
    if len(known) < len(frames):
        return "brightness", None
    if max(known) - min(known) < MIN_DRIFT_EV:
        say(f"exposure: {source} gives all frames one exposure; brightness decides instead")
        return "brightness", None
    return source, known


def gopro_exposures(work: Work) -> list[float]:
    """The EVs of the frames of videos, where a GoPro wrote them into these."""
    known: list[float] = []
    numbers = work.frame_numbers()
    for own, written in zip(work.camera_frames(), gopro_metadata(work), strict=True):
        if written is not None:
            known += [float(written.ev[numbers[i]]) for i in own]
    return known


def gopro_metadata(work: Work) -> list[GoProFrames | None]:
    """What a GoPro wrote of the frames of each video of the footage."""
    count = max([work.footage.count, *(number + 1 for number in work.frame_numbers())])
    return [read_gopro(files[0], count) for files in work.footage.cameras]


def track_cycle(work: Work, evs: list[float]) -> list[float]:
    """The EV of every frame of tracks of one camera, from one per track."""
    tracks = work.manifest.num_tracks
    if len(evs) != tracks:
        raise InputError(
            f"{len(evs)} exposures listed for {tracks} tracks of one camera; list one per track, "
            "in the order of --same-camera"
        )
    return [evs[f.track] for f in work.manifest.frames]


def exif_exposures(work: Work) -> list[float]:
    """The EVs of the frames whose EXIF has one; prints where only some have."""
    files = work.footage.files
    found = [read_exif_ev(files[f.source]) for f in work.manifest.frames]
    known = [ev for ev in found if ev is not None]
    lost = len(found) - len(known)
    if known and lost:
        say(f"exposure: EXIF of {lost} frames holds no exposure time; brightness decides instead")
    return known


def list_period(cycle: list[float], stride: int = 1) -> int:
    """After how many frames a list of exposures repeats, of which every `stride`th
    counts.
    """
    two_rounds = [cycle[k * stride % len(cycle)] for k in range(2 * len(cycle))]
    return exposure.period(exposure.brackets_by_ev(two_rounds)[0])


def check_cycle(work: Work, cycle: list[float]) -> None:
    """InputError where a list of exposures cannot be the cycle of the frames."""
    frames = work.camera_frames()[0]
    if len(cycle) > len(frames):
        raise InputError(
            f"{len(cycle)} exposures listed for {len(frames)} frames; list one cycle only, "
            "or give `--exposures auto`"
        )
    listed = list_period(cycle, work.config.stride)
    found = cycle_of_line(work, frames)
    if listed % found.length and found.confidence > MIN_CONFIDENCE:
        raise InputError(
            f"{len(cycle)} exposures listed, which repeat every {listed} frames, but the "
            f"brightness repeats every {found.length}; list the exposures of one cycle in the "
            "order of the frames, or give `--exposures auto`"
        )


def cycle_notes(work: Work, cycles: list[exposure.Cycle], group: list[int]) -> list[str]:
    """What the brightness of each camera's frames shows, in sentences.

    `group` (C,): the cameras that are equally exposed.
    """
    notes = []
    if max(group):
        members = [[c for c, own in enumerate(group) if own == g] for g in range(max(group) + 1)]
        listed = ", ".join(str(cameras) for cameras in members)
        notes.append(f"by their brightness, these cameras are equally exposed: {listed}")
        if all(cycle.length == 1 for cycle in cycles):
            return notes
    lengths = [cycle.length for cycle in cycles]
    if len(set(lengths)) > 1:
        notes.append(
            f"the cameras disagree on the length of the cycle ({lengths}); "
            "list the exposures in a CSV"
        )
    for frames, cycle in zip(work.camera_frames(), cycles, strict=True):
        camera = ""
        if len(cycles) > 1:
            camera = f"camera {work.manifest.frames[frames[0]].camera_id}: "
        steps = exposure.brightness_steps(work.video[frames])
        notes.append(camera + cycle_note(cycle, steps))
    return notes


def cycle_note(cycle: exposure.Cycle, steps: np.ndarray) -> str:
    """A sentence on a cycle; `steps` (T-1,) are the EV from frame to frame."""
    if cycle.length > 1:
        first = [cycle.brackets.index(b) for b in cycle.order]
        levels = ", ".join(f"{cycle.ev[b]:.1f}" for b in cycle.order)
        return (
            f"brightness repeats every {cycle.length} frames, from dark to bright frame {first} "
            f"of the cycle, about {levels} EV (gamma 2.2); this explains "
            f"{cycle.confidence:.0%} of its changes"
        )
    change = float(np.abs(steps).mean())
    if change > exposure.MIN_STEP:
        found = exposure.without_cycle(change, len(steps) + 1)
        return f"{found}; give --ev or list the exposures in a CSV if they were set"
    return (
        "no alternation of exposures found; treated as an ordinary clip of one exposure, "
        "unless static points show that it drifts"
    )
