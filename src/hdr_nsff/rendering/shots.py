"""One shot: a named list of views, and the files made of it. Each shot gets a folder of
numbered files and a `sequence.json` that holds the hash of everything the pictures
depend on: frames that are already there are kept, another hash starts over.

Radiance is written in units of the reference exposure (1 = where it saturates).
Pictures are developed at an EV by a learned camera, or, with no EV asked for,
tone-mapped for a display with one exposure for the whole shot (never per frame: that
would flicker).
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from hdr_nsff.core import io, notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.process import hold_threads
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.tensors import to_device
from hdr_nsff.fields.base import Render, recorded
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.paths import View
from hdr_nsff.maths import color
from hdr_nsff.rendering.interpolate import Mode, render_at
from hdr_nsff.training.run_folder import Run


@dataclass(frozen=True)
class Output:
    """What is written for every view, and how it is developed."""

    exr: Literal["half", "float", "none"] = "half"
    """EXR: radiance, depth Z, motion, motion vectors."""
    png: bool = True
    """8-bit PNG."""
    video: bool = True
    """8-bit H.264 MP4."""
    ev: float | None = None
    """Develop at this exposure, relative to the reference; default: tone-map for a
    display.
    """
    camera_id: int = 0
    """Whose learned response and white balance develop the picture (with --ev)."""
    between: Mode = "auto"
    """Times between frames: splat along the scene flow, or ask the field directly; auto
    splats where the field can.
    """


@dataclass(frozen=True)
class Shot:
    """A named list of views and the speed it is played at."""

    name: str
    views: list[View]
    fps: float


@dataclass(frozen=True)
class Still:
    """One rendered view, numpy float32."""

    radiance: np.ndarray  # (H, W, 3) linear HDR
    depth: np.ndarray  # (H, W) z-depth, scene units
    motion: np.ndarray  # (H, W) in [0, 1]: share of dynamic content
    flow: dict[
        int, np.ndarray
    ]  # {+-1: (H, W, 2)} pixels: where the content moves until the next / previous frame, camera at rest


def device_of(run: Run) -> torch.device:
    """Where the run computes."""
    return run.tonemapper.knots.device


def take(run: Run, view: View, between: Mode = "auto", motion: bool = True) -> Still:
    """The picture of one view; without `motion` vectors it is there sooner."""
    hold_threads(run.config.torch_threads)
    camera = to_device(view.camera, device_of(run))
    with torch.no_grad():
        seen = render_at(run.field, camera, view.time, run.scene.times.tolist(), between, motion)
        flow = motion_vectors(seen, camera)

    def image(values: torch.Tensor) -> np.ndarray:
        return values.reshape(camera.height, camera.width, *values.shape[1:]).float().cpu().numpy()

    return Still(
        image(seen.radiance),
        image(seen.depth),
        image(seen.motion),
        {o: image(f) for o, f in flow.items()},
    )


def motion_vectors(seen: Render, camera: Camera) -> dict[int, torch.Tensor]:
    """The scene flow of a picture as pixels (S, 2) in the same camera: the motion of
    the content, not of the camera.
    """
    pixels = camera.pixel_grid()
    rays = camera.rays(pixels)
    points = rays.origins + seen.depth[:, None] * rays.directions
    return {o: camera.project(points + f)[0] - pixels for o, f in seen.scene_flow.items()}


def develop(
    run: Run, radiance: np.ndarray, ev: float | None, camera_id: int, exposure: float
) -> np.ndarray:
    """An rgb picture (..., 3) in [0, 1] of `radiance`: recorded by a learned camera at
    `ev`, or (None) tone-mapped for a display.
    """
    if ev is None:
        return color.display(radiance * run.tonemapper.neutral(camera_id).cpu().numpy(), exposure)
    return (
        run.tonemapper.develop(torch.from_numpy(radiance).to(device_of(run)), ev, camera_id)
        .cpu()
        .numpy()
    )


def picture_of(
    run: Run, view: View, radiance: np.ndarray, ev: float | None, camera_id: int, exposure: float
) -> np.ndarray:
    """The same of a view of which the run rendered `radiance` (H, W, 3); fields that
    record before they composite are asked again.
    """
    if ev is None:
        return develop(run, radiance, ev, camera_id, exposure)
    flat = torch.from_numpy(radiance.reshape(-1, 3)).to(device_of(run))
    camera = to_device(view.camera, device_of(run))
    return (
        recorded(run.field, camera, view.time, [run.tonemapper.recorder_at(ev, camera_id)], flat)[0]
        .cpu()
        .numpy()
        .reshape(radiance.shape)
    )


def display_exposure(run: Run, views: Sequence[View]) -> float:
    """One display exposure for a whole shot, from three small pictures of it."""
    probes = [views[i] for i in sorted({0, len(views) // 2, len(views) - 1})]
    seen = [
        take(run, v.resized(0.25), "direct", motion=False).radiance.reshape(-1, 3) for v in probes
    ]
    return color.auto_exposure(np.concatenate(seen))


def write_still(path: Path, still: Still, view: View, half: bool, header: dict[str, Any]) -> None:
    """One EXR: RGB radiance, `Z`, `motion`, and motion vectors `forward.u`, `.v`,
    `backward.u`, `.v` in pixels where known.
    """
    channels = {"RGB": still.radiance, "Z": still.depth, "motion": still.motion}
    for offset, name in io.SIDES.items():
        if offset in still.flow:
            channels |= {
                f"{name}.u": still.flow[offset][..., 0],
                f"{name}.v": still.flow[offset][..., 1],
            }
    pose = json.dumps([[round(float(x), 6) for x in row] for row in view.camera.c2w])
    io.write_exr(path, channels, {**header, "time": float(view.time), "cameraToWorld": pose}, half)


# One shot


def fingerprint(run: Run, *parts: Any) -> str:
    """A hash of the checkpoint and of everything else given: pictures of one hash are
    the same.
    """
    text = json.dumps([run.step, repr(run.config), *parts], default=plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def plain(value: Any) -> Any:
    """Tensors, paths and dataclasses for JSON."""
    return (
        value.tolist()
        if isinstance(value, torch.Tensor)
        else vars(value)
        if hasattr(value, "__dict__")
        else str(value)
    )


def render_shot(run: Run, shot: Shot, out: Path, output: Output) -> Path:
    """Write the shot's stills to `out/<name>/`, its video and contact sheet beside it;
    the video's path (or the folder's).
    """
    if not 0 <= output.camera_id < run.tonemapper.num_cameras:
        raise InputError(
            f"camera {output.camera_id}: the run has learned cameras 0 to {run.tonemapper.num_cameras - 1}"
        )
    folder, video = out / shot.name, out / f"{shot.name}.mp4"
    sheet = out / f"{shot.name}_sheet.png"
    note = open_sequence(run, shot, folder, output, [video, sheet])
    result = video if output.video else folder
    pictures = [folder / f"{i:05d}.png" for i in range(len(shot.views))]
    wanted = (
        [p.with_suffix(".exr") for p in pictures] * (output.exr != "none")
        + pictures * output.png
        + [video] * output.video
    )
    if note.complete and all(p.exists() for p in wanted):
        say(f"{shot.name}: all {len(shot.views)} views are there already ({folder})")
        return result
    start = time.monotonic()
    for picture, view in zip(pictures, track(shot.views, f"rendering {shot.name}"), strict=True):
        write_view(run, view, picture, output, note.display_exposure)
    if output.video:
        io.write_video(video, (io.read_image(p) for p in pictures), shot.fps)
    chosen = sorted({round(i) for i in np.linspace(0, len(pictures) - 1, min(12, len(pictures)))})
    cells = [io.read_image(pictures[i]) for i in chosen]
    io.write_png(sheet, io.contact_sheet([cells[i : i + 4] for i in range(0, len(cells), 4)]))
    if not output.png:
        for picture in pictures:
            picture.unlink(missing_ok=True)
    seconds = round(note.seconds + time.monotonic() - start, 2)
    notes.write(
        folder / "sequence.json", note.model_copy(update={"complete": True, "seconds": seconds})
    )
    return result


def open_sequence(
    run: Run, shot: Shot, folder: Path, output: Output, products: Sequence[Path]
) -> notes.Sequence:
    """The sidecar of a shot. Where the one on disk is of other settings or of another
    checkpoint, its files are removed.
    """
    key = fingerprint(run, shot.views, shot.fps, output)
    sidecar = folder / "sequence.json"
    found = notes.read(sidecar, notes.Sequence)
    if found is not None and found.key == key:
        return found
    if found is not None:
        say(f"{shot.name}: settings or checkpoint changed, rendering again")
    stale = (
        [p for p in folder.glob("[0-9]*") if p.suffix in {".png", ".exr"}]
        if folder.is_dir()
        else []
    )
    if not sidecar.is_file() and (foreign := [p for p in [*stale, *products] if p.exists()]):
        raise InputError(
            f"{foreign[0]}: is there already and was not made by render; choose another --out"
        )
    for path in [*stale, *products]:
        path.unlink(missing_ok=True)
    exposure = display_exposure(run, shot.views)
    views = [
        notes.SequenceView(time=v.time, ev=v.ev if v.ev is not None else output.ev)
        for v in shot.views
    ]
    note = notes.Sequence(
        key=key, step=run.step, fps=shot.fps, display_exposure=exposure, views=views, seconds=0.0
    )
    notes.write(sidecar, note)
    return note


def write_view(run: Run, view: View, picture: Path, output: Output, exposure: float) -> None:
    """Make `picture` and the EXR beside it where one of them is missing; `exposure` is
    that of the display.
    """
    exr = picture.with_suffix(".exr")
    if picture.exists() and (output.exr == "none" or exr.exists()):
        return
    still = take(run, view, output.between, motion=output.exr != "none")
    ev = view.ev if view.ev is not None else output.ev
    if output.exr != "none":
        shown = {"developedEV": float(ev)} if ev is not None else {"displayExposure": exposure}
        write_still(exr, still, view, output.exr == "half", {**exposure_header(run), **shown})
    io.write_png(picture, picture_of(run, view, still.radiance, ev, output.camera_id, exposure))


def exposure_header(run: Run) -> dict[str, Any]:
    """EXR attributes that say what a radiance of 1 means."""
    brackets = " ".join(f"{ev:+.3f}" for ev in run.tonemapper.exposures().tolist())
    return {
        "exposure": 0.0,
        "bracketEV": brackets,
        "comments": "linear radiance; `exposure` is its EV relative to the reference bracket, where 1 saturates; bracketEV: the clip's",
    }
