"""The steps of `prepare` that need the footage alone: frames, and the exposure of each.

Exposures come from the command line, a data set, a CSV or EXIF, in this order; where
none of these has them, frames of one exposure are found by their brightness, and
training learns the exposures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage import ingest
from hdr_nsff.footage.cuts import find_cuts
from hdr_nsff.footage.exposure_lists import (
    parse_exposures,
    read_exif_ev,
    read_exposure_csv,
)
from hdr_nsff.footage.gpmf import read_gopro_ev
from hdr_nsff.footage.turns import find_cameras_in_turn
from hdr_nsff.prepare.lens import describe, undistorted
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.scene.manifest import FrameEntry, Protocol, bracket_problem

MIN_FRAMES = 3  # fewer show no motion
MAX_ROUNDING_8_BIT = 1e-6  # off whole codes of 8 bits up to which 8 bits hold a picture
MAX_LISTED_CUTS = 5  # in a message
MAX_NOTES = 3  # that are printed; the rest is in scene.json
# confidence of a cycle by brightness from which it refutes a list (hand-chosen)
MIN_CONFIDENCE = 0.8
GOPRO = "GoPro's metadata"  # as a source of exposures
MIN_DRIFT_EV = 0.02  # of such exposures; below it, they are one


# Frames


def frames_step(work: Work) -> StepResult:
    """Decode the chosen frames into `images/`, and check that they show something."""
    c, m = work.config, work.manifest
    entries: list[FrameEntry] = []
    extents = []
    frames = ingest.read_frames(work.footage, c.start, c.end, c.stride, c.max_size)
    for frame in track(frames, "frames", expected_frames(work)):
        m.height, m.width = frame.rgb.shape[:2]
        ingest.check_frame_size(c.clip, m.width, m.height)
        entry = FrameEntry(
            index=len(entries),
            image=f"images/{len(entries):05d}.png",
            source=frame.source,
            time=work.time_of(frame.source, frame.number),
            camera_id=frame.camera_id,
            bracket=0,
        )
        bits: Literal[8, 16] = 8 if fits_8_bits(frame.rgb) else 16
        rgb = undistorted(work, frame.rgb, frame.camera_id)
        write_frame(work.folder / entry.image, rgb, bits)
        entries.append(entry)
        extents.append(exposure.extent(frame.rgb))
    check_frames(c.clip, entries, extents)
    m.fps = work.footage.fps / c.stride
    if [identity(f) for f in m.frames] != [identity(f) for f in entries]:
        m.frames = entries  # else the results of later steps for these frames stay
    note = f"{len(entries)} frames of {m.width}x{m.height} pixels"
    if work.footage.linear:
        note += "; linear frames, scaled by one constant and encoded as x^(1/2.2)"
    if work.footage.transfer is not None:
        kind = work.footage.transfer.upper()
        note += f"; {kind} by its tags, brought to linear light and encoded as x^(1/2.2)"
    if m.lens:
        note += f", undistorted ({describe(m.lens)})"
    return StepResult(provenance="given", note=note)


def identity(entry: FrameEntry) -> tuple[int, str, float, int]:
    """What makes a frame of the scene the same frame."""
    return entry.index, entry.source, entry.time, entry.camera_id


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


def check_frames(clip: Path, entries: list[FrameEntry], extents: list[tuple[float, float]]) -> None:
    """InputError where frames are too few, or all black or white.

    `extents` are the recorded values between which nearly all of each frame lies.
    """
    times = len({entry.time for entry in entries})
    if times < MIN_FRAMES:
        raise InputError(
            f"{clip}: {times} frame{'s' * (times != 1)} to use; at least {MIN_FRAMES} are "
            "needed to see motion"
        )
    color = exposure.all_clipped(extents)
    if color is not None:
        raise InputError(
            f"{clip}: all frames are {color}; nothing can be learned from them, choose other frames"
        )


# Exposures


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


def exposure_step(work: Work) -> StepResult:
    """Give each frame its exposure, and choose the frames to hold out of training."""
    m = work.manifest
    found = frame_exposures(work)
    for note in found.notes[:MAX_NOTES]:
        say(f"exposure: {note}")
    m.cycle = exposure.period([found.brackets[i] for i in work.camera_frames()[0]])
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
    for frame, bracket in zip(m.frames, found.brackets, strict=True):
        frame.bracket = bracket
        frame.ev = m.bracket_ev[bracket]
        frame.drift = found.drift[frame.index] if found.drift else None
        frame.split = "test" if frame.index in held_out else "train"
    work.forget(("equalized",))
    m.rig = cameras_in_turn(work)
    if m.rig == 1:
        check_cuts(work)
    cycle = "no alternation"
    if m.cycle > 1:
        cycle = f"cycle of {m.cycle}, {len(found.ev)} exposures"
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


def relative_to(ev: list[float | None], reference: int) -> list[float | None]:
    """EVs per bracket relative to a bracket; None for all where that one is unknown."""
    gauge = ev[reference]
    return [None if v is None or gauge is None else v - gauge for v in ev]


def frame_exposures(work: Work) -> FrameExposures:
    """The exposures of all frames, as given, or by brightness."""
    capture, frames = work.capture, work.manifest.frames
    source, given = given_exposures(work)
    if capture is not None and capture.exposures is not None and source == "data set":
        stored = capture.exposures
        brackets = [work.picture(frame).bracket or 0 for frame in frames]
        return FrameExposures(
            source, brackets, list(stored.ev), stored.given, False, stored.reference
        )
    cameras = work.camera_frames()
    if given is None:
        cycles = [exposure.detect_cycle(work.video[own]) for own in cameras]
        brackets = [b for camera in exposure.common_brackets(cycles) for b in camera]
        unknown: list[float | None] = [None] * (max(brackets) + 1)
        notes = cycle_notes(work, cycles)
        return FrameExposures(source, brackets, unknown, False, True, notes=tuple(notes))
    many = len(exposure.brackets_by_ev(given)[1]) > exposure.MAX_CYCLE
    if source == GOPRO or (many and len(cameras) == 1):
        return drifting_exposures(source, given)
    brackets, known = exposure.brackets_by_ev(given)
    doubts = []
    for own in cameras:
        doubts += exposure.contradictions(work.video[own], [given[i] for i in own])
    return FrameExposures(source, brackets, [*known], True, False, notes=tuple(doubts))


def drifting_exposures(source: str, given: list[float]) -> FrameExposures:
    """Given EVs of frames that are too many for a cycle: brackets of one where they
    alternate, and the drift of every frame from its bracket.
    """
    brackets = exposure.cycle_of_steps(np.diff(given)).brackets
    known: list[float | None] = []
    drift = np.array(given)
    for bracket in range(max(brackets) + 1):
        own = np.array(brackets) == bracket
        known.append(float(drift[own].mean()))
        drift[own] -= drift[own].mean()
    note = f"given exposures drift by {drift.min():+.2f} to {drift.max():+.2f} EV"
    return FrameExposures(
        source, brackets, known, True, False, notes=(note,), drift=tuple(drift.tolist())
    )


def given_exposures(work: Work) -> tuple[str, list[float] | None]:
    """Where the EVs of the frames come from, and the EV of each frame.

    The EVs are None where brightness has to show them, or a data set stores brackets.
    """
    c, frames = work.config, work.manifest.frames
    capture = work.capture
    numbers = [c.start + int(f.time) * c.stride for f in frames]
    cycle = parse_exposures(c.exposures, c.ev)
    if cycle is not None:
        check_cycle(work, cycle, numbers)
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
            csv_exposure(path, rows, f, n) for f, n in zip(frames, numbers, strict=True)
        ]
    if work.footage.video:
        source, known, least_change = GOPRO, gopro_exposures(work, numbers), MIN_DRIFT_EV
    else:
        source, known, least_change = "EXIF", exif_exposures(work), exposure.MIN_STEP
    if len(known) == len(frames) and max(known) - min(known) >= least_change:
        return source, known
    return "brightness", None


def gopro_exposures(work: Work, numbers: list[int]) -> list[float]:
    """The EVs of the frames `numbers` of a video, where a GoPro wrote them into it."""
    written = read_gopro_ev(work.footage.path, work.footage.count or 0)
    return [] if written is None else written[numbers].tolist()


def csv_exposure(path: Path, rows: dict[str, float], frame: FrameEntry, number: int) -> float:
    """The EV of a frame in the `rows` of a CSV, by its name or `number`."""
    for key in (frame.source, Path(frame.source).name, f"#{number}"):
        if key in rows:
            return rows[key]
    raise InputError(f"{path}: no row for frame {frame.source}; add it, or give `--exposures auto`")


def exif_exposures(work: Work) -> list[float]:
    """The EVs of the frames whose EXIF has one; prints where only some have."""
    files = work.footage.files
    found = [read_exif_ev(files[f.source]) for f in work.manifest.frames]
    known = [ev for ev in found if ev is not None]
    lost = len(found) - len(known)
    if known and lost:
        say(f"exposure: EXIF of {lost} frames holds no exposure time; brightness decides instead")
    return known


def check_cycle(work: Work, cycle: list[float], numbers: list[int]) -> None:
    """InputError where a list of exposures cannot be the cycle of these frames.

    `numbers` are the positions of the frames in the footage of their camera.
    """
    frames = work.camera_frames()[0]
    if len(cycle) > len(frames):
        raise InputError(
            f"{len(cycle)} exposures listed for {len(frames)} frames; list one cycle only, "
            "or give `--exposures auto`"
        )
    brackets, _ = exposure.brackets_by_ev([cycle[numbers[i] % len(cycle)] for i in frames])
    listed = exposure.period(brackets)
    found = exposure.detect_cycle(work.video[frames])
    if listed % found.length and found.confidence > MIN_CONFIDENCE:
        raise InputError(
            f"{len(cycle)} exposures listed, which repeat every {listed} frames, but the "
            f"brightness repeats every {found.length}; list the exposures of one cycle in the "
            "order of the frames, or give `--exposures auto`"
        )


def cycle_notes(work: Work, cycles: list[exposure.Cycle]) -> list[str]:
    """What the brightness of each camera's frames shows, in sentences."""
    notes = []
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
        notes.append(camera + cycle_note(cycle, float(np.abs(steps).mean())))
    return notes


def cycle_note(cycle: exposure.Cycle, change: float) -> str:
    """A sentence on a cycle; `change` is the mean EV from frame to frame."""
    if cycle.length > 1:
        first = [cycle.brackets.index(b) for b in cycle.order]
        levels = ", ".join(f"{cycle.ev[b]:.1f}" for b in cycle.order)
        return (
            f"brightness repeats every {cycle.length} frames, from dark to bright frame {first} "
            f"of the cycle, about {levels} EV (gamma 2.2); this explains "
            f"{cycle.confidence:.0%} of its changes"
        )
    if change > exposure.MIN_STEP:
        return (
            f"brightness changes by {change:.1f} EV from frame to frame, but in no cycle of up "
            f"to {exposure.MAX_CYCLE} frames; list the exposures in a CSV if they were set"
        )
    return (
        "no alternation of exposures found; treated as an ordinary clip of one exposure, "
        "unless static points show that it drifts"
    )


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
    return given


def check_cuts(work: Work) -> None:
    """InputError where the picture cuts to another scene."""
    c = work.config
    if work.capture is not None:
        return
    for own in work.camera_frames():
        cuts = find_cuts(work.equalized[0][own])
        if not cuts:
            continue
        numbers = [c.start + int(work.manifest.frames[own[k]].time) * c.stride for k in cuts]
        places = ", ".join(f"{n - c.stride} and {n}" for n in numbers[:MAX_LISTED_CUTS])
        first = numbers[0]
        raise InputError(
            f"{c.clip}: the picture cuts between frames {places}; prepare the parts one by "
            f"one, the first with `--end {first}`, the next with `--start {first}`"
        )


# Frames to hold out


def frames_to_hold_out(work: Work) -> set[int]:
    """Indices of the frames to hold out of training, chosen camera by camera."""
    cycle = work.manifest.cycle
    chosen: set[int] = set()
    for frames in work.camera_frames():
        match work.config.protocol:
            case "novel-view":
                numbers = []
            case "novel-view-time":
                numbers = ingest.frames_between(len(frames), cycle)
            case None:
                numbers = ingest.hold_out_every(len(frames), hold_out_spacing(work), cycle)
        chosen.update(frames[k] for k in numbers)
    return chosen


def hold_out_spacing(work: Work) -> int:
    """Every this many frames are held out of training; 0 for none.

    None are where a data set brings held-out views of its own.
    """
    if work.config.hold_out is not None:
        return work.config.hold_out
    brings_views = work.capture is not None and work.capture.has_held_out
    return 0 if brings_views else ingest.HOLD_OUT


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
