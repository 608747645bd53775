"""The steps of `prepare` that need the footage alone: frames, and their exposures."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError, NoSceneError
from hdr_nsff.core.images import write_png
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage.cuts import find_cuts
from hdr_nsff.footage.footage import TRANSFER_NAMES
from hdr_nsff.footage.frame_choice import check_frame_size
from hdr_nsff.footage.hold_out import HOLD_OUT, frames_between, hold_out_every
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.footage.turns import find_cameras_in_turn
from hdr_nsff.geometry.poses import format_ranges
from hdr_nsff.prepare.exposure_times import exposure_times
from hdr_nsff.prepare.exposures import frame_exposures
from hdr_nsff.prepare.length import offered_segments
from hdr_nsff.prepare.lens import check_lens_in_turn, describe, undistorted
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.times import (
    by_timestamps,
    frame_rate,
    frame_seconds,
    leave_gaps,
    times_of_slots,
)
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.radiometry.dropped_frames import period_in_time
from hdr_nsff.scene.manifest import FrameEntry, Protocol, bracket_problem

MIN_FRAMES = 3  # fewer show no motion
MAX_ROUNDING_8_BIT = 1e-6  # off whole codes of 8 bits up to which 8 bits hold a picture
MAX_LISTED_CUTS = 5  # in a message
MAX_NOTES = 3  # that are printed; the rest is in scene.json


# Frames


def frames_step(work: Work) -> StepResult:
    """Decode the chosen frames into `images/`, and check that they show something."""
    c, m = work.config, work.manifest
    if work.footage.interlaced:
        say(f"frames: {work.footage.interlacing()}")
    entries: list[FrameEntry] = []
    extents = []
    seconds: list[float | None] = []
    frames = read_frames(work.footage, c.start, c.end, c.stride, c.max_size)
    for frame in track(frames, "frames", expected_frames(work)):
        m.height, m.width = frame.rgb.shape[:2]
        check_frame_size(c.clip, m.width, m.height)
        entry = FrameEntry(
            index=len(entries),
            image=f"images/{len(entries):05d}.png",
            source=frame.source,
            time=work.time_of(frame.source, frame.number),
            camera_id=frame.camera_id,
            track=frame.track,
            bracket=0,
        )
        bits: Literal[8, 16] = 8 if fits_8_bits(frame.rgb) else 16
        rgb = undistorted(work, frame.rgb, frame.camera_id)
        write_frame(work.folder / entry.image, rgb, bits)
        entries.append(entry)
        seconds.append(frame.seconds)
        extents.append(exposure.extent(frame.rgb))
    check_frames(c.clip, entries, extents)
    empty = empty_frames(extents)
    if empty:
        say(f"frames: {empty}; leave them out (--start, --end) or give --ev")
    if work.footage.video:
        check_lengths(c.clip, entries)
    m.frame_seconds = frame_seconds(work, entries, seconds)
    m.fps = frame_rate(work, entries, seconds)
    missing = leave_gaps(work, entries, seconds)
    m.stride = c.stride
    with_time = work.capture is not None  # of other footage, it may have gaps by the cycle
    if [identity(f, with_time) for f in m.frames] != [identity(f, with_time) for f in entries]:
        m.frames = entries  # else the results of later steps for these frames stay
    elif missing:
        for kept, entry in zip(m.frames, entries, strict=True):
            kept.time = entry.time
    note = f"{len(entries)} frames of {m.width}x{m.height} pixels"
    if work.footage.linear:
        note += "; linear frames, scaled by one constant and encoded as x^(1/2.2)"
    if work.footage.transfer is not None:
        kind = TRANSFER_NAMES[work.footage.transfer]
        note += f"; {kind} by its tags, brought to linear light and encoded as x^(1/2.2)"
    if work.footage.bars:
        note += f"; {work.footage.bars.sentence()}"
    if m.lens:
        note += f", undistorted ({describe(m.lens)})"
    if missing:
        note += f"; {missing} are missing by the timestamps, and their times are left out"
    if c.segment is None and work.capture is None:
        offer = offered_segments(len(entries), m.width * m.height, m.fps)
        if offer is not None:
            note += f"; {offer.sentence(len(entries))}; {offer.advice('hdr-nsff prepare')}"
    return StepResult(provenance="given", note=note, details={"missing": missing})


def identity(entry: FrameEntry, with_time: bool) -> tuple[int, str, float, int, int]:
    """What makes a frame of the scene the same frame."""
    time = entry.time if with_time else 0.0
    return entry.index, entry.source, time, entry.camera_id, entry.track


def expected_frames(work: Work) -> int | None:
    """The number of frames to decode; None for a video without a count."""
    c = work.config
    count = work.footage.count
    if not count:
        return None
    stop = min(c.end or count, count)
    return len(range(c.start, stop, c.stride)) * len(work.footage.cameras)


def write_frame(path: Path, rgb: np.ndarray, bits: Literal[8, 16]) -> None:
    """Write a frame (H, W, 3). A file that is there already stays."""
    if not path.is_file():
        write_png(path, rgb, bits=bits)


def fits_8_bits(rgb: np.ndarray) -> bool:
    """Whether 8 bits hold a frame (H, W, 3) in [0, 1]."""
    return bool(np.abs(rgb - np.rint(rgb * 255) / 255).max() < MAX_ROUNDING_8_BIT)


def check_count(clip: Path, times: int) -> None:
    """InputError where frames of so few `times` are chosen that they show no motion."""
    if times < MIN_FRAMES:
        raise InputError(
            f"{clip}: {times} frame{'s' * (times != 1)} to use; at least {MIN_FRAMES} are "
            "needed to see motion; give a longer clip, or correct --start, --end, --stride"
        )


def check_frames(clip: Path, entries: list[FrameEntry], extents: list[tuple[float, float]]) -> None:
    """InputError where frames are too few; NoSceneError where all are black or white.

    `extents` are the recorded values between which nearly all of each frame lies.
    """
    check_count(clip, len({entry.time for entry in entries}))
    color = exposure.all_clipped(extents)
    if color is not None:
        raise NoSceneError(
            f"{clip}: all frames are {color}; nothing can be learned from them, choose other frames"
        )


def empty_frames(extents: list[tuple[float, float]]) -> str:
    """A sentence on the frames that are black or white all over, "" without any;
    `extents` as for `check_frames`.
    """
    colors = [exposure.all_clipped([extent]) for extent in extents]
    found = []
    for color in ("black", "white"):
        numbers = [i for i, own in enumerate(colors) if own == color]
        if numbers:
            found.append(f"{format_ranges(numbers)} {color} all over")
    if not found:
        return ""
    listed = " and ".join(found)
    return f"of {len(extents)} frames, counted from 0, {listed}, which can hide a cycle"


def check_lengths(clip: Path, entries: list[FrameEntry]) -> None:
    """InputError where cameras, or tracks of one, have different numbers of frames, of
    videos whose headers have none.
    """
    counts = Counter((entry.camera_id, entry.track) for entry in entries)
    if len(set(counts.values())) > 1:
        found = " and ".join(map(str, counts.values()))
        raise InputError(
            f"{clip}: its videos have {found} frames; synchronized cameras and tracks need the "
            "same number each, cut all to the same moments"
        )


# Exposures


def exposure_step(work: Work) -> StepResult:
    """Give each frame its exposure, and choose the frames to hold out of training."""
    m = work.manifest
    found = frame_exposures(work)
    for note in found.notes[:MAX_NOTES]:
        say(f"exposure: {note}")
    m.cycle = found.cycle or cycle_length(work, found.brackets)
    if found.reference is None:
        m.reference_bracket = exposure.reference_bracket(work.video, found.brackets)
    else:
        m.reference_bracket = found.reference
    m.bracket_ev = relative_to(found.ev, m.reference_bracket)
    problem = bracket_problem(found.brackets, m.bracket_ev, m.reference_bracket)
    if problem is not None:
        raise InputError(f"{work.config.clip}: exposures by {found.source}: {problem}; correct it")
    m.exposure_given = found.given
    m.protocol = work.config.protocol
    held_out = frames_to_hold_out(work)
    if m.protocol is not None:
        check_protocol(m.protocol, found.brackets, held_out)
    for frame, time in zip(m.frames, times_of_slots(work, found.slots), strict=True):
        frame.time = time
    for frame, seconds in zip(m.frames, exposure_times(work, found), strict=True):
        frame.exposure_time = seconds
    for frame, bracket in zip(m.frames, found.brackets, strict=True):
        frame.bracket = bracket
        frame.ev = m.bracket_ev[bracket]
        frame.drift = found.drift[frame.index] if found.drift else None
        frame.split = "test" if frame.index in held_out else "train"
    work.forget(("equalized",))
    m.rig = cameras_in_turn(work)
    if m.rig > 1:
        held_out = frames_to_hold_out(work, m.rig)
        for frame in m.frames:
            frame.split = "test" if frame.index in held_out else "train"
        work.forget(("equalized",))
    check_lens_in_turn(work.config, m.rig)
    if m.rig == 1:
        check_cuts(work)
    cycle = "no alternation"
    if m.cycle > 1:
        cycle = f"cycle of {m.cycle}, {len(found.ev)} exposures"
    if m.num_tracks > 1:
        cycle = f"{m.num_tracks} tracks of one camera, {len(found.ev)} exposures"
    if m.rig > 1:
        cycle = f"{m.rig} cameras in turn, {cycle}"
    return StepResult(
        provenance="estimated" if found.estimated else "given",
        note=f"{cycle} ({found.source}); {len(held_out)} frames held out",
        details={
            "source": found.source,
            "doubts": list(found.notes),
            "drift_given": bool(found.drift),
            "every_frame_given": found.given and found.source != "flags",
        },
    )


def cycle_length(work: Work, brackets: list[int]) -> int:
    """The length of the exposure cycle of the first camera, across the gaps that
    timestamps show, by the `brackets` of all frames.
    """
    own = work.camera_frames()[0]
    if by_timestamps(work):
        times = [work.manifest.frames[i].time for i in own]
        return period_in_time([brackets[i] for i in own], times)
    return exposure.period([brackets[i] for i in own])


def relative_to(ev: list[float | None], reference: int) -> list[float | None]:
    """EVs per bracket relative to a bracket; None for all where that one is unknown."""
    gauge = ev[reference]
    return [None if v is None or gauge is None else v - gauge for v in ev]


# Rigs, and cuts


def cameras_in_turn(work: Work) -> int:
    """How many still cameras took the frames in turn, given or found; 1: no rig."""
    given, count = work.config.rig, len(work.manifest.frames)
    if work.manifest.num_cameras > 1:
        if given is not None and given > 1:
            raise InputError(
                f"--rig {given}: {work.config.clip} has a folder per camera already; "
                "leave the option out"
            )
        return 1
    if work.manifest.num_tracks > 1:
        if given is not None and given > 1:
            raise InputError(
                f"--rig {given}: the frames of --same-camera are those of one camera; "
                "leave one of both out"
            )
        return 1
    if given is None:
        found = find_cameras_in_turn(work.equalized[0])
        if found > 1:
            say(f"exposure: {found} still cameras take the frames in turn (--rig 1 if not)")
        return found
    if 2 * given > count:
        raise InputError(
            f"--rig {given}: only {count} frames; each camera needs at least two, "
            "to separate movers from the static scene; correct the number"
        )
    seen = {round(f.time) % given for f in work.manifest.frames}
    if len(seen) < given:
        absent = min(set(range(given)) - seen)
        raise InputError(
            f"--rig {given}: of camera {absent}, counted from 0, all frames are missing by their "
            "times; correct the number, --stride, or the times in the list of exposures"
        )
    return given


class ClipCutsError(NoSceneError):
    """The picture cuts to another scene."""

    def __init__(self, problem: str, first: list[int]) -> None:
        """`first`: the numbers of the frames after the cuts, in the footage."""
        super().__init__(problem)
        self.first = first


def check_cuts(work: Work) -> None:
    """ClipCutsError where the picture cuts to another scene."""
    c = work.config
    if work.capture is not None:
        return
    for own in work.camera_frames():
        cuts = find_cuts(work.equalized[0][own])
        if not cuts:
            continue
        all_numbers = work.frame_numbers()
        numbers = [all_numbers[own[k]] for k in cuts]
        places = ", ".join(f"{n - c.stride} and {n}" for n in numbers[:MAX_LISTED_CUTS])
        first = numbers[0]
        raise ClipCutsError(
            f"{c.clip}: the picture cuts between frames {places}; prepare the parts one by "
            f"one, the first with `--end {first}`, the next with `--start {first}`",
            numbers,
        )


# Frames to hold out


def frames_to_hold_out(work: Work, rig: int = 1) -> set[int]:
    """Indices of the frames to hold out of training, chosen camera by camera. Of a
    `rig` whose cameras take turns, the default takes frames of all in turn.
    """
    cycle = work.manifest.cycle
    turns = rig if work.config.hold_out is None else 1
    chosen: set[int] = set()
    for frames in work.camera_frames():
        match work.config.protocol:
            case "novel-view":
                numbers = []
            case "novel-view-time":
                numbers = frames_between(len(frames), cycle)
            case None:
                numbers = hold_out_every(len(frames), hold_out_spacing(work), cycle * turns)
        chosen.update(frames[k] for k in numbers)
    return chosen


def hold_out_spacing(work: Work) -> int:
    """Every this many frames are held out of training; 0 for none.

    None are where a data set brings held-out views of its own.
    """
    if work.config.hold_out is not None:
        return work.config.hold_out
    brings_views = work.capture is not None and work.capture.has_held_out
    return 0 if brings_views else HOLD_OUT


def check_protocol(protocol: Protocol, brackets: list[int], held_out: set[int]) -> None:
    """InputError where the frames that are left show fewer exposures than all.

    `brackets` are those of all frames, `held_out` the indices of the others.
    """
    shown = set(brackets)
    trained = {bracket for i, bracket in enumerate(brackets) if i not in held_out}
    if len(trained) < len(shown):
        raise InputError(
            f"--protocol {protocol}: of {len(brackets)} frames it trains on "
            f"{len(brackets) - len(held_out)}, which show only {len(trained)} of {len(shown)} "
            "exposures; use a longer clip, or --hold-out"
        )
