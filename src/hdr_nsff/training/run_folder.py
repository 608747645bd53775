"""A run folder: config.json, checkpoints/ (safetensors, newest two kept), snapshots/
where `bench` asks for them, log.jsonl, previews/. `Run.open` rebuilds field and tone
mapper from it alone. Nothing is unpickled; every write is atomic.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from hdr_nsff.core.checkpoints import latest_checkpoint, read_checkpoint, unpack, write_checkpoint
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json, write_json
from hdr_nsff.core.notes import LogLine
from hdr_nsff.fields import build_field, device_for
from hdr_nsff.fields.base import RadianceField
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.tonemapper import ToneMapper
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.pose_corrections import PoseCorrections


def keep_snapshot(
    folder: Path, share: float, step: int, seconds: float, tensors: dict[str, Tensor]
) -> None:
    """Write snapshots/share_X.safetensors: what was learned by that share of the run. A
    resumed run that gets there again writes it again.
    """
    write_checkpoint(
        Path(folder) / "snapshots" / f"share_{share:.6f}.safetensors", step, seconds, tensors
    )


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
        """Read a run folder, as its newest checkpoint has it or as the file `at` does;
        InputError in one sentence where it is none, unfinished or damaged.
        """
        folder = Path(folder)
        config = read_config(folder)
        scene = Scene.open(config.scene)
        found = read_checkpoint(at) if at is not None else latest_checkpoint(folder)
        if found is None:
            raise InputError(f"{folder}: no checkpoint yet; run `hdr-nsff train` to the first one")
        field, tonemapper = (
            build_field(config.field, scene),
            ToneMapper.for_scene(config.tonemap, scene),
        )
        modules: dict[str, torch.nn.Module] = {"field": field, "tonemapper": tonemapper}
        poses = PoseCorrections(scene) if config.refine_poses else None
        unpack(found.tensors, modules if poses is None else {**modules, "poses": poses}, {})
        scene = scene if poses is None else poses.applied(scene)
        target = device_for(config.field, device)
        return Run(
            folder,
            config,
            scene,
            field.to(target).eval(),
            tonemapper.to(target).eval(),
            found.step,
            found.seconds,
        )

    def log(self) -> list[LogLine]:
        """The lines of log.jsonl; a last line cut short by a kill is left out."""
        return read_log(self.folder)


def read_config(folder: Path) -> TrainConfig:
    """The config of a run folder."""
    path = Path(folder) / "config.json"
    if not path.is_file():
        raise InputError(
            f"{folder}: no config.json here; this is not a run folder, make one with `hdr-nsff train`"
        )
    try:
        return TrainConfig.from_json(read_json(path))
    except InputError:
        raise
    except ValueError as error:
        raise InputError(
            f"{path}: not readable JSON; restore it or train again into a new folder"
        ) from error


def write_config(folder: Path, config: TrainConfig) -> None:
    """Save the config of a run."""
    write_json(Path(folder) / "config.json", config.to_json())


def last_logged(folder: Path) -> LogLine | None:
    """The last complete line of log.jsonl, without reading all of it; None where there
    is none.
    """
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
    """Complete lines of log.jsonl; where a resumed run wrote a step again, the last
    line of it counts.
    """
    path = Path(folder) / "log.jsonl"
    lines: dict[int, LogLine] = {}
    for text in (
        path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
    ):
        try:
            line = LogLine.model_validate_json(text)
        except ValueError:  # cut short by a kill
            continue
        lines[line.step] = line
    return [lines[step] for step in sorted(lines)]
