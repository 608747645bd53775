"""A run folder: config.json, checkpoints/ (safetensors, newest two kept), snapshots/ where `bench` asks for them, log.jsonl, previews/.
`Run.open` rebuilds field and tone mapper from it alone. Nothing is unpickled; every write is atomic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from hdr_nsff.config import TrainConfig
from hdr_nsff.errors import InputError
from hdr_nsff.fields import build_field
from hdr_nsff.fields.base import RadianceField
from hdr_nsff.io import atomic, read_json, write_json
from hdr_nsff.notes import LogLine
from hdr_nsff.pose_corrections import PoseCorrections
from hdr_nsff.progress import say
from hdr_nsff.scene import Scene
from hdr_nsff.tonemap import ToneMapper

FORMAT = "hdr-nsff checkpoint 1"
KEEP = 2


@dataclass(frozen=True)
class Checkpoint:
    """What one checkpoint file holds."""

    step: int
    seconds: float  # of training so far
    tensors: dict[str, Tensor]


def save_checkpoint(folder: Path, step: int, seconds: float, tensors: dict[str, Tensor]) -> Path:
    """Write checkpoints/step_XXXXXXXX.safetensors and drop all but the newest two."""
    path = Path(folder) / "checkpoints" / f"step_{step:08d}.safetensors"
    write_checkpoint(path, step, seconds, tensors)
    for old in sorted(path.parent.glob("step_*.safetensors"))[:-KEEP]:
        old.unlink()
    return path


def write_checkpoint(path: Path, step: int, seconds: float, tensors: dict[str, Tensor]) -> None:
    """One checkpoint file."""
    with atomic(path) as temporary:
        cpu = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
        save_file(cpu, temporary, metadata={"format": FORMAT, "step": str(step), "seconds": repr(seconds)})


def keep_snapshot(folder: Path, share: float, step: int, seconds: float, tensors: dict[str, Tensor]) -> None:
    """Write snapshots/share_X.safetensors: what was learned by that share of the run. A resumed run that gets there again writes it again."""
    write_checkpoint(Path(folder) / "snapshots" / f"share_{share:.6f}.safetensors", step, seconds, tensors)


def snapshots(folder: Path) -> dict[float, Path]:
    """{share of the run: file}, in order."""
    files = sorted((Path(folder) / "snapshots").glob("share_*.safetensors"))
    return {float(f.stem.removeprefix("share_")): f for f in files}


def read_checkpoint(path: Path) -> Checkpoint:
    """One checkpoint file. InputError where it is cut short or from another version."""
    try:
        with safe_open(str(path), framework="pt") as file:
            meta = file.metadata() or {}
            if meta.get("format") != FORMAT:
                raise InputError(f"{path}: written by another version ({meta.get('format', 'unknown format')})")
            return Checkpoint(int(meta["step"]), float(meta["seconds"]), {k: file.get_tensor(k) for k in file.keys()})  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: the checkpoint is cut short or damaged ({type(error).__name__})") from error


def latest_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest readable checkpoint, saying so where a newer one could not be read; None where there is none at all."""
    problems = []
    for path in sorted((Path(folder) / "checkpoints").glob("step_*.safetensors"), reverse=True):
        try:
            found = read_checkpoint(path)
        except InputError as error:
            problems.append(str(error))
            continue
        for problem in problems:
            say(f"{problem}; going on from the one before, step {found.step}")
        return found
    if problems:
        raise InputError(f"{folder}: no readable checkpoint ({problems[0]}); train again into a new folder")
    return None


def pack(modules: dict[str, torch.nn.Module], optimisers: dict[str, torch.optim.Optimizer]) -> dict[str, Tensor]:
    """State of modules and optimisers as one flat dict of tensors."""
    tensors = {f"{name}.{k}": v for name, module in modules.items() for k, v in module.state_dict().items()}
    for name, optimiser in optimisers.items():
        for index, state in optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{name}.{index}.{k}": torch.as_tensor(v) for k, v in state.items()}
    return tensors


def unpack(tensors: dict[str, Tensor], modules: dict[str, torch.nn.Module], optimisers: dict[str, torch.optim.Optimizer]) -> None:
    """Put a packed state back."""
    for name, module in modules.items():
        own = {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}
        try:
            module.load_state_dict(own)
        except RuntimeError as error:
            raise InputError(
                f"the checkpoint does not fit this run's {name}; its scene or config was changed, train again into a new folder"
            ) from error
    for name, optimiser in optimisers.items():
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(f"optimiser.{name}."):
                index, field = key.removeprefix(f"optimiser.{name}.").split(".", 1)
                state.setdefault(int(index), {})[field] = value
        optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def pick_device(name: str) -> torch.device:
    """The device of a `--device` flag; InputError where CUDA is asked for and missing."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("--device cuda: this torch sees no CUDA device; leave the flag out to use the CPU")
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise InputError(f"--device {name}: no such device; choose auto, cpu or cuda") from error


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
        """Read a run folder, as its newest checkpoint has it or as the file `at` does; InputError in one sentence where it is none,
        unfinished or damaged."""
        folder = Path(folder)
        config = read_config(folder)
        scene = Scene.open(config.scene)
        found = read_checkpoint(at) if at is not None else latest_checkpoint(folder)
        if found is None:
            raise InputError(f"{folder}: no checkpoint yet; run `hdr-nsff train` to the first one")
        field, tonemapper = build_field(config.field, scene), ToneMapper.for_scene(config.tonemap, scene)
        modules: dict[str, torch.nn.Module] = {"field": field, "tonemapper": tonemapper}
        poses = PoseCorrections(scene) if config.refine_poses else None
        unpack(found.tensors, modules if poses is None else {**modules, "poses": poses}, {})
        scene = scene if poses is None else poses.applied(scene)
        target = pick_device(device)
        return Run(folder, config, scene, field.to(target).eval(), tonemapper.to(target).eval(), found.step, found.seconds)

    def log(self) -> list[LogLine]:
        """The lines of log.jsonl; a last line cut short by a kill is left out."""
        return read_log(self.folder)


def read_config(folder: Path) -> TrainConfig:
    """The config of a run folder."""
    path = Path(folder) / "config.json"
    if not path.is_file():
        raise InputError(f"{folder}: no config.json here; this is not a run folder, make one with `hdr-nsff train`")
    try:
        return TrainConfig.from_json(read_json(path))
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: not readable JSON; restore it or train again into a new folder") from error


def write_config(folder: Path, config: TrainConfig) -> None:
    """Save the config of a run."""
    write_json(Path(folder) / "config.json", config.to_json())


def last_logged(folder: Path) -> LogLine | None:
    """The last complete line of log.jsonl, without reading all of it; None where there is none."""
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
    """Complete lines of log.jsonl; where a resumed run wrote a step again, the last line of it counts."""
    path = Path(folder) / "log.jsonl"
    lines: dict[int, LogLine] = {}
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []:
        try:
            line = LogLine.model_validate_json(text)
        except ValueError:  # cut short by a kill
            continue
        lines[line.step] = line
    return [lines[step] for step in sorted(lines)]
