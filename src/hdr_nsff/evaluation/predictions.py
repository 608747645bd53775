"""Predictions of a run for the views it is compared with.

Maps are rendered once, kept as EXR files, and developed at any exposure.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import MOTION_DIRECTIONS, read_exr, write_exr
from hdr_nsff.core.io import write_text
from hdr_nsff.core.progress import track
from hdr_nsff.core.tensors import to_device
from hdr_nsff.evaluation.targets import Target
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.fingerprint import fingerprint
from hdr_nsff.rendering.interpolate import render_at
from hdr_nsff.rendering.stills import device_of
from hdr_nsff.scene.batch import Recorder
from hdr_nsff.training.run_folder import Run


@dataclass(frozen=True)
class Geometry:
    """Where the surfaces of a view are and how they move."""

    depth: Tensor  # (H, W) z-depth; 0 where a true ray hits nothing
    # {+-1: (H, W, 2)} pixels per frame in the view's own camera at rest, to later and
    # earlier times
    flow: dict[int, Tensor]
    scene_flow: dict[int, Tensor]  # {+-1: (H, W, 3)} units per frame, axes of the scene


def predict(
    run: Run, views: Mapping[str, PathView], folder: Path, description: str, motion: bool
) -> list[Path]:
    """Render an EXR per named view, `folder`/NAME.exr: radiance and depth.

    With `motion` also scene flow per frame in channels like `forward.x`. Files of the
    same run are kept, so that a killed evaluation continues where it was.
    """
    key = json.dumps(fingerprint(run, motion, list(views.items())))
    path = folder / "predictions.json"
    if not path.is_file() or path.read_text(encoding="utf-8", errors="replace") != key:
        for old in [*folder.glob("*.exr"), *folder.glob("*.png")]:
            old.unlink()
        write_text(path, key)
    files = {name: folder / f"{name}.exr" for name in views}
    for name, view in track(list(views.items()), description):
        if not is_readable(files[name]):
            write_exr(files[name], render_maps(run, view, motion), half=False)
    return list(files.values())


def is_readable(path: Path) -> bool:
    """Whether there is a prediction that is not damaged."""
    try:
        return bool(read_exr(path))
    except InputError:
        return False


def render_maps(run: Run, view: PathView, motion: bool) -> dict[str, np.ndarray]:
    """The EXR channels of one view."""
    camera = to_device(view.camera, device_of(run))
    times = run.scene.times.tolist()
    with torch.no_grad():
        seen = render_at(run.field, camera, view.time, times, scene_flow=motion)

    def image(values: Tensor) -> np.ndarray:
        return values.reshape(camera.height, camera.width, *values.shape[1:]).float().cpu().numpy()

    channels = {"RGB": image(seen.radiance), "Z": image(seen.depth)}
    for side, frames in intervals(view.time, times).items():
        if side in seen.scene_flow:
            flow = image(seen.scene_flow[side]) / frames
            channels |= {
                f"{MOTION_DIRECTIONS[side]}.{axis}": flow[..., k] for k, axis in enumerate("xyz")
            }
    return channels


def intervals(time: float, times: Sequence[float]) -> dict[int, float]:
    """The frames that a field's scene flow at `time` spans, {+-1: forward, backward}.

    At one of the training `times` it reaches the next one; between two of them its end
    is interpolated as well. A side beyond the clip is left out, because nothing was
    learned there.
    """
    positions = np.arange(len(times))
    knot = float(np.interp(time, times, positions))
    spans = {}
    for side in MOTION_DIRECTIONS:
        if 0 <= knot + side <= len(times) - 1:
            end = float(np.interp(knot + side, positions, times))
            spans[side] = abs(end - time)
    return spans


def radiance_of(path: Path) -> Tensor:
    """Radiance (H, W, 3) of a prediction."""
    return torch.from_numpy(read_exr(path)["RGB"])


def geometry_of(path: Path, view: PathView) -> Geometry:
    """Depth and motion of a prediction, in scene units."""
    channels = {name: torch.from_numpy(array) for name, array in read_exr(path).items()}
    depth = channels["Z"]
    pixels = view.camera.pixel_grid()
    rays = view.camera.rays(pixels)
    points = rays.origins + depth.reshape(-1, 1) * rays.directions
    flow, scene_flow = {}, {}
    for side, name in MOTION_DIRECTIONS.items():
        if f"{name}.x" in channels:
            vectors = torch.stack([channels[f"{name}.{axis}"] for axis in "xyz"], -1)
            landing = view.camera.project(points + vectors.reshape(-1, 3))[0]
            scene_flow[side] = vectors
            flow[side] = (landing - pixels).view(*depth.shape, 2)
    return Geometry(depth, flow, scene_flow)


def recordings(run: Run, target: Target, radiance: Tensor) -> dict[int, Tensor]:
    """Recordings {bracket: (H, W, 3)} in [0, 1] of predicted `radiance` (H, W, 3).

    By the learned camera, at every bracket that the target has, with the target's own
    drift of exposure and white balance.
    """
    drift = target.drift + torch.tensor(target.white_balance)
    camera, brackets = target.camera_id, list(target.rgb)
    if drift.any():
        recorders = [run.tonemapper.drifted_recorder(b, camera, drift) for b in brackets]
    else:
        recorders = [run.tonemapper.recorder(b, camera) for b in brackets]
    return dict(zip(brackets, record(run, target, radiance, recorders), strict=True))


def recordings_at(run: Run, target: Target, radiance: Tensor, evs: Sequence[float]) -> list[Tensor]:
    """The same at any exposures, `evs` relative to the reference bracket."""
    if not evs:
        return []
    recorders = [run.tonemapper.recorder_at(ev, target.camera_id, lens=True) for ev in evs]
    return record(run, target, radiance, recorders)


def record(
    run: Run, target: Target, radiance: Tensor, recorders: Sequence[Recorder]
) -> list[Tensor]:
    """The same by given recorders."""
    device = device_of(run)
    camera = to_device(target.view.camera, device)
    flat = radiance.reshape(-1, 3).to(device)
    with torch.no_grad():
        pictures = record_pixels(run.field, camera, target.view.time, recorders, flat)
    return [picture.cpu().reshape(radiance.shape) for picture in pictures]
