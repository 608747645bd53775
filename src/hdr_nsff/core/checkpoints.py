"""Checkpoints of modules and optimizers: safetensors files, written atomically, the
newest two kept. Nothing is unpickled.

Tensors are named `MODULE.PARAMETER` and `optimizer.NAME.INDEX.FIELD`, in one flat dict.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic
from hdr_nsff.core.progress import say

FORMAT = "hdr-nsff checkpoint 1"
MAX_CHECKPOINTS = 2  # kept in a folder: the newest, and one to fall back on


@dataclass(frozen=True)
class Checkpoint:
    """The content of one checkpoint file."""

    step: int
    seconds: float  # of training so far
    tensors: dict[str, Tensor]


def save_checkpoint(folder: Path, step: int, seconds: float, tensors: dict[str, Tensor]) -> Path:
    """Write checkpoints/step_XXXXXXXX.safetensors and drop all but the newest two."""
    path = Path(folder) / "checkpoints" / f"step_{step:08d}.safetensors"
    write_checkpoint(path, step, seconds, tensors)
    for old in checkpoint_files(folder)[MAX_CHECKPOINTS:]:
        old.unlink()
    return path


def checkpoint_files(folder: Path) -> list[Path]:
    """The checkpoint files of a run folder, the newest first."""
    return sorted((Path(folder) / "checkpoints").glob("step_*.safetensors"), reverse=True)


def write_checkpoint(path: Path, step: int, seconds: float, tensors: dict[str, Tensor]) -> None:
    """Write one checkpoint file.

    FloatingPointError, and no file, where a number is NaN or infinite.
    """
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    wrong = [name for name, tensor in on_cpu.items() if not torch.isfinite(tensor).all()]
    if wrong:
        raise FloatingPointError(f"step {step}: {', '.join(wrong)} not finite")
    metadata = {
        "format": FORMAT,
        "step": str(step),
        "seconds": repr(seconds),
        "checksum": checksum(step, seconds, on_cpu),
    }
    with atomic(path) as temporary:
        save_file(on_cpu, temporary, metadata=metadata)


def checksum(step: int, seconds: float, tensors: dict[str, Tensor]) -> str:
    """CRC-32 of what a checkpoint holds, by which a damaged file is noticed."""
    value = zlib.crc32(f"{step} {seconds!r}".encode())
    for name in sorted(tensors):
        value = zlib.crc32(name.encode(), value)
        flat = tensors[name].reshape(-1).view(torch.uint8)
        value = zlib.crc32(flat.numpy().data, value)
    return f"{value:08x}"


def read_checkpoint(path: Path) -> Checkpoint:
    """Read one checkpoint file. InputError where it is cut short, from another version,
    or holds NaN or Inf.
    """
    if not Path(path).is_file():  # a pipe would be waited for
        raise InputError(f"{path}: missing, or no ordinary file; restore it")
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            version = metadata.get("format", "unknown format")
            if version != FORMAT:
                raise InputError(f"{path}: written by another version ({version})")
            names = file.keys()
            tensors = {name: file.get_tensor(name) for name in names}
        step, seconds = int(metadata["step"]), float(metadata["seconds"])
        if metadata["checksum"] != checksum(step, seconds, tensors):
            raise ValueError("other bytes than were written")
        if not all(torch.isfinite(tensor).all() for tensor in tensors.values()):
            raise InputError(f"{path}: the checkpoint holds NaN or Inf")
        return Checkpoint(step, seconds, tensors)
    except InputError:
        raise
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise InputError(
            f"{path}: the checkpoint is cut short or damaged ({type(error).__name__})"
        ) from error


def latest_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest readable checkpoint of a run folder; None where there is none at all.
    Newer ones that cannot be read are reported. InputError where none can be read.
    """
    problems = []
    for path in checkpoint_files(folder):
        try:
            found = read_checkpoint(path)
        except InputError as error:
            problems.append(str(error))
            continue
        for problem in problems:
            say(f"{problem}; using the one before, of step {found.step}")
        return found
    if problems:
        raise InputError(
            f"{folder}: no readable checkpoint ({problems[0]}); train again into a new folder"
        )
    return None


def pack(
    modules: Mapping[str, torch.nn.Module], optimizers: dict[str, torch.optim.Optimizer]
) -> dict[str, Tensor]:
    """State of modules and optimizers as one flat dict of tensors."""
    tensors: dict[str, Tensor] = {}
    for name, module in modules.items():
        for key, value in module.state_dict().items():
            tensors[f"{name}.{key}"] = value
    for name, optimizer in optimizers.items():
        for index, state in optimizer.state_dict()["state"].items():
            for field, value in state.items():
                tensors[f"optimizer.{name}.{index}.{field}"] = torch.as_tensor(value)
    return tensors


def unpack(
    tensors: dict[str, Tensor],
    modules: Mapping[str, torch.nn.Module],
    optimizers: dict[str, torch.optim.Optimizer],
) -> None:
    """Put a packed state back. InputError where it does not fit a module."""
    for name, module in modules.items():
        try:
            module.load_state_dict(with_prefix(tensors, f"{name}."))
        except RuntimeError as error:
            raise InputError(
                f"the checkpoint does not fit this run's {name}; its scene or config was "
                "changed, train again into a new folder"
            ) from error
    for name, optimizer in optimizers.items():
        states: dict[int, dict[str, Tensor]] = defaultdict(dict)
        for key, value in with_prefix(tensors, f"optimizer.{name}.").items():
            index, field = key.split(".", 1)
            states[int(index)][field] = value
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": dict(states), "param_groups": groups})


def with_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with `prefix`, which is cut off."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
