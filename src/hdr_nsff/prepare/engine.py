"""The engine of `prepare`: does each step that is not done, and stores what it found.

A step is a function from what the folder holds so far (`Work`) to a `StepResult`. Its
key is a hash of its settings, of the files these name, of the weights of its networks,
and of the steps before it. A finished step with the same key is skipped. One with
another key starts over, and so does every step that builds on it: these count as not
done from then on, so that nobody takes a scene that is redone in part for a whole one.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, get_args

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hashes import hash_file
from hdr_nsff.core.io import SCENE_FILE, atomic, is_leftover
from hdr_nsff.core.process import cpu_seconds, peak_memory
from hdr_nsff.core.progress import say
from hdr_nsff.footage.datasets.capture import Picture
from hdr_nsff.footage.exposure_lists import csv_path
from hdr_nsff.prepare.result import StepResult, store
from hdr_nsff.prepare.steps.neural import weights_of
from hdr_nsff.prepare.work import PrepareConfig, StepName, Work
from hdr_nsff.scene.manifest import Manifest, Split, StepRecord

ASIDE = ".aside"  # earlier outputs of the step that starts over


@dataclass(frozen=True)
class Step:
    """What a step does, builds on and leaves in the folder."""

    run: Callable[[Work], StepResult]
    needs: tuple[StepName, ...] = ()
    settings: tuple[str, ...] = ()  # fields of `PrepareConfig`; a path counts by contents
    # InputError for bad input of this step or later ones, before anything is removed
    check: Callable[[Work], None] = field(default=lambda work: None)
    outputs: tuple[str, ...] = ()  # folders and files it owns
    # whether the manifest names all it should
    complete: Callable[[Manifest], bool] = field(default=lambda m: True)
    forgets: tuple[str, ...] = ()  # cached properties of `Work` that it changes
    depends: tuple[Any, ...] = ()  # what else its result depends on: plain data
    quiet: bool = False  # its note is not printed


def run_step(work: Work, name: StepName, step: Step) -> None:
    """Do one step, or skip it where it is done."""
    records = work.manifest.steps
    key = step_key(work, name, step)
    before = records.get(name)
    begun = before if name not in work.config.redo else None
    if begun is not None and begun.key != key:
        begun = None
    if begun is not None and begun.done and step.complete(work.manifest) and present(work, step):
        return
    step.check(work)
    earlier = (work.folder / SCENE_FILE).read_bytes() if before and begun is None else None
    if begun is None:
        set_aside(work.folder, step.outputs)
    record = begun or next_attempt(before, key)
    records[name] = record.model_copy(update={"done": False})
    if begun is None:
        begin_later_steps(records, name)
    work.save()
    start, cpu_before = time.monotonic(), cpu_seconds()
    try:
        result = step.run(work)
    except InputError:
        if earlier is not None:
            bring_back(work.folder, step.outputs, earlier)
        else:
            leave_nothing(work, step)
        raise
    store(work.folder, work.manifest, result)
    records[name] = StepRecord(
        done=True,
        key=key,
        provenance=result.provenance,
        note=result.note,
        seconds=round(time.monotonic() - start, 2),
        cpu_seconds=round(cpu_seconds() - cpu_before, 2),
        peak_memory_mb=round(peak_memory() / 2**20),
        details={**record.details, **result.details},
    )
    work.save()
    remove(work.folder / ASIDE)
    work.forget(step.forgets)
    if not step.quiet:
        say(f"{name}: {result.note}")


def set_aside(folder: Path, outputs: Sequence[str]) -> None:
    """Move the `outputs` of a step that starts over aside, until it has succeeded."""
    aside = folder / ASIDE
    remove(aside)
    for output in outputs:
        if (folder / output).exists():
            aside.mkdir(exist_ok=True)
            (folder / output).rename(aside / output)


def bring_back(folder: Path, outputs: Sequence[str], manifest: bytes) -> None:
    """Undo a refused step: its earlier `outputs`, and the `manifest` as it was."""
    for output in outputs:
        remove(folder / output)
        if (folder / ASIDE / output).exists():
            (folder / ASIDE / output).rename(folder / output)
    with atomic(folder / SCENE_FILE) as temporary:
        temporary.write_bytes(manifest)
    remove(folder / ASIDE)


def leave_nothing(work: Work, step: Step) -> None:
    """Remove what the first step has written before it was refused, and the scene
    folder where it holds nothing else.
    """
    if len(work.manifest.steps) > 1:
        return
    for output in step.outputs:
        remove(work.folder / output)
    if [path.name for path in work.folder.iterdir()] == [SCENE_FILE]:
        remove(work.folder / SCENE_FILE)
    for folder in work.made:
        with contextlib.suppress(OSError):  # it holds other files
            folder.rmdir()


def next_attempt(record: StepRecord | None, key: str) -> StepRecord:
    """The record of a step that starts over; the steps after it then do so too."""
    attempt = record.details.get("attempt", 0) + 1 if record else 1
    return StepRecord(key=key, details={"attempt": attempt})


def begin_later_steps(records: dict[str, StepRecord], name: StepName) -> None:
    """Let the steps after one that starts over count as not done: each builds on those
    before it.
    """
    order = get_args(StepName)
    for later in order[order.index(name) + 1 :]:
        if later in records:
            records[later] = records[later].model_copy(update={"done": False})


def step_key(work: Work, name: StepName, step: Step) -> str:
    """The hash of everything a step depends on: its settings, the files they name, the
    weights of its networks, the steps before it and how often those were redone.
    """
    settings: dict[str, Any] = {}
    for setting in step.settings:
        value = getattr(work.config, setting)
        if setting in ("same_camera", "tripod", "readout") and not value:
            continue  # so that scenes made without it stay as they are
        if (name, setting) == ("poses", "masks") and isinstance(value, str) and not work.capture:
            value = None  # which network outlines the masks later does not affect poses
        if isinstance(value, Path):
            value = hash_of(value)
        elif is_dataclass(value) and not isinstance(value, type):
            value = asdict(value)
        settings[setting] = value
    records = work.manifest.steps
    before = [(n, records[n].key, records[n].details.get("attempt")) for n in step.needs]
    inputs = list_part(work) if name == "frames" else {}
    from_capture = [capture_part(work, name)] if work.capture is not None else []
    cut = [asdict(work.footage.bars)] if name == "frames" and work.footage.bars else []
    lens = lens_part(work, name)
    parts = [settings, before, inputs, *from_capture, *cut, *lens, *weights_of(work.config, name)]
    parts += step.depends
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def list_part(work: Work) -> dict[str, Any]:
    """The footage, with the list of exposures and times beside it, if any."""
    written = csv_path(work.footage)
    inputs: dict[str, Any] = dict(work.manifest.inputs)
    return inputs | {"list": hash_of(written)} if written.is_file() else inputs


def lens_part(work: Work, name: StepName) -> list[Any]:
    """What of the lens a step depends on: frames on the lens that undistorts them,
    poses on whether one is looked for. Empty for a pinhole camera.
    """
    if name == "frames":
        return [entry.model_dump() for entry in work.manifest.lens.values()]
    if name == "poses" and work.config.lens_distortion != "auto":
        return [work.config.lens_distortion]
    return []


def capture_part(work: Work, name: StepName) -> Any:
    """What of a data set a step depends on: its values, and the hashes of its files."""
    capture = work.capture
    assert capture is not None
    pictures = capture.pictures

    def files(of: Callable[[Picture], Path | None]) -> list[str | None]:
        paths = [of(p) for p in pictures]
        return [None if path is None else hash_file(path) for path in paths]

    match name:
        case "frames":
            return [(p.source, p.time, p.camera_id) for p in pictures]
        case "exposure":
            known = asdict(capture.exposures) if capture.exposures else None
            return [capture.has_held_out, known, [(p.ev, p.bracket) for p in pictures]]
        case "flow" if work.capture_with("flow"):
            named = [sorted(p.flow.items()) for p in pictures]
            return [[(to, hash_file(path)) for to, path in each] for each in named]
        case "poses" if work.capture_with("poses") and (given := capture.poses) is not None:
            points = None if capture.points is None else capture.points.tolist()
            cameras = [given.K.tolist(), given.c2w.tolist(), given.size.tolist()]
            return [*cameras, given.near, given.far, points]
        case "poses" if work.config.poses is None and not work.config.tripod:
            return capture_part(work, "masks")  # poses are estimated from static pixels
        case "masks" if work.capture_with("masks"):
            return [capture.is_static, capture.white_moves, files(lambda p: p.mask)]
        case "static_depth" if work.capture_with("depth"):
            maps = [files(lambda p: p.depth), files(lambda p: p.confidence)]
            return [capture.depth_kind, capture.depth_units, *maps]
    return None


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


def hash_of(path: Path) -> str:
    """The hash of a file, or of all files in a folder."""
    if path.is_file():
        return hash_file(path)
    files = sorted(p for p in path.rglob("*") if p.is_file())
    listing = [(p.relative_to(path).as_posix(), hash_file(p)) for p in files]
    return hashlib.sha256(json.dumps(listing).encode()).hexdigest()


def remove(path: Path) -> None:
    """Delete a file or folder, if it is there."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def present(work: Work, step: Step) -> bool:
    """Whether every file that the step owns and the manifest names is there."""
    names = [*work.manifest.file_names(), "contact_sheet.png"]
    owned = [name for name in names if name.split("/")[0] in step.outputs]
    return all((work.folder / name).is_file() for name in owned)


def all_have(entry_field: str, split: Split | None = None) -> Callable[[Manifest], bool]:
    """Whether every frame (of `split`) has `entry_field`."""

    def complete(m: Manifest) -> bool:
        frames = [f for f in m.frames if split in (None, f.split)]
        return bool(frames) and all(getattr(f, entry_field) for f in frames)

    return complete
