"""The verb `prepare`: footage, or a public data set, to a scene folder, step by step.

`STEPS` is the table of steps; `engine.py` runs them. Killing `prepare` loses at most
the unfinished step (of flow, the pair; of structure from motion, the round). The same
command then continues.

What a data set gives replaces an estimate. What it holds out for testing is hidden from
all steps: once the scene is complete, it goes into a truth folder outside of it, for
`evaluate` alone.
"""

from __future__ import annotations

from pathlib import Path

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import is_leftover, writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.footage import ingest
from hdr_nsff.footage.datasets import recognize
from hdr_nsff.footage.datasets.capture import Capture
from hdr_nsff.footage.datasets.held_out import truth_folder, write_truth
from hdr_nsff.footage.exposure_lists import parse_exposures
from hdr_nsff.footage.tracks import open_tracks
from hdr_nsff.prepare.engine import Step, all_have, run_step
from hdr_nsff.prepare.lens import (
    DistortedFramesError,
    describe,
    given_lenses,
    known_lenses,
    parse_lens,
)
from hdr_nsff.prepare.steps import footage as on_footage
from hdr_nsff.prepare.steps.depth import find_depth
from hdr_nsff.prepare.steps.flow import find_flow
from hdr_nsff.prepare.steps.masks import find_masks
from hdr_nsff.prepare.steps.movers import find_movers
from hdr_nsff.prepare.steps.neural import check_networks
from hdr_nsff.prepare.steps.poses import find_poses
from hdr_nsff.prepare.steps.refined_flow import refine_flow
from hdr_nsff.prepare.steps.response import find_response
from hdr_nsff.prepare.steps.sheet import draw_sheet
from hdr_nsff.prepare.steps.static_depth import find_static_depth
from hdr_nsff.prepare.work import Part, PrepareConfig, StepName, Work
from hdr_nsff.priors.flow.sources import check_flow
from hdr_nsff.scene.manifest import LensEntry, Manifest

__all__ = ["PrepareConfig", "prepare"]


def prepare(config: PrepareConfig) -> Path:
    """Run every step that is not done; the scene folder.

    InputError where the footage or a setting is at fault.
    """
    with writing_to(config.out), lock_output(config.out):
        work = begin(config)
        report_data_set(work)
        run_steps(work)
        capture = work.capture
        if capture is not None and capture.has_held_out:
            place = truth_place(config)
            write_truth(capture, work.manifest, work.own_time, place, config.max_size)
    sheet = config.out / "contact_sheet.png"
    say(f"scene: {config.out}  ({len(work.manifest.frames)} frames, contact sheet {sheet})")
    return config.out


def run_steps(work: Work) -> None:
    """Run every step that is not done; once more from the frames where these turn out
    to be distorted.
    """
    try:
        for name, step in STEPS.items():
            run_step(work, name, step)
    except DistortedFramesError as found:
        given = work.config.lens_distortion != "auto"
        lenses = {c: LensEntry.of(lens, given) for c, lens in found.lenses.items()}
        say(f"poses: the lens distorts ({describe(lenses)}); frames are undistorted, once")
        work.manifest.lens = lenses
        work.save()
        work.forget(("codes", "equalized", "raw_flows"))
        for name, step in STEPS.items():
            run_step(work, name, step)


def truth_place(config: PrepareConfig) -> Path:
    """Where the held-out views of a public data set go."""
    return config.truth_out or config.out.with_name(f"{config.out.name}_truth")


def held_out_truth(config: PrepareConfig) -> Path | None:
    """The truth folder that `prepare` wrote; None without held-out views."""
    return truth_folder(truth_place(config))


def begin(config: PrepareConfig) -> Work:
    """Open the footage and the scene folder.

    InputError where they do not belong together.
    """
    check_settings(config)
    capture = None if config.same_camera else recognize(config.clip)
    footage = open_clip(config, capture)
    inputs = {name: ingest.hash_file(path) for name, path in track(footage.files.items(), "inputs")}
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
    start = config.start
    first = next(ingest.read_frames(footage, start, start + 1, 1, config.max_size), None)
    if first is None:
        raise InputError(f"{config.clip}: no frame {start}; choose a smaller `--start`")
    height, width = first.rgb.shape[:2]
    manifest = Manifest(source=str(config.clip), inputs=inputs, width=width, height=height)
    work = Work(config, footage, manifest, capture)
    manifest.lens = given_lenses(work)
    work.save()
    return work


def open_clip(config: PrepareConfig, capture: Capture | None) -> ingest.Footage:
    """The footage of a data set, of tracks of one camera, or at `config.clip`."""
    if config.same_camera:
        return open_tracks(config.clip, config.same_camera)
    return capture.footage() if capture else ingest.open_footage(config.clip)


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


def found_manifest(config: PrepareConfig) -> Manifest | None:
    """The manifest in the output folder; None where it is missing or to be redone.

    A broken one is redone where `--redo frames` asks for it.
    """
    if not config.out.exists():
        return None
    if not config.out.is_dir():
        raise InputError(f"{config.out}: is a file; choose a folder to write the scene to")
    if not (config.out / "scene.json").exists():
        if not all(is_leftover(path) for path in config.out.iterdir()):
            raise InputError(
                f"{config.out}: holds other files and no scene; choose an empty or new folder"
            )
        return None
    try:
        found = Manifest.load(config.out)
        if [f.index for f in found.frames] != list(range(len(found.frames))):
            raise InputError(
                f"{config.out / 'scene.json'}: frames are missing or out of order; "
                "restore it or use `--redo frames`"
            )
        return found
    except InputError:
        if "frames" not in config.redo:
            raise
        return None


def check_settings(config: PrepareConfig) -> None:
    """InputError for settings that make no sense whatever the footage is."""
    ingest.check_choice(config.start, config.end, config.stride, config.max_size, config.hold_out)
    if config.protocol is not None and config.hold_out is not None:
        raise InputError(
            "--protocol and --hold-out both given, and each decides what is kept out of "
            "training; leave one out"
        )
    parse_exposures(config.exposures, config.ev)
    parse_lens(config.lens_distortion)
    if config.rig is not None and config.rig < 1:
        raise InputError(f"--rig {config.rig}: give the number of cameras, or 1 for one camera")
    if truth_place(config).resolve().is_relative_to(config.out.resolve()):
        raise InputError(
            f"--truth-out {config.truth_out}: inside the scene folder, where training reads; "
            "choose a place outside"
        )
    pick_device(config.device)
    check_flow(config.flow, config.flow_weights)
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
    check_networks(config)


STEPS: dict[StepName, Step] = {
    "frames": Step(
        on_footage.frames_step,
        settings=("start", "end", "stride", "max_size", "same_camera"),
        outputs=("images",),
        complete=all_have("image"),
        forgets=("codes", "equalized"),
    ),
    "exposure": Step(
        on_footage.exposure_step,
        needs=("frames",),
        settings=("exposures", "ev", "hold_out", "protocol", "rig"),
        forgets=("equalized", "visits"),
    ),
    "flow": Step(
        find_flow,
        needs=("exposure",),
        settings=("flow", "flow_weights", "semantic"),
        outputs=("raw_flow",),
        complete=all_have("raw_flow"),
        forgets=("raw_flows", "refined_flows"),
    ),
    "poses": Step(
        find_poses,
        needs=("flow",),
        settings=("poses", "masks", "matcher"),
        outputs=("poses", "points.npy"),
        complete=all_have("c2w"),
    ),
    "masks": Step(
        find_masks,
        needs=("poses",),
        settings=("masks", "mask_weights", "mask_points"),
        outputs=("masks",),
        complete=all_have("mask"),
        forgets=("masks",),
    ),
    "static_depth": Step(
        find_static_depth,
        needs=("masks",),
        settings=("depth", "depth_weights", "depth_kind"),
        outputs=("static_disparity", "static_confidence", "still"),
        complete=all_have("static_disparity", "train"),
        forgets=("raw_flows",),
    ),
    "response": Step(
        find_response,
        needs=("static_depth",),
        outputs=("response.json",),
        complete=lambda m: m.response is not None,
    ),
    "refined_flow": Step(
        refine_flow,
        needs=("response",),
        outputs=("refined_flow",),
        complete=all_have("flow"),
        forgets=("refined_flows",),
    ),
    "movers": Step(
        find_movers,
        needs=("refined_flow",),
        outputs=("movers.npz", "mover_disparity", "mover_confidence"),
        complete=lambda m: m.movers is not None,
        forgets=("refined_flows",),
    ),
    "depth": Step(
        find_depth,
        needs=("movers",),
        outputs=("disparity", "disparity_confidence"),
        complete=all_have("disparity", "train"),
    ),
    "sheet": Step(draw_sheet, needs=("depth",), outputs=("contact_sheet.png",)),
}
