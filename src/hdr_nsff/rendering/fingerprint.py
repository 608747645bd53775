"""A hash of everything that pictures of a run depend on, by which a restart knows which
of them it can keep.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from hdr_nsff.training.run_folder import Run


def fingerprint(run: Run, *parts: Any) -> str:
    """A hash of the checkpoint, the config and `parts`: equal hashes, equal pictures.

    Where the folders of the run and of its scene are does not count, so a moved run
    keeps its pictures. The seconds of training distinguish runs of equal configs.
    """
    config = replace(run.config, scene=Path(), out=Path())
    values = [run.step, run.seconds, repr(config), *parts]
    text = json.dumps(values, default=to_plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def to_plain(value: Any) -> Any:
    """Tensors, dataclasses and paths as values that JSON knows."""
    if isinstance(value, torch.Tensor):
        return value.tolist()
    if hasattr(value, "__dict__"):
        return vars(value)
    return str(value)
