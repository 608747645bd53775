"""Checkpoints of modules and optimizers: safetensors files, written atomically, the
newest two kept. Nothing is unpickled.
"""

from __future__ import annotations

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
        save_file(
            cpu, temporary, metadata={"format": FORMAT, "step": str(step), "seconds": repr(seconds)}
        )


def read_checkpoint(path: Path) -> Checkpoint:
    """One checkpoint file. InputError where it is cut short or from another version."""
    try:
        with safe_open(str(path), framework="pt") as file:
            meta = file.metadata() or {}
            if meta.get("format") != FORMAT:
                raise InputError(
                    f"{path}: written by another version ({meta.get('format', 'unknown format')})"
                )
            return Checkpoint(
                int(meta["step"]),
                float(meta["seconds"]),
                {k: file.get_tensor(k) for k in file.keys()},  # noqa: SIM118
            )
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: the checkpoint is cut short or damaged ({type(error).__name__})"
        ) from error


def latest_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest readable checkpoint, saying so where a newer one could not be read;
    None where there is none at all.
    """
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
        raise InputError(
            f"{folder}: no readable checkpoint ({problems[0]}); train again into a new folder"
        )
    return None


def pack(
    modules: dict[str, torch.nn.Module], optimizers: dict[str, torch.optim.Optimizer]
) -> dict[str, Tensor]:
    """State of modules and optimizers as one flat dict of tensors."""
    tensors = {
        f"{name}.{k}": v for name, module in modules.items() for k, v in module.state_dict().items()
    }
    for name, optimizer in optimizers.items():
        for index, state in optimizer.state_dict()["state"].items():
            tensors |= {
                f"optimizer.{name}.{index}.{k}": torch.as_tensor(v) for k, v in state.items()
            }
    return tensors


def unpack(
    tensors: dict[str, Tensor],
    modules: dict[str, torch.nn.Module],
    optimizers: dict[str, torch.optim.Optimizer],
) -> None:
    """Put a packed state back."""
    for name, module in modules.items():
        own = {
            k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")
        }
        try:
            module.load_state_dict(own)
        except RuntimeError as error:
            raise InputError(
                f"the checkpoint does not fit this run's {name}; its scene or config was changed, train again into a new folder"
            ) from error
    for name, optimizer in optimizers.items():
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(f"optimizer.{name}."):
                index, field = key.removeprefix(f"optimizer.{name}.").split(".", 1)
                state.setdefault(int(index), {})[field] = value
        optimizer.load_state_dict(
            {"state": state, "param_groups": optimizer.state_dict()["param_groups"]}
        )
