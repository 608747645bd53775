"""The steps of `prepare` that look at the footage alone: frames, and which exposure
each was taken with.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_png
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage import ingest
from hdr_nsff.footage.exposure_lists import (
    parse_exposures,
    read_exif_ev,
    read_exposure_csv,
)
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.scene.scene import FrameEntry, Protocol, Step

MIN_FRAMES = 3


def frames_step(work: Work) -> Step:
    """Decode the chosen frames into `images/`, and check that there is something to see
    on them.
    """
    c, m = work.config, work.manifest
    total = None  # unknown, of a video whose header does not say
    if count := work.footage.count:
        chosen = range(c.start, min(c.end or count, count), c.stride)
        total = len(chosen) * len(work.footage.cameras)
    entries: list[FrameEntry] = []
    extents = []
    for frame in track(
        ingest.read_frames(work.footage, c.start, c.end, c.stride, c.max_size), "frames", total
    ):
        entry = FrameEntry(
            index=len(entries),
            image=f"images/{len(entries):05d}.png",
            source=frame.source,
            time=work.time_of(frame.source, frame.number),
            camera_id=frame.camera_id,
            bracket=0,
        )
        if not (work.folder / entry.image).is_file():
            exact = np.rint(frame.rgb * 255) / 255
            write_png(
                work.folder / entry.image,
                frame.rgb,
                bits=8 if np.abs(frame.rgb - exact).max() < 1e-6 else 16,
            )
        m.height, m.width = frame.rgb.shape[:2]
        ingest.check_frame_size(c.clip, m.width, m.height)
        extents.append(exposure.extent(frame.rgb))
        entries.append(entry)
    times = len({e.time for e in entries})
    if times < MIN_FRAMES:
        raise InputError(
            f"{c.clip}: {times} frame{'s' * (times != 1)} to use; at least {MIN_FRAMES} are needed to see motion"
        )
    if (color := exposure.all_clipped(extents)) is not None:
        raise InputError(
            f"{c.clip}: all frames are {color}; nothing can be learned from them, choose other frames"
        )
    m.frames, m.fps = entries, work.footage.fps / c.stride
    vars(work).pop("video", None)
    linear = (
        "; linear frames, scaled by one constant and encoded as x^(1/2.2)"
        if work.footage.linear
        else ""
    )
    return Step(
        provenance="given", note=f"{len(entries)} frames of {m.width}x{m.height} pixels{linear}"
    )


def exposure_step(work: Work) -> Step:
    """Which frames share an exposure, what the exposures are where that is known, and
    which frames are kept out of training.
    """
    m = work.manifest
    cameras = work.camera_frames()
    source, given = given_exposures(work)
    stored = work.capture.exposures if work.capture is not None and source == "data set" else None
    notes = []
    values: list[float | None]
    if stored is not None:
        brackets, values = [work.picture(f).bracket or 0 for f in m.frames], list(stored.ev)
    elif given is None:
        cycles = [exposure.detect_cycle(work.video[frames]) for frames in cameras]
        brackets = [b for camera in exposure.common_brackets(cycles) for b in camera]
        values = [None] * (max(brackets) + 1)
        notes += found_cycle(work, cycles)
    else:
        brackets, known = exposure.by_value(given)
        notes += [
            d
            for frames in cameras
            for d in exposure.doubts(work.video[frames], [given[i] for i in frames])
        ]
        values = list(known)
    for note in notes[:3]:
        say(f"exposure: {note}")
    m.cycle = exposure.period([brackets[i] for i in cameras[0]])
    m.reference_bracket = (
        stored.reference if stored else exposure.reference_bracket(work.video, brackets)
    )
    gauge = values[m.reference_bracket]
    m.bracket_ev = [None if v is None or gauge is None else v - gauge for v in values]
    m.exposure_given = stored.given if stored else given is not None
    m.protocol = work.config.protocol
    test = kept_out(work)
    if m.protocol is not None:
        check_protocol(m.protocol, brackets, test)
    for f, bracket in zip(m.frames, brackets, strict=True):
        f.bracket, f.ev, f.split = (
            bracket,
            m.bracket_ev[bracket],
            "test" if f.index in test else "train",
        )
    vars(work).pop("equalized", None)
    what = "no alternation" if m.cycle == 1 else f"cycle of {m.cycle}, {len(values)} exposures"
    step: Literal["given", "estimated"] = "given" if stored or given is not None else "estimated"
    details = {"source": source, "doubts": notes}
    return Step(
        provenance=step, note=f"{what} ({source}); {len(test)} frames held out", details=details
    )


def kept_out(work: Work) -> set[int]:
    """Indices of the frames that are kept out of training, by the protocol or every so
    many of each camera.
    """
    c, cycle, cameras = work.config, work.manifest.cycle, work.camera_frames()
    match c.protocol:
        case "novel-view":
            return set()
        case "novel-view-time":
            return {
                frames[k] for frames in cameras for k in ingest.frames_between(len(frames), cycle)
            }
        case None:
            return {
                frames[k]
                for frames in cameras
                for k in ingest.held_out(len(frames), held_out_every(work), cycle)
            }


def held_out_every(work: Work) -> int:
    """Every how many frames are kept out of training; 0 for none, as where a data set
    brings held-out views of its own.
    """
    if work.config.hold_out is not None:
        return work.config.hold_out
    return 0 if work.capture is not None and work.capture.withheld else ingest.HOLD_OUT


def check_protocol(protocol: Protocol, brackets: list[int], test: set[int]) -> None:
    """InputError where the frames that are not kept out (`test`, indices) show fewer
    exposures than all, by their `brackets`.
    """
    shown, trained = set(brackets), {b for i, b in enumerate(brackets) if i not in test}
    if len(trained) < len(shown):
        raise InputError(
            f"--protocol {protocol}: of {len(brackets)} frames it trains on {len(brackets) - len(test)}, which show only {len(trained)} "
            f"of {len(shown)} exposures; use a longer clip, or --hold-out"
        )


def given_exposures(work: Work) -> tuple[str, list[float] | None]:
    """Where the EV of every frame comes from, and the EVs; None where brightness has to
    tell, or a data set stores brackets.
    """
    c, footage, frames = work.config, work.footage, work.manifest.frames
    numbers = [c.start + int(f.time) * c.stride for f in frames]
    cycle = parse_exposures(c.exposures, c.ev)
    if cycle is not None:
        check_length(work, cycle, numbers)
        return "flags", [cycle[n % len(cycle)] for n in numbers]
    if "auto" in (c.exposures, c.ev):
        return "brightness", None
    if (capture := work.capture) is not None and capture.parts()["exposures"]:
        evs = [work.picture(f).ev for f in frames]
        return "data set", None if capture.exposures else [e for e in evs if e is not None]
    if (table := read_exposure_csv(footage)) is not None:
        path, rows = table
        keys = [
            next((k for k in (f.source, Path(f.source).name, f"#{n}") if k in rows), None)
            for f, n in zip(frames, numbers, strict=True)
        ]
        missing = next((f.source for f, k in zip(frames, keys, strict=True) if k is None), None)
        if missing is not None:
            raise InputError(
                f"{path}: no row for frame {missing}; add it, or give `--exposures auto`"
            )
        return path.name, [rows[k] for k in keys if k is not None]
    if not footage.video:
        files = footage.files
        found = [read_exif_ev(files[f.source]) for f in frames]
        known = [v for v in found if v is not None]
        if len(known) == len(found) and max(known) - min(known) >= exposure.MIN_STEP:
            return "EXIF", known
        if known and len(known) < len(found):
            say(
                f"exposure: EXIF of {len(found) - len(known)} frames holds no exposure time; brightness decides instead"
            )
    return "brightness", None


def check_length(work: Work, cycle: list[float], numbers: list[int]) -> None:
    """InputError where a list of exposures cannot be the cycle of these frames."""
    frames = work.camera_frames()[0]
    if len(cycle) > len(frames):
        raise InputError(
            f"{len(cycle)} exposures listed for {len(frames)} frames; list one cycle only, or give `--exposures auto`"
        )
    listed = exposure.period(exposure.by_value([cycle[numbers[i] % len(cycle)] for i in frames])[0])
    found = exposure.detect_cycle(work.video[frames])
    if listed % found.length and found.confidence > 0.8:
        raise InputError(
            f"{len(cycle)} exposures listed, which repeat every {listed} frames, but the brightness repeats every {found.length}; "
            "list the exposures of one cycle in the order of the frames, or give `--exposures auto`"
        )


def found_cycle(work: Work, cycles: list[exposure.Cycle]) -> list[str]:
    """What brightness told, in sentences."""
    notes = []
    for frames, cycle in zip(work.camera_frames(), cycles, strict=True):
        who = f"camera {work.manifest.frames[frames[0]].camera_id}: " if len(cycles) > 1 else ""
        change = float(np.abs(exposure.brightness_steps(work.video[frames])).mean())
        if cycle.length > 1:
            steps = ", ".join(f"{cycle.ev[b]:.1f}" for b in cycle.order)
            first = [cycle.brackets.index(b) for b in cycle.order]
            notes.append(
                f"{who}brightness repeats every {cycle.length} frames, from dark to bright frame {first} of the cycle, about {steps} EV "
                f"(gamma 2.2); this explains {cycle.confidence:.0%} of its changes"
            )
        elif change > exposure.MIN_STEP:
            notes.append(
                f"{who}brightness changes by {change:.1f} EV from frame to frame, but in no cycle of up to {exposure.MAX_CYCLE} frames; "
                "list the exposures in a CSV if they were set"
            )
        else:
            notes.append(
                f"{who}no alternation of exposures found; treated as an ordinary clip of one exposure"
            )
    if len({c.length for c in cycles}) > 1:
        notes.insert(
            0,
            f"the cameras disagree on the length of the cycle ({[c.length for c in cycles]}); list the exposures in a CSV",
        )
    return notes
