"""The Gaussians of a splat run as PLY files for other programs.

At any time, or one file per training time. Coordinates are the scene's: OpenCV axes (+x
right, +y down, +z forward of the first cameras), the units of its poses. A PLY knows
neither background nor tone curve, so every Gaussian gets a color of its own, developed
as `render` develops pixels, or its linear radiance. The background is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say, track
from hdr_nsff.fields.base import RadianceField
from hdr_nsff.fields.outputs import GaussianCloud
from hdr_nsff.geometry.paths import training_path
from hdr_nsff.rendering import ply
from hdr_nsff.rendering.develop import develop, display_exposure
from hdr_nsff.rendering.fingerprint import fingerprint
from hdr_nsff.training.run_folder import Run

NOT_OURS = "already exists and was not made by export"


@dataclass(frozen=True)
class ColorTransform:
    """From radiance to the color of a Gaussian."""

    ev: float | None = None
    """Develop colors at this exposure, relative to the reference; default: tone-map for
    a display.
    """
    linear: bool = False
    """Linear radiance instead of developed colors, unbounded."""
    camera_id: int = 0
    """Whose learned response and white balance develop the colors (with --ev)."""


@runtime_checkable
class GaussianField(RadianceField, Protocol):
    """A field made of Gaussians."""

    def gaussians(self, time: float) -> GaussianCloud:
        """All visible ones at `time` in frames, without gradients."""
        ...


ColorFunction = Callable[[np.ndarray], np.ndarray]  # radiance (G, 3) to the file's colors (G, 3)


def export_one(run: Run, path: Path, time: float, transform: ColorTransform) -> Path:
    """Write the Gaussians at `time` in frames to `path`, which is returned."""
    source = gaussian_field(run, transform)
    times = [f.time for f in run.scene.train]
    if not (math.isfinite(time) and min(times) <= time <= max(times)):
        problem = f"outside the clip ({min(times):g} to {max(times):g} frames)"
        raise InputError(f"--time {time:g}: {problem}")
    if path.exists() and not ply.is_ours(path):
        raise InputError(f"{path}: {NOT_OURS}; choose another name")
    colors = color_function(run, transform, exposure_of(run, transform))
    count = write_gaussians(source, path, time, colors, transform.linear)
    say(f"{path}: {count} Gaussians at time {time:g}")
    return path


def export_sequence(run: Run, folder: Path, transform: ColorTransform) -> Path:
    """Write `folder/00000.ply`, ... at the training times, in order.

    Nothing else is in the folder, as players ask for. Files already there with the same
    fingerprint are kept.
    """
    source = gaussian_field(run, transform)
    times = sorted({f.time for f in run.scene.train})
    note = open_sequence(run, folder, times, transform)
    colors = color_function(run, transform, note.display_exposure)
    for i, time in enumerate(track(times, "exporting")):
        path = folder / f"{i:05d}.ply"
        if not path.exists():
            write_gaussians(source, path, time, colors, transform.linear)
    say(f"{folder}: {len(times)} files, one per training time")
    return folder


def open_sequence(
    run: Run, folder: Path, times: list[float], transform: ColorTransform
) -> notes.ExportedSequence:
    """The note of a sequence, new or as it was left.

    Files of other settings or of another checkpoint are removed. InputError for PLY
    files that no `export` wrote.
    """
    key = fingerprint(run, times, transform)
    files = sorted(folder.glob("[0-9]*.ply"))
    for file in files:
        if not ply.is_ours(file):
            raise InputError(f"{file}: {NOT_OURS}; choose another folder")
    path = note_path(folder)
    found = notes.read(path, notes.ExportedSequence)
    inside = folder / "sequence.json"  # where older versions have left it
    if notes.read(inside, notes.ExportedSequence) is not None:
        inside.unlink()
    if found is not None and found.key == key:
        return found
    if files:
        say(f"{folder}: settings or checkpoint changed, exporting again")
    for file in files:
        file.unlink()
    exposure = exposure_of(run, transform)
    note = notes.ExportedSequence(key=key, step=run.step, times=times, display_exposure=exposure)
    notes.write(path, note)
    return note


def note_path(folder: Path) -> Path:
    """Where the note of a sequence is: beside its folder."""
    place = folder.resolve()
    return place.with_name(f"{place.name}.sequence.json")


def gaussian_field(run: Run, transform: ColorTransform) -> GaussianField:
    """The run's field, if it is made of Gaussians.

    InputError where it is not, or for a camera that the run has not learned.
    """
    if not isinstance(run.field, GaussianField):
        problem = "its field is not made of Gaussians, so there are none to export"
        raise InputError(f"{run.folder}: {problem}; train one with `train splat`")
    cameras = run.tonemapper.num_cameras
    if not 0 <= transform.camera_id < cameras:
        problem = f"the run has learned cameras 0 to {cameras - 1}"
        raise InputError(f"camera {transform.camera_id}: {problem}")
    return run.field


def exposure_of(run: Run, transform: ColorTransform) -> float:
    """The display exposure of the clip as filmed, one for all times.

    1 where colors are not tone-mapped for a display.
    """
    if transform.linear or transform.ev is not None:
        return 1.0
    frames = sorted(run.scene.train, key=lambda f: f.time)
    views = training_path([f.camera for f in frames], [f.time for f in frames])
    return display_exposure(run, views)


def color_function(run: Run, transform: ColorTransform, exposure: float) -> ColorFunction:
    """The function from radiance to color; `exposure` is that of the display."""
    if transform.linear:
        return lambda radiance: radiance
    return lambda radiance: develop(run, radiance, transform.ev, transform.camera_id, exposure)


def write_gaussians(
    source: GaussianField, path: Path, time: float, colors: ColorFunction, linear: bool
) -> int:
    """Write the visible Gaussians at `time` in frames; their number.

    Those with NaN or Inf are left out.
    """
    cloud = source.gaussians(time)
    numbers = torch.cat([cloud.means, cloud.quaternions, cloud.scales, cloud.radiance], 1)
    finite = numbers.isfinite().all(1)

    def array(values: torch.Tensor) -> np.ndarray:
        return values[finite].float().cpu().numpy()

    splats = ply.Splats(
        means=array(cloud.means),
        quaternions=array(cloud.quaternions),
        scales=array(cloud.scales),
        opacities=array(cloud.opacities),
        colors=colors(array(cloud.radiance)),
    )
    comments = [
        f"time {time:g} frames",
        "axes OpenCV: +x right, +y down, +z forward",
        "color linear radiance" if linear else "color developed rgb",
    ]
    ply.write(path, splats, comments)
    return int(finite.sum())
