"""A run folder: save and open.

It holds config.json, checkpoints/ (safetensors, newest two kept), snapshots/ where
`bench` asks for them, log.jsonl and previews/. `Run.open` rebuilds field and tone
mapper from it alone. Nothing is unpickled; every write but to the log is atomic.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from hdr_nsff.core.checkpoints import (
    checkpoint_files,
    latest_checkpoint,
    read_checkpoint,
    unpack,
    write_checkpoint,
)
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import SCENE_FILE, read_json, write_json
from hdr_nsff.core.notes import LogLine
from hdr_nsff.core.progress import say
from hdr_nsff.fields.base import RadianceField
from hdr_nsff.fields.build import build_field, device_for
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Frame, Scene, training_key
from hdr_nsff.tonemap.base import ToneMapper
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training.budget import Budget, Clock
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.pose_corrections import poses_for

CONFIG = "config.json"
# keys of config.json: the scene's path from the run folder, and `training_key`
SCENE_FROM_RUN, SCENE_KEY = "scene_from_run", "scene_key"
CHANGED = "frames, cameras, exposures or what is held out are not those that it was trained with"


def keep_snapshot(
    folder: Path, share: float, step: int, seconds: float, tensors: dict[str, Tensor]
) -> None:
    """Write snapshots/share_X.safetensors: what was learned by that share of the run.

    A resumed run that gets there again writes it again.
    """
    path = Path(folder) / "snapshots" / f"share_{share:.6f}.safetensors"
    write_checkpoint(path, step, seconds, tensors)


def snapshots(folder: Path) -> dict[float, Path]:
    """{share of the run: file}, in order."""
    files = sorted((Path(folder) / "snapshots").glob("share_*.safetensors"))
    return {float(f.stem.removeprefix("share_")): f for f in files}


@dataclass(frozen=True)
class Run:
    """A trained (or half-trained) field with its tone mapper."""

    folder: Path
    config: TrainConfig
    scene: Scene  # with the cameras that the run has found, where it refines poses
    field: RadianceField
    tonemapper: ToneMapper
    step: int
    seconds: float  # of training

    @staticmethod
    def open(folder: Path | str, device: str = "cpu", at: Path | None = None) -> Run:
        """Read a run folder, from its newest checkpoint or from the file `at`.

        InputError where it is no run folder, unfinished or damaged.
        """
        folder = Path(folder)
        config = read_config(folder)
        scene = Scene.open(config.scene)
        found = read_checkpoint(at) if at is not None else latest_checkpoint(folder)
        if found is None:
            raise InputError(f"{folder}: no checkpoint yet; run `hdr-nsff train` to the first one")
        field = build_field(config.field, scene)
        tonemapper = tone_mapper_for(config.tonemap, scene)
        poses = poses_for(scene, config.refine_poses)
        modules = {"field": field, "tonemapper": tonemapper, "poses": poses}
        unpack(found.tensors, modules, {})
        target = device_for(config.field, device)
        if has_changed(folder, scene.manifest):
            say(f"{folder}: its scene {config.scene} was changed, {CHANGED}; train again")
        return Run(
            folder=folder,
            config=config,
            scene=poses.correct(scene),
            field=field.to(target).eval(),
            tonemapper=tonemapper.to(target).eval(),
            step=found.step,
            seconds=found.seconds,
        )

    def log(self) -> list[LogLine]:
        """The lines of log.jsonl; a last line cut short by a kill is left out."""
        return read_log(self.folder)


def open_folder(config: TrainConfig) -> None:
    """Start a run folder, or check that an existing one has these settings and scene.

    The path of a scene that has moved is updated. An open budget is that of the run.
    Device and time between checkpoints may be others.
    """
    out = config.out
    if (out / SCENE_FILE).exists():
        raise InputError(f"{out}: holds a scene; choose another --out for the run")
    if (out / CONFIG).exists():
        before, places = stored_config(out)
        config = with_own_budget(config)
        before = replace(before, scene=config.scene, out=out, device=config.device)
        if replace(before, checkpoint_seconds=config.checkpoint_seconds) != config:
            raise InputError(
                f"{out}: holds a run with other settings; "
                "choose another --out, or delete it to start over"
            )
        refuse_another_scene(config, places)
        refuse_changed_scene(config)
    elif checkpoint_files(out):
        raise InputError(
            f"{out}: holds checkpoints but no {CONFIG}; "
            "choose another --out, or delete it to start over"
        )
    write_config(out, config)


def with_own_budget(config: TrainConfig) -> TrainConfig:
    """The settings; an open budget becomes that of the run in the folder, if any."""
    if config.budget == Budget() and (config.out / CONFIG).is_file():
        return replace(config, budget=stored_config(config.out)[0].budget)
    return config


def refuse_another_scene(config: TrainConfig, places: Sequence[Path]) -> None:
    """InputError where a run is to go on with another scene.

    `places` are where its own scene may be. The scene of `config` is another one where
    it is neither of them, nor a copy, and one of them still exists.
    """
    known = [place / SCENE_FILE for place in places if (place / SCENE_FILE).is_file()]
    given = config.scene / SCENE_FILE
    same = any(given.samefile(path) or given.read_bytes() == path.read_bytes() for path in known)
    if known and not same:
        raise InputError(
            f"{config.out}: holds a run on another scene, {known[0].parent}; "
            "choose another --out, or delete it to start over"
        )


def refuse_changed_scene(config: TrainConfig) -> None:
    """InputError where a run is to go on and `prepare` has changed its scene."""
    if (config.scene / SCENE_FILE).is_file() and has_changed(
        config.out, Manifest.load(config.scene)
    ):
        raise InputError(
            f"{config.out}: holds a run on {config.scene} before that was changed, {CHANGED}; "
            "choose another --out, or delete it to start over"
        )


def has_changed(folder: Path, scene: Manifest) -> bool:
    """Whether the scene of a run is not what it was trained on, as far as is known."""
    before, now = stored_key(folder), training_key(scene)
    return None not in (before, now) and before != now


def stored_key(folder: Path) -> str | None:
    """`training_key` of the scene that a run was begun on; None where it is unknown, or
    nothing is learned yet.
    """
    path = Path(folder) / CONFIG
    data = read_json(path) if path.is_file() and checkpoint_files(folder) else None
    key = data.get(SCENE_KEY) if isinstance(data, dict) else None
    return key if isinstance(key, str) else None


def read_config(folder: Path) -> TrainConfig:
    """The config of a run folder, with its scene where it now is.

    InputError where the scene is at none of the places that the run knows.
    """
    config, places = stored_config(folder)
    for scene in places:
        if (scene / SCENE_FILE).is_file():
            return replace(config, scene=scene)
    raise InputError(
        f"{folder}: its scene is not at {config.scene} any more; put it back, or say where it is: "
        f"`hdr-nsff train` with the same settings, --scene and --out {folder}"
    )


def stored_config(folder: Path) -> tuple[TrainConfig, list[Path]]:
    """The config of a run folder as it was written, and where its scene may be.

    Its path relative to the run folder comes first, so that a folder with both can be
    moved or copied; then its absolute path.
    """
    path = Path(folder) / CONFIG
    if not path.is_file():
        raise InputError(no_run(Path(folder)))
    try:
        data = read_json(path)
    except ValueError as error:
        raise InputError(
            f"{path}: not readable JSON; restore it or train again into a new folder"
        ) from error
    beside = data.pop(SCENE_FROM_RUN, None) if isinstance(data, dict) else None
    if isinstance(data, dict):
        data.pop(SCENE_KEY, None)
    if isinstance(data, dict) and "scene" not in data and "version" in data:
        advice = 'add "scene": "FOLDER", the scene folder that it was trained on'
        raise InputError(f"{path}: no scene is named; {advice}")
    try:
        config = TrainConfig.from_json(data)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error
    places = [config.scene]
    if isinstance(beside, str) and "\0" not in beside:
        places.insert(0, (Path(folder).resolve() / beside).resolve())
    return config, places


def no_run(folder: Path) -> str:
    """The sentence for a path that is no run folder."""
    if folder.is_file():
        return f"{folder}: is a file and not a run folder; name the folder that holds {CONFIG}"
    if (folder / SCENE_FILE).is_file():
        advice = f"train one from it with `hdr-nsff train splat --scene {folder}`"
        return f"{folder}: a scene and not a run folder; {advice}"
    if (folder / "run" / CONFIG).is_file():
        return f"{folder}: not a run folder, but {folder / 'run'} is one; name that"
    return f"{folder}: no {CONFIG} here; this is not a run folder, make one with `hdr-nsff train`"


def write_config(folder: Path, config: TrainConfig) -> None:
    """Save the config of a run, where its scene is as seen from there, and what it was
    when the run began.
    """
    data = config.to_json()
    known = stored_key(folder)
    if known is None and (config.scene / SCENE_FILE).is_file():
        known = training_key(Manifest.load(config.scene))
    data[SCENE_KEY] = known
    try:
        data[SCENE_FROM_RUN] = os.path.relpath(config.scene, folder.resolve())
    except ValueError:  # another drive of Windows
        data[SCENE_FROM_RUN] = None
    write_json(Path(folder) / CONFIG, data)


def write_preview(
    folder: Path,
    step: int,
    field: RadianceField,
    tonemapper: ToneMapper,
    frame: Frame,
    position: int,
) -> None:
    """previews/: a training frame as recorded and as rendered, side by side."""
    recorder = tonemapper.recorder(frame.bracket, frame.camera_id, position)
    with torch.no_grad():
        rgb = record_pixels(field, frame.camera, frame.time, [recorder])[0].view_as(frame.image)
    pair = torch.cat([frame.image, rgb], 1).cpu().numpy()
    write_png(folder / "previews" / f"step_{step:08d}.png", pair)


def append_log(folder: Path, clock: Clock, num_rays: int, values: dict[str, float]) -> None:
    """Add to log.jsonl the `values` of a step that compared `num_rays` pixels."""
    line = {
        "step": clock.step,
        "seconds": round(clock.seconds, 3),
        "psnr": values["psnr"],
        "rays_per_second": num_rays * clock.step / clock.seconds,
        "losses": {name: value for name, value in values.items() if name != "psnr"},
    }
    with open(folder / "log.jsonl", "ab+") as file:
        end = file.seek(0, os.SEEK_END)
        file.seek(max(end - 1, 0))
        whole = file.read() in (b"", b"\n")  # a kill may have cut the last line short
        separator = b"" if whole else b"\n"
        file.write(separator + json.dumps(line).encode() + b"\n")


def last_logged(folder: Path) -> LogLine | None:
    """The last complete line of log.jsonl, if any, without reading all of it."""
    path = Path(folder) / "log.jsonl"
    if not path.is_file():
        return None
    with open(path, "rb") as file:
        file.seek(max(path.stat().st_size - 8192, 0))
        lines = file.read().decode(errors="replace").splitlines()
    for text in reversed(lines):
        try:
            return LogLine.model_validate_json(text)
        except ValueError:  # cut short: by a kill, or by where we began to read
            continue
    return None


def read_log(folder: Path) -> list[LogLine]:
    """Complete lines of log.jsonl, in order of their steps.

    Where a resumed run wrote a step again, its last line counts.
    """
    path = Path(folder) / "log.jsonl"
    if not path.is_file():
        return []
    lines: dict[int, LogLine] = {}
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = LogLine.model_validate_json(text)
        except ValueError:  # cut short by a kill
            continue
        lines[line.step] = line
    return [lines[step] for step in sorted(lines)]
