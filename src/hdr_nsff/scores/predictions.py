"""What a run shows of the views it is held against."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from hdr_nsff import io
from hdr_nsff.progress import track
from hdr_nsff.run import Run
from hdr_nsff.scores.targets import Target
from hdr_nsff.shots import fingerprint, take


def predict(run: Run, targets: Sequence[Target], folder: Path) -> list[Tensor]:
    """Radiance (H, W, 3) of every target. Kept as EXR, so that a killed evaluation goes on where it was."""
    key = fingerprint(run, [t.view for t in targets])
    note = folder / "predictions.json"
    if not note.is_file() or note.read_text() != json.dumps(key):
        for old in [*folder.glob("*.exr"), *folder.glob("*.png")]:
            old.unlink()
        io.write_text(note, json.dumps(key))
    result = []
    for target in track(targets, "rendering held-out views"):
        path = folder / f"{target.name}.exr"
        if not path.exists():
            io.write_exr(path, {"RGB": take(run, target.view).radiance}, half=False)
        result.append(torch.from_numpy(io.read_exr(path)["RGB"]))
    return result


def recorded(run: Run, target: Target, radiance: Tensor, bracket: int) -> Tensor:
    """What the learned camera records (H, W, 3) of `radiance` (H, W, 3) at a bracket of the scene."""
    with torch.no_grad():
        flat = radiance.reshape(-1, 3).to(run.tonemapper.knots.device)
        return run.tonemapper(flat, bracket, target.camera_id, None, leaky=False).cpu().reshape(radiance.shape)
