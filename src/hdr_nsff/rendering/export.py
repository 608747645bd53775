"""Files for other programs: the Gaussians of a splat run at any time as a PLY, or one
PLY per training time; or a scene, for other methods, in a public data layout (the
writers are in `datasets/`).

Coordinates are the scene's: OpenCV axes (+x right, +y down, +z forward of the first
cameras), the units of its poses. A PLY knows neither background nor tone curve, so
every Gaussian gets a color of its own, developed as `render` develops pixels, or its
linear radiance. The background is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Protocol, runtime_checkable

import numpy as np
import torch
import tyro

from hdr_nsff.core import io, notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.fields.base import GaussianCloud, RadianceField
from hdr_nsff.footage.layouts import held_out as to_held_out
from hdr_nsff.footage.layouts import llff as to_llff
from hdr_nsff.footage.layouts import nerfstudio as to_nerfstudio
from hdr_nsff.footage.layouts.writer import Source
from hdr_nsff.geometry.paths import training_path
from hdr_nsff.rendering import ply
from hdr_nsff.rendering.shots import develop, display_exposure, fingerprint
from hdr_nsff.training.run_folder import Run, read_config


@dataclass(frozen=True)
class Coloring:
    """How radiance becomes the color of a Gaussian."""

    ev: float | None = None
    """Develop colors at this exposure, relative to the reference; default: tone-map for
    a display.
    """
    linear: bool = False
    """Linear radiance instead of developed colors, unbounded."""
    camera_id: int = 0
    """Whose learned response and white balance develop the colors (with --ev)."""


@dataclass(frozen=True)
class ExportConfig:
    """The Gaussians of a splat run for viewers, or a scene in a public data layout for
    other methods.

    Gaussians at a time: hdr-nsff export out/run frame.ply --ply --time 12.5

    Images, poses_bounds.npy, masks, depth, flow and a COLMAP model: hdr-nsff export
    out/scene out/gopro --layout hdr-gopro

    transforms.json, images and depth: hdr-nsff export out/scene out/ns --layout
    nerfstudio

    With held-out views, as recorded: hdr-nsff export out/scene out/ns --layout
    nerfstudio --truth truth

    `hdr-nsff prepare` reads both layouts back to the same scene.
    """

    run: tyro.conf.Positional[Path]
    """Run folder; for --layout a scene folder, or a run folder, whose scene is meant.
    """
    out: tyro.conf.Positional[Path]
    """What to write: a file NAME.ply with --ply, a folder with --ply-sequence and
    --layout.
    """
    layout: Literal["hdr-gopro", "nerfstudio"] | None = None
    """The scene's frames, poses, masks, depth and flow as HDR-GoPro / NSFF (LLFF), one
    picture per time, or as nerfstudio's.
    """
    truth: Path | None = None
    """With --layout: a truth folder, as `synth`, `reexpose` and `prepare` write them;
    its views become held-out pictures of the layout.
    """
    ply: bool = False
    """One PLY, at --time."""
    ply_sequence: bool = False
    """One numbered PLY per training time."""
    time: float | None = None
    """In frames of the clip, may be fractional; default: the middle one."""
    device: str = "auto"
    """auto, cpu or cuda."""
    coloring: Annotated[Coloring, tyro.conf.arg(name="")] = field(default_factory=Coloring)


@runtime_checkable
class GaussianField(RadianceField, Protocol):
    """A field made of Gaussians."""

    def gaussians(self, time: float) -> GaussianCloud:
        """All visible ones at `time` in frames, without gradients."""
        ...


Colors = Callable[[np.ndarray], np.ndarray]  # radiance (G, 3) to what is written (G, 3)


def export(config: ExportConfig) -> Path:
    """The verb: the file or folder that was written."""
    check_settings(config)
    if config.layout is not None:
        return export_scene(config.run, config.out, config.layout, config.truth)
    run = Run.open(config.run, config.device)
    with io.writing_to(config.out), lock_output(config.out):
        if config.ply_sequence:
            return export_sequence(run, config.out, config.coloring)
        times = sorted({f.time for f in run.scene.train})
        time = times[len(times) // 2] if config.time is None else config.time
        return export_one(run, config.out, time, config.coloring)


def check_settings(config: ExportConfig) -> None:
    """InputError for settings that make no sense whatever the run is."""
    coloring = config.coloring
    if config.ply + config.ply_sequence + (config.layout is not None) != 1:
        raise InputError(
            "export: say what to write, one of --ply (a file), --ply-sequence and --layout NAME (a folder)"
        )
    if config.layout is not None and (config.time is not None or coloring != Coloring()):
        raise InputError(
            "--layout: writes the recorded frames; --time, --ev, --linear and --camera-id are for Gaussians"
        )
    if config.layout is None and config.truth is not None:
        raise InputError(
            "--truth: held-out views are pictures, and Gaussians have none; use it with --layout NAME"
        )
    if config.ply and (config.out.suffix.lower() != ".ply" or config.out.is_dir()):
        raise InputError(f"{config.out}: --ply writes one file; give it a name that ends in .ply")
    if config.ply_sequence and config.out.is_file():
        raise InputError(
            f"{config.out}: is a file; --ply-sequence writes a folder, name another one"
        )
    if config.ply_sequence and config.time is not None:
        raise InputError(
            "--time: --ply-sequence writes every training time; use --ply for one time"
        )
    if coloring.linear and coloring.ev is not None:
        raise InputError("--linear --ev: linear radiance is not developed; leave one of them out")
    if coloring.ev is not None and not abs(coloring.ev) < 60:
        raise InputError(
            f"--ev {coloring.ev:g}: an exposure in stops relative to the reference, like -2 or 1.5"
        )


def export_scene(
    folder: Path, out: Path, layout: Literal["hdr-gopro", "nerfstudio"], truth: Path | None = None
) -> Path:
    """Write the scene of a scene or run folder in a public layout, with the views of a
    `truth` folder; the folder that was written.
    """
    if not (folder / "scene.json").is_file():
        if not (folder / "config.json").is_file():
            raise InputError(
                f"{folder}: neither a scene folder nor a run folder; make a scene with `hdr-nsff prepare`"
            )
        folder = read_config(folder).scene
    for what, kept in (("scene", folder), ("truth", truth)):
        if kept is not None and (
            out.resolve().is_relative_to(kept.resolve())
            or kept.resolve().is_relative_to(out.resolve())
        ):
            raise InputError(
                f"{out}: overlaps the {what} folder {kept}; name a folder outside of it"
            )
    source = Source.open(folder)
    views = to_held_out.views_of(source, truth) if truth is not None else []
    with io.writing_to(out), lock_output(out):
        match layout:
            case "hdr-gopro":
                to_llff.write(source, out, views)
            case "nerfstudio":
                to_nerfstudio.write(source, out, views)
    say(f"{out}: the scene in the {layout} layout; `hdr-nsff prepare {out} SCENE` reads it back")
    return out


def export_one(run: Run, path: Path, time: float, coloring: Coloring) -> Path:
    """Write the Gaussians at `time` in frames to `path`; what it was called."""
    source = gaussian_field(run, coloring)
    times = [f.time for f in run.scene.train]
    if not (math.isfinite(time) and min(times) <= time <= max(times)):
        raise InputError(
            f"--time {time:g}: outside the clip ({min(times):g} to {max(times):g} frames)"
        )
    if path.exists() and not ply.is_ours(path):
        raise InputError(
            f"{path}: is there already and was not made by export; choose another name"
        )
    colors = colors_of(run, coloring, exposure_of(run, coloring))
    count = write_time(source, path, time, colors, coloring)
    say(f"{path}: {count} Gaussians at time {time:g}")
    return path


def export_sequence(run: Run, folder: Path, coloring: Coloring) -> Path:
    """Write `folder/00000.ply`, ... at the training times, in order; files already
    there with the same fingerprint are kept.
    """
    source = gaussian_field(run, coloring)
    times = sorted({f.time for f in run.scene.train})
    note = open_folder(run, folder, times, coloring)
    colors = colors_of(run, coloring, note.display_exposure)
    for i, time in enumerate(track(times, "exporting")):
        if not (path := folder / f"{i:05d}.ply").exists():
            write_time(source, path, time, colors, coloring)
    say(f"{folder}: {len(times)} files, one per training time")
    return folder


def open_folder(run: Run, folder: Path, times: list[float], coloring: Coloring) -> notes.Exported:
    """The sidecar of a sequence. Where the one on disk is of other settings or of
    another checkpoint, its files are removed.
    """
    key, sidecar = fingerprint(run, times, coloring), folder / "sequence.json"
    there = sorted(folder.glob("[0-9]*.ply"))
    foreign = next((p for p in there if not ply.is_ours(p)), None)
    if foreign is not None:
        raise InputError(
            f"{foreign}: is there already and was not made by export; choose another folder"
        )
    found = notes.read(sidecar, notes.Exported)
    if found is not None and found.key == key:
        return found
    if there:
        say(f"{folder}: settings or checkpoint changed, exporting again")
    for path in there:
        path.unlink()
    note = notes.Exported(
        key=key, step=run.step, times=times, display_exposure=exposure_of(run, coloring)
    )
    notes.write(sidecar, note)
    return note


def gaussian_field(run: Run, coloring: Coloring) -> GaussianField:
    """The run's field; InputError where it is not made of Gaussians, or for a camera
    that the run has not learned.
    """
    if not isinstance(run.field, GaussianField):
        raise InputError(
            f"{run.folder}: its field is not made of Gaussians, so there are none to export; train one with `train splat`"
        )
    if not 0 <= coloring.camera_id < run.tonemapper.num_cameras:
        raise InputError(
            f"camera {coloring.camera_id}: the run has learned cameras 0 to {run.tonemapper.num_cameras - 1}"
        )
    return run.field


def exposure_of(run: Run, coloring: Coloring) -> float:
    """The display exposure of the clip as filmed, one for all times; 1 where it is not
    asked for.
    """
    if coloring.linear or coloring.ev is not None:
        return 1.0
    frames = sorted(run.scene.train, key=lambda f: f.time)
    return display_exposure(
        run, training_path([f.camera for f in frames], [f.time for f in frames])
    )


def colors_of(run: Run, coloring: Coloring, exposure: float) -> Colors:
    """How radiance becomes color."""
    if coloring.linear:
        return lambda radiance: radiance
    return lambda radiance: develop(run, radiance, coloring.ev, coloring.camera_id, exposure)


def write_time(
    source: GaussianField, path: Path, time: float, colors: Colors, coloring: Coloring
) -> int:
    """Write the visible Gaussians at `time` in frames; how many there are."""
    cloud = source.gaussians(time)
    whole = (
        torch.cat([cloud.means, cloud.quaternions, cloud.scales, cloud.radiance], 1)
        .isfinite()
        .all(1)
    )

    def array(values: torch.Tensor) -> np.ndarray:
        return values[whole].float().cpu().numpy()

    splats = ply.Splats(
        array(cloud.means),
        array(cloud.quaternions),
        array(cloud.scales),
        array(cloud.opacities),
        colors(array(cloud.radiance)),
    )
    comments = [
        f"time {time:g} frames",
        "axes OpenCV: +x right, +y down, +z forward",
        "color linear radiance" if coloring.linear else "color developed rgb",
    ]
    ply.write(path, splats, comments)
    return int(whole.sum())
