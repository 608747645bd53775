"""What a run shows of the views it is held against."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core import io
from hdr_nsff.core.progress import track
from hdr_nsff.core.tensors import to_device
from hdr_nsff.evaluation.targets import Target
from hdr_nsff.fields.build import base
from hdr_nsff.geometry.paths import View
from hdr_nsff.rendering.interpolate import LayeredField, render_at
from hdr_nsff.rendering.shots import device_of, fingerprint
from hdr_nsff.scene.batch import Recorder
from hdr_nsff.training.run_folder import Run


@dataclass(frozen=True)
class Geometry:
    """Where the surfaces of a view are and how they move."""

    depth: Tensor  # (H, W) z-depth; of the truth 0 where nothing is hit
    flow: dict[
        int, Tensor
    ]  # {+-1: (H, W, 2)} pixels per frame in the view's own camera, standing still, to later and earlier times
    scene_flow: dict[int, Tensor]  # {+-1: (H, W, 3)} units per frame, axes of the scene


def predict(
    run: Run, views: Mapping[str, View], folder: Path, description: str, motion: bool
) -> list[Path]:
    """An EXR per named view, `folder`/NAME.exr: radiance, depth and, with `motion`,
    scene flow per frame in channels like `forward.x`. What is there of the same run is
    kept, so that a killed evaluation goes on where it was.
    """
    key = json.dumps(fingerprint(run, motion, list(views.items())))
    note = folder / "predictions.json"
    if not note.is_file() or note.read_text(encoding="utf-8", errors="replace") != key:
        for old in [*folder.glob("*.exr"), *folder.glob("*.png")]:
            old.unlink()
        io.write_text(note, key)
    for name, view in track(list(views.items()), description):
        if not (folder / f"{name}.exr").exists():
            io.write_exr(folder / f"{name}.exr", maps_of(run, view, motion), half=False)
    return [folder / f"{name}.exr" for name in views]


def maps_of(run: Run, view: View, motion: bool) -> dict[str, np.ndarray]:
    """The channels of one view. Where a time between frames is splatted, the field
    itself is asked for its scene flow there.
    """
    camera, times = to_device(view.camera, device_of(run)), run.scene.times.tolist()
    with torch.no_grad():
        seen = render_at(run.field, camera, view.time, times, scene_flow=motion)
        again = motion and not seen.scene_flow and isinstance(run.field, LayeredField)
        flows = run.field.render(camera, view.time).scene_flow if again else seen.scene_flow

    def image(values: Tensor) -> np.ndarray:
        return values.reshape(camera.height, camera.width, *values.shape[1:]).float().cpu().numpy()

    channels = {"RGB": image(seen.radiance), "Z": image(seen.depth)}
    for side, frames in intervals(view.time, times).items():
        if side in flows:
            flow = image(flows[side]) / frames
            channels |= {f"{io.SIDES[side]}.{axis}": flow[..., k] for k, axis in enumerate("xyz")}
    return channels


def intervals(time: float, times: Sequence[float]) -> dict[int, float]:
    """How many frames a field's scene flow at `time` reaches forward and backward: it
    is told from one of the training `times` to the next; between two of them what it
    reaches is interpolated as well. Without a side where the clip ends: nothing was
    learned there.
    """
    places = np.arange(len(times))
    knot = float(np.interp(time, times, places))
    reached = {
        side: float(np.interp(knot + side, places, times))
        for side in io.SIDES
        if 0 <= knot + side <= len(times) - 1
    }
    return {side: abs(end - time) for side, end in reached.items()}


def radiance_of(path: Path) -> Tensor:
    """Radiance (H, W, 3) of a prediction."""
    return torch.from_numpy(io.read_exr(path)["RGB"])


def geometry_of(path: Path, view: View) -> Geometry:
    """Depth and motion of a prediction, in scene units."""
    channels = {name: torch.from_numpy(array) for name, array in io.read_exr(path).items()}
    depth, pixels = channels["Z"], view.camera.pixel_grid()
    scene_flow = {
        s: torch.stack([channels[f"{n}.{a}"] for a in "xyz"], -1)
        for s, n in io.SIDES.items()
        if f"{n}.x" in channels
    }
    rays = view.camera.rays(pixels)
    points = rays.origins + depth.reshape(-1, 1) * rays.directions
    flow = {
        s: (view.camera.project(points + f.reshape(-1, 3))[0] - pixels).view(*depth.shape, 2)
        for s, f in scene_flow.items()
    }
    return Geometry(depth, flow, scene_flow)


def recordings(run: Run, target: Target, radiance: Tensor) -> dict[int, Tensor]:
    """What the learned camera records (H, W, 3) of `radiance` (H, W, 3), which the run
    rendered of the target, at every bracket at which the target is known.
    """
    brackets = list(target.rgb)
    recorders = [run.tonemapper.recorder(b, target.camera_id) for b in brackets]
    return dict(zip(brackets, seen_by(run, target, radiance, recorders), strict=True))


def developed(run: Run, target: Target, radiance: Tensor, evs: Sequence[float]) -> list[Tensor]:
    """The same at any exposures, `evs` relative to the reference bracket."""
    return (
        seen_by(
            run, target, radiance, [run.tonemapper.recorder_at(ev, target.camera_id) for ev in evs]
        )
        if evs
        else []
    )


def seen_by(
    run: Run, target: Target, radiance: Tensor, recorders: Sequence[Recorder]
) -> list[Tensor]:
    """The same as given recordings look."""
    device = device_of(run)
    with torch.no_grad():
        camera, flat = to_device(target.view.camera, device), radiance.reshape(-1, 3).to(device)
        pictures = base.recorded(run.field, camera, target.view.time, recorders, flat)
    return [p.cpu().reshape(radiance.shape) for p in pictures]
