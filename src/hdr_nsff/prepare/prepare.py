"""The verb `prepare`: footage, or a public data set, to a scene folder, step by step.

`table.py` lists the steps; `engine.py` runs them. Killing `prepare` loses at most
the unfinished step (of flow, the pair; of structure from motion, the round). The same
command then continues.

What a data set gives replaces an estimate. What it holds out for testing is hidden from
all steps: once the scene is complete, it goes into a truth folder outside of it, for
`evaluate` alone.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

from hdr_nsff.core.errors import InputError, NoSceneError
from hdr_nsff.core.hashes import hash_file
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.notes import ClipPart
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.footage.bars import with_bars
from hdr_nsff.footage.datasets import recognize
from hdr_nsff.footage.datasets.capture import Capture
from hdr_nsff.footage.datasets.held_out import truth_folder, write_truth
from hdr_nsff.footage.exposure_lists import parse_exposures
from hdr_nsff.footage.footage import Footage, open_footage
from hdr_nsff.footage.frame_choice import check_choice, no_frame
from hdr_nsff.footage.ingest import FootageFrame, read_frames
from hdr_nsff.footage.tracks import open_tracks
from hdr_nsff.prepare.check_lists import check_lists
from hdr_nsff.prepare.cut_parts import (
    known_parts,
    longest,
    part_at_cuts,
    part_settings,
    refuse_parts,
    with_exposures_of,
)
from hdr_nsff.prepare.engine import found_manifest
from hdr_nsff.prepare.lens import check_lens_in_turn, given_lenses, known_lenses
from hdr_nsff.prepare.segments import (
    CLIP_FOLDER,
    bring_back_clip,
    check_segments,
    prepare_segments,
)
from hdr_nsff.prepare.steps.footage import MIN_FRAMES, ClipCutsError, check_count
from hdr_nsff.prepare.steps.neural import check_networks
from hdr_nsff.prepare.table import STEPS, run_steps
from hdr_nsff.prepare.work import Part, PrepareConfig, Work
from hdr_nsff.priors.flow.sources import check_flow
from hdr_nsff.scene.manifest import Manifest

MAX_READOUT_MS = 1000

__all__ = ["STEPS", "PrepareConfig", "prepare"]


def prepare(config: PrepareConfig) -> Path:
    """Run every step that is not done; the scene folder, or the folder of scene folders
    with `--segment` and where the picture cuts.

    InputError where the footage or a setting is at fault.
    """
    prepare_scenes(config)
    return config.out


def prepare_scenes(config: PrepareConfig, part_cuts: bool = True) -> list[Path]:
    """The same; the scene folders, more than one with `--segment`, or, with
    `part_cuts`, one for each part of a clip between two cuts.
    """
    with writing_to(config.out), lock_output(config.out):
        if config.segment is not None:
            refuse_parts(config.out)
            check_segments(config)
            return prepare_segments(begin(replace(config, out=config.out / CLIP_FOLDER)))
        bring_back_clip(config.out)
        parts = known_parts(config) if part_cuts else None
        if parts is not None:
            return prepare_parts(config, parts)
        work = begin(config)
        report_data_set(work)
        try:
            run_steps(work, STEPS)
        except ClipCutsError as cuts:
            if not part_cuts:
                raise
            return prepare_parts(config, part_at_cuts(work, cuts))
        capture = work.capture
        if capture is not None and capture.has_held_out:
            place = truth_place(config)
            write_truth(capture, work.manifest, work.own_time, place, config.max_size)
    sheet = config.out / "contact_sheet.png"
    say(f"scene: {config.out}  ({len(work.manifest.frames)} frames, contact sheet {sheet})")
    return [config.out]


def prepare_parts(config: PrepareConfig, parts: list[ClipPart]) -> list[Path]:
    """The scene folders of a clip's `parts`, each prepared as a clip of its own, the
    longest first.

    A part that makes no scene, such as one whose poses are not found, is left out;
    NoSceneError where all are.
    """
    say(f"{config.clip}: the picture cuts; each part becomes a scene of its own")
    settings = part_settings(config, parts)
    first = longest(parts)
    scenes: dict[int, list[Path]] = {}
    refused: dict[int, NoSceneError] = {}
    for k in (first, *(k for k in range(len(parts)) if k != first)):
        part, own = parts[k], settings[k]
        say(f"{own.out.name}: frames {part.start} to {part.end - 1} of the clip")
        if first in scenes and k != first and part.cycle and part.cycle == parts[first].cycle:
            own = with_exposures_of(settings[first].out, part, own)
        try:
            scenes[k] = prepare_scenes(own, part_cuts=False)
        except NoSceneError as error:
            refused[k] = error
            say(f"{own.out.name}: makes no scene: {error}")
    if not scenes:
        raise refused[first]
    for k, reason in sorted(refused.items()):
        say(f"{settings[k].out.name} of {len(parts)} is left out: {reason}")
    return [scene for k in range(len(parts)) for scene in scenes.get(k, [])]


def truth_place(config: PrepareConfig) -> Path:
    """Where the held-out views of a public data set go."""
    if config.truth_out is not None:
        return config.truth_out
    out = config.out if config.out.name not in ("", "..") else config.out.resolve()
    if not out.name:
        raise InputError(f"{config.out}: no place for a scene; name a folder")
    return out.with_name(f"{out.name}_truth")


def held_out_truth(config: PrepareConfig) -> Path | None:
    """The truth folder that `prepare` wrote; None without held-out views."""
    return truth_folder(truth_place(config))


def begin(config: PrepareConfig) -> Work:
    """Open the footage and the scene folder.

    InputError where they do not belong together.
    """
    check_settings(config)
    capture = None if config.same_camera else recognize(config.clip)
    if capture is not None and config.segment is not None:
        raise InputError(
            f"--segment {config.segment:g}: {config.clip} is a public data set, which is "
            "prepared as a whole; leave the option out"
        )
    footage = open_clip(config, capture)
    check_lists(config, footage, capture)
    inputs = {name: hash_file(path) for name, path in track(footage.files.items(), "inputs")}
    found = found_manifest(config)
    if found is not None and found.inputs != inputs:
        if not found.frames:
            found = None  # nothing to lose
        elif found.source != str(config.clip):
            raise InputError(
                f"{config.out}: holds the scene of other footage ({found.source}); "
                "choose another folder"
            )
    if found is not None:
        found.lens = known_lenses(found, config) if found.inputs == inputs else {}
        found.source = str(config.clip)
        found.inputs = inputs
        work = Work(config, footage, found, capture)
        found.lens |= given_lenses(work)
        return work
    height, width = first_frame(config, footage).rgb.shape[:2]
    manifest = Manifest(source=str(config.clip), inputs=inputs, width=width, height=height)
    made = tuple(path for path in (config.out, *config.out.parents) if not path.exists())
    work = Work(config, footage, manifest, capture, made=made)
    manifest.lens = given_lenses(work)
    work.save()
    return work


def first_frame(config: PrepareConfig, footage: Footage) -> FootageFrame:
    """The first frame to use; InputError where there is none, or too few follow."""
    start, stride = config.start, config.stride
    enough = start + MIN_FRAMES * stride
    end = enough if config.end is None else min(enough, config.end)
    chosen = read_frames(footage, start, end, stride, config.max_size)
    first = list(islice(chosen, MIN_FRAMES))
    if not first:
        raise InputError(no_frame(config.clip, start, footage.count))
    if len(footage.cameras) == 1:  # of several, frames are counted once all are read
        check_count(config.clip, len(first))
    return first[0]


def open_clip(config: PrepareConfig, capture: Capture | None) -> Footage:
    """The footage of a data set, of tracks of one camera, or at `config.clip`.

    Black bars are cut off where nothing else is given pixel by pixel.
    """
    if config.same_camera:
        return open_tracks(config.clip, config.same_camera)
    if capture is not None:
        return capture.footage()
    footage = open_footage(config.clip)
    given = (config.poses, config.flow, config.masks, config.mask_points, config.depth)
    if any(isinstance(value, Path) for value in given):
        return footage
    return with_bars(footage, config.start)


def report_data_set(work: Work) -> None:
    """Report which data set was recognized, if any, and which parts of it are used."""
    capture, clip = work.capture, work.config.clip
    if capture is None:
        return
    parts: tuple[Part, ...] = ("poses", "flow", "masks", "depth")
    given: list[str] = [part for part in parts if work.capture_with(part)]
    if capture.parts()["exposures"]:
        given.insert(0, "exposures")
    provided = ", ".join(given) or "pictures alone"
    message = f"{clip}: {capture.layout}, {len(capture.pictures)} pictures, with its own {provided}"
    if capture.has_held_out:
        message += f", held-out views for {truth_place(work.config)}"
    say(message)
    for note in capture.notes:
        say(f"{clip}: {note}")


def check_settings(config: PrepareConfig) -> None:
    """InputError for settings that make no sense whatever the footage is."""
    check_choice(config.start, config.end, config.stride, config.max_size, config.hold_out)
    if config.protocol is not None and config.hold_out is not None:
        raise InputError(
            "--protocol and --hold-out both given, and each decides what is kept out of "
            "training; leave one out"
        )
    parse_exposures(config.exposures, config.ev)
    check_lens_in_turn(config, config.rig or 1)
    if config.readout != "auto" and not 0 <= config.readout <= MAX_READOUT_MS:
        raise InputError(
            f"--readout {config.readout:g}: give the milliseconds from a rolling shutter's first "
            f"row to its last, 0 to {MAX_READOUT_MS}, or auto"
        )
    if config.rig is not None and config.rig < 1:
        raise InputError(f"--rig {config.rig}: give the number of cameras, or 1 for one camera")
    if config.tripod and config.poses is not None:
        raise InputError("--tripod and --poses both given; leave one out")
    if config.matcher != "sift" and (config.tripod or config.poses is not None):
        option = "--tripod" if config.tripod else "--poses"
        raise InputError(
            f"--matcher {config.matcher}: no keypoints are matched with {option}; leave one out"
        )
    if truth_place(config).resolve().is_relative_to(config.out.resolve()):
        raise InputError(
            f"--truth-out {config.truth_out}: inside the scene folder, where training reads; "
            "choose a place outside"
        )
    pick_device(config.device)
    check_flow(config.flow, config.flow_weights, config.semantic)
    given = {
        "poses": config.poses,
        "mask": config.masks,
        "depth": config.depth,
        "mask-points": config.mask_points,
    }
    for option, path in given.items():
        if isinstance(path, Path) and not path.exists():
            raise InputError(
                f"--{option} {path}: no such file or folder; "
                "correct the path, or leave the option out to estimate it"
            )
        if isinstance(path, Path) and path.is_file() and option in ("mask", "depth"):
            raise InputError(f"--{option} {path}: is a file; name the folder that holds it")
    check_networks(config)
