"""Footage, or a public data set, -> scene folder, step by step: frames, exposure, flow,
poses, masks, refined flow, depth, sheet.

Every step writes its files and then its record into `scene.json`; its key is a hash of
its settings, of the weights of the networks that it asks, and of the steps and inputs
it builds on. A finished step with the same key is skipped, an unfinished one goes on
with the files it has, one with another key starts over, and with it whatever builds on
it. So killing `prepare` at any moment loses at most the file in the making.

What a data set gives takes the place of an estimate. What it keeps back for testing no
step sees: once the scene is whole, it goes into a truth folder outside of it, for
`evaluate` alone.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage import ingest
from hdr_nsff.footage.datasets import recognize
from hdr_nsff.footage.datasets.capture import Picture
from hdr_nsff.footage.datasets.held_out import truth_folder, write_truth
from hdr_nsff.footage.exposure_lists import parse_exposures
from hdr_nsff.prepare.steps import footage as on_footage
from hdr_nsff.prepare.steps import priors as on_priors
from hdr_nsff.prepare.steps.neural import check_networks, weights_of
from hdr_nsff.prepare.work import Part, PrepareConfig, StepName, Work
from hdr_nsff.priors.flow.sources import check_flow
from hdr_nsff.scene.scene import Manifest, Split, Step

__all__ = ["PrepareConfig", "prepare"]


@dataclass(frozen=True)
class StepKind:
    """A step: what it builds on, which settings it follows, how it is done, and what of
    it lies in the folder.
    """

    run: Callable[[Work], Step]
    needs: tuple[StepName, ...] = ()
    settings: tuple[
        str, ...
    ] = ()  # names of `PrepareConfig` fields; a path among them counts with its contents
    outputs: tuple[str, ...] = ()  # folders and files it owns
    # whether the manifest names all it should
    complete: Callable[[Manifest], bool] = field(default=lambda m: True)


def prepare(config: PrepareConfig) -> Path:
    """Do every step that is not done; the scene folder. InputError where the footage or
    a setting is at fault.
    """
    with writing_to(config.out):
        work = begin(config)
        introduce(work)
        for name in STEPS:
            do(work, name)
        if work.capture is not None and work.capture.withheld:
            write_truth(
                work.capture, work.manifest, work.own_time, truth_place(config), config.max_size
            )
    say(
        f"scene: {config.out}  ({len(work.manifest.frames)} frames, contact sheet {config.out / 'contact_sheet.png'})"
    )
    return config.out


def truth_place(config: PrepareConfig) -> Path:
    """Where the held-out views of a public data set go."""
    return config.truth_out or config.out.with_name(f"{config.out.name}_truth")


def held_out_truth(config: PrepareConfig) -> Path | None:
    """The truth folder that `prepare` wrote, None where the footage brings no held-out
    views.
    """
    return truth_folder(truth_place(config))


def begin(config: PrepareConfig) -> Work:
    """Look at the footage and at the scene folder; InputError where they do not belong
    together.
    """
    check_settings(config)
    capture = recognize(config.clip)
    footage = capture.footage() if capture else ingest.open_footage(config.clip)
    inputs = {name: ingest.hash_file(path) for name, path in track(footage.files.items(), "inputs")}
    found = found_manifest(config)
    if found is not None and found.inputs != inputs and not found.frames:
        found = None  # nothing to lose
    if found is not None and found.inputs != inputs and found.source != str(config.clip):
        raise InputError(
            f"{config.out}: holds the scene of other footage ({found.source}); choose another folder"
        )
    for leftover in config.out.rglob(".partial-*"):  # of a killed run
        leftover.unlink()
    if found is not None:
        found.source, found.inputs = str(config.clip), inputs
        return Work(config, footage, found, capture)
    first = next(
        ingest.read_frames(footage, config.start, config.start + 1, 1, config.max_size), None
    )
    if first is None:
        raise InputError(f"{config.clip}: no frame {config.start}; choose a smaller `--start`")
    height, width = first.rgb.shape[:2]
    work = Work(
        config,
        footage,
        Manifest(source=str(config.clip), inputs=inputs, width=width, height=height),
        capture,
    )
    work.save()
    return work


def introduce(work: Work) -> None:
    """Say which data set was recognized, if it is one, and what of it is used."""
    capture, clip = work.capture, work.config.clip
    if capture is None:
        return
    stored = ["exposures"] if capture.parts()["exposures"] else []
    parts: tuple[Part, ...] = ("poses", "flow", "masks", "depth")
    given = [*stored, *(part for part in parts if work.gives(part))]
    kept = f", held-out views for {truth_place(work.config)}" if capture.withheld else ""
    say(
        f"{clip}: {capture.layout}, {len(capture.pictures)} pictures, with its own {', '.join(given) or 'pictures alone'}{kept}"
    )
    for note in capture.notes:
        say(f"{clip}: {note}")


def found_manifest(config: PrepareConfig) -> Manifest | None:
    """The manifest already in the output folder, None where there is none yet or a
    broken one is to be redone from the frames.
    """
    if not config.out.exists():
        return None
    if not config.out.is_dir():
        raise InputError(f"{config.out}: is a file; choose a folder to write the scene to")
    if not (config.out / "scene.json").exists():
        if any(not p.name.startswith(".partial-") for p in config.out.iterdir()):
            raise InputError(
                f"{config.out}: holds other files and no scene; choose an empty or new folder"
            )
        return None
    try:
        found = Manifest.load(config.out)
        if [f.index for f in found.frames] != list(range(len(found.frames))):
            raise InputError(
                f"{config.out / 'scene.json'}: frames are missing or out of order; restore it or use `--redo frames`"
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
            "--protocol and --hold-out both given, and each says what is kept out of training; leave one out"
        )
    parse_exposures(config.exposures, config.ev)
    if truth_place(config).resolve().is_relative_to(config.out.resolve()):
        raise InputError(
            f"--truth-out {config.truth_out}: inside the scene folder, where training reads; choose a place outside"
        )
    check_flow(config.flow, config.flow_weights)
    for option, path in (
        ("poses", config.poses),
        ("mask", config.masks),
        ("depth", config.depth),
        ("mask-points", config.mask_points),
    ):
        if isinstance(path, Path) and not path.exists():
            raise InputError(
                f"--{option} {path}: no such file or folder; mend the path, or leave the option out to estimate"
            )
    check_networks(config)


def do(work: Work, name: StepName) -> None:
    """Do one step, or skip it where it is done."""
    kind, steps = STEPS[name], work.manifest.steps
    key = step_key(work, name)
    record = steps.get(name)
    if record is None or record.key != key or name in work.config.redo:
        for output in kind.outputs:
            remove(work.folder / output)
        record = Step(
            key=key, details={"attempt": record.details.get("attempt", 0) + 1 if record else 1}
        )
    elif record.done and kind.complete(work.manifest) and present(work, name):
        return
    steps[name] = record = record.model_copy(update={"done": False})
    work.save()
    start = time.monotonic()
    result = kind.run(work)
    seconds, details = round(time.monotonic() - start, 2), {**record.details, **result.details}
    steps[name] = result.model_copy(
        update={"done": True, "key": key, "seconds": seconds, "details": details}
    )
    work.save()
    say(f"{name}: {result.note}")


def step_key(work: Work, name: StepName) -> str:
    """The hash of everything a step depends on: its settings, the files they name, the
    weights of its networks, the steps before it and how often those were redone.
    """
    kind = STEPS[name]
    settings: dict[str, Any] = {}
    for s in kind.settings:
        value = getattr(work.config, s)
        if (name, s) == ("poses", "masks") and isinstance(value, str) and work.capture is None:
            value = None  # who outlines the masks later is nothing to the poses
        settings[s] = given_hash(value) if isinstance(value, Path) else value
        if is_dataclass(value) and not isinstance(value, type):
            settings[s] = asdict(value)
    before = [
        (n, work.manifest.steps[n].key, work.manifest.steps[n].details.get("attempt"))
        for n in kind.needs
    ]
    inputs = work.manifest.inputs if name == "frames" else {}
    known = [capture_part(work, name)] if work.capture is not None else []
    return hashlib.sha256(
        json.dumps([settings, before, inputs, *known, *weights_of(work.config, name)]).encode()
    ).hexdigest()


def capture_part(work: Work, name: StepName) -> Any:
    """What of a data set a step depends on: its values, and the hashes of its files."""
    capture = work.capture
    assert capture is not None
    ps = capture.pictures

    def files(of: Callable[[Picture], Path | None]) -> list[str | None]:
        return [None if (path := of(p)) is None else ingest.hash_file(path) for p in ps]

    match name:
        case "frames":
            return [(p.source, p.time, p.camera_id) for p in ps]
        case "exposure":
            return [
                capture.withheld,
                asdict(capture.exposures) if capture.exposures else None,
                [(p.ev, p.bracket) for p in ps],
            ]
        case "flow" if work.gives("flow"):
            return [sorted((to, ingest.hash_file(path)) for to, path in p.flow.items()) for p in ps]
        case "poses" if work.gives("poses") and (given := capture.poses) is not None:
            points = None if capture.points is None else capture.points.tolist()
            return [
                given.K.tolist(),
                given.c2w.tolist(),
                given.size.tolist(),
                given.near,
                given.far,
                points,
            ]
        case "masks" if work.gives("masks"):
            return [capture.still, capture.white_moves, files(lambda p: p.mask)]
        case "depth" if work.gives("depth"):
            return [
                capture.depth_kind,
                capture.depth_units,
                files(lambda p: p.depth),
                files(lambda p: p.confidence),
            ]
    return None


def given_hash(path: Path) -> str:
    """The hash of a file, or of all files in a folder."""
    if path.is_file():
        return ingest.hash_file(path)
    files = sorted(p for p in path.rglob("*") if p.is_file())
    listing = [(p.relative_to(path).as_posix(), ingest.hash_file(p)) for p in files]
    return hashlib.sha256(json.dumps(listing).encode()).hexdigest()


def remove(path: Path) -> None:
    """Delete a file or folder, if it is there."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def present(work: Work, name: StepName) -> bool:
    """Whether every file that the manifest names for this step is there."""
    named = (
        [f for e in work.manifest.frames for f in e.files]
        + ["contact_sheet.png"]
        + ([work.manifest.points] if work.manifest.points else [])
    )
    return all((work.folder / n).is_file() for n in named if n.split("/")[0] in STEPS[name].outputs)


def all_have(field: str, split: Split | None = None) -> Callable[[Manifest], bool]:
    """Whether every frame (of `split`) has `field`."""
    return lambda m: (
        bool(m.frames) and all(getattr(f, field) for f in m.frames if split in (None, f.split))
    )


STEPS: dict[StepName, StepKind] = {
    "frames": StepKind(
        on_footage.frames_step,
        settings=("start", "end", "stride", "max_size"),
        outputs=("images",),
        complete=all_have("image"),
    ),
    "exposure": StepKind(
        on_footage.exposure_step,
        needs=("frames",),
        settings=("exposures", "ev", "hold_out", "protocol"),
        complete=all_have("image"),
    ),
    "flow": StepKind(
        on_priors.flow_step,
        needs=("exposure",),
        settings=("flow", "flow_weights", "semantic"),
        outputs=("raw_flow",),
        complete=all_have("raw_flow"),
    ),
    "poses": StepKind(
        on_priors.poses_step,
        needs=("flow",),
        settings=("poses", "masks", "matcher"),
        outputs=("poses", "points.npy"),
        complete=all_have("c2w"),
    ),
    "masks": StepKind(
        on_priors.masks_step,
        needs=("poses",),
        settings=("masks", "mask_weights", "mask_points"),
        outputs=("masks",),
        complete=all_have("mask"),
    ),
    "refined_flow": StepKind(
        on_priors.refined_flow_step,
        needs=("masks",),
        outputs=("refined_flow",),
        complete=all_have("flow"),
    ),
    "depth": StepKind(
        on_priors.depth_step,
        needs=("refined_flow",),
        settings=("depth", "depth_weights", "depth_kind"),
        outputs=("disparity", "disparity_confidence"),
        complete=all_have("disparity", "train"),
    ),
    "sheet": StepKind(on_priors.sheet_step, needs=("depth",), outputs=("contact_sheet.png",)),
}
