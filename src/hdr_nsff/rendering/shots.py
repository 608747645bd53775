"""A shot: a named list of views, and the files made of it.

Each shot gets a folder of numbered files and a `sequence.json` with a hash of
everything the pictures depend on. A restart keeps the pictures of the same hash;
another hash starts over.

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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import Codec, check_side
from hdr_nsff.core.images import contact_sheet, read_image, write_png
from hdr_nsff.core.ocio import Look
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.tensors import to_device
from hdr_nsff.core.video import write_video
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.maths import color
from hdr_nsff.maths.hdr_signal import Transfer
from hdr_nsff.radiometry.hdr_stills import HdrStill, still_path, still_paths, write_hdr_still
from hdr_nsff.rendering.exr_header import WhiteBalance, balance, radiance_header
from hdr_nsff.rendering.hdr_shots import hdr_path, hdr_paths, neutral_radiance, write_hdr_shot
from hdr_nsff.rendering.interpolate import Mode
from hdr_nsff.rendering.lens import LensView, original_lens
from hdr_nsff.rendering.mattes import ObjectMattes
from hdr_nsff.rendering.stills import Vectors, device_of, render_still, write_still
from hdr_nsff.training.run_folder import Run

PROBE_SCALE = 0.25  # size of the pictures that set the display exposure (hand-chosen: it is fast)
SHEET_VIEWS = 12  # on a contact sheet
SHEET_COLUMNS = 4


@dataclass(frozen=True)
class Output:
    """Which files are written for every view, and how pictures are developed."""

    exr: Literal["half", "float", "none"] = "half"
    """EXR: radiance, alpha, depth Z, motion, motion vectors, mattes of the movers."""
    exr_vectors: Vectors = "nuke"
    """Names and signs of motion on the screen: forward.u, ... for Nuke, Vector.X, ...
    for Blender.
    """
    png: bool = True
    """8-bit PNG."""
    video: bool = True
    """8-bit H.264 MP4."""
    hdr_video: tuple[Transfer, ...] = ()
    """10-bit HDR video: hlg, pq (HDR10) or both. Diffuse white is 203 nits, the peak
    1000.
    """
    hdr_codec: Codec = "hevc"
    """Of HDR videos: hevc plays on more screens, av1 is royalty-free, prores (4444,
    MOV) is for editing programs.
    """
    hdr_still: tuple[HdrStill, ...] = ()
    """HDR picture of every view: ultrahdr (JPEG with a gain map, for phones and
    browsers), avif (PQ, 10 bits), png16 (PQ, 16 bits).
    """
    ev: float | None = None
    """Develop at this exposure, relative to the reference; default: tone-map for a
    display.
    """
    ocio: str | None = None
    """Develop PNG and video by OpenColorIO instead: studio-config-latest,
    cg-config-latest, or a file NAME.ocio. White is as for HDR: --ev, else the
    display's exposure.
    """
    view: str | None = None
    """With --ocio: a view, like 'ACES 2.0 - SDR 100 nits (Rec.709)'; default: the
    display's first.
    """
    display: str | None = None
    """With --ocio: a display, like 'sRGB - Display'; default: the first."""
    camera_id: int = 0
    """Whose learned response and white balance develop the picture (with --ev), and
    whose neutral --white-balance takes.
    """
    white_balance: WhiteBalance = "camera"
    """Radiance in EXR files. camera: in the run's unit of each channel; neutral: times
    the gains that make gray neutral. The header has these gains either way. PNG and
    video are neutral anyhow.
    """
    lens: Literal["pinhole", "original"] = "pinhole"
    """original: with the distortion of the clip's lens (of --camera-id), where
    `prepare` has removed one.
    """
    between: Mode = "auto"
    """Times between frames: splat along the scene flow, or ask the field directly; auto
    splats where the field can.
    """


@dataclass(frozen=True)
class Shot:
    """A named list of views and its speed."""

    name: str
    views: list[PathView]
    fps: float


def develop(
    run: Run, radiance: np.ndarray, ev: float | None, camera_id: int, exposure: float
) -> np.ndarray:
    """Radiance (..., 3) as an rgb picture in [0, 1].

    Recorded by a learned camera at `ev`, or (None) tone-mapped for a display
    at `exposure`.
    """
    if ev is None:
        neutral = run.tonemapper.neutral(camera_id).cpu().numpy()
        return color.display(radiance * neutral, exposure)
    values = torch.from_numpy(radiance).to(device_of(run))
    return run.tonemapper.develop(values, ev, camera_id).cpu().numpy()


def develop_view(
    run: Run,
    view: PathView,
    radiance: np.ndarray,
    ev: float | None,
    camera_id: int,
    exposure: float,
) -> np.ndarray:
    """The same for a view of which the run rendered `radiance` (H, W, 3).

    Fields that record before they composite are rendered again.
    """
    if ev is None:
        return develop(run, radiance, ev, camera_id, exposure)
    flat = torch.from_numpy(radiance.reshape(-1, 3)).to(device_of(run))
    camera = to_device(view.camera, device_of(run))
    recorder = run.tonemapper.recorder_at(ev, camera_id)
    picture = record_pixels(run.field, camera, view.time, [recorder], flat)[0]
    return picture.cpu().numpy().reshape(radiance.shape)


def display_exposure(run: Run, views: Sequence[PathView]) -> float:
    """One display exposure for a whole shot.

    It is that of small pictures of its first, middle and last view.
    """
    probes = [views[i] for i in sorted({0, len(views) // 2, len(views) - 1})]
    radiance = []
    for probe in probes:
        still = render_still(run, probe.resized(PROBE_SCALE), "direct", motion=False)
        radiance.append(still.radiance.reshape(-1, 3))
    return color.auto_exposure(np.concatenate(radiance))


# One shot


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


def render_shot(run: Run, shot: Shot, out: Path, output: Output) -> Path:
    """Write the shot's stills to `out/<name>/`, its video and contact sheet beside it.

    Returns the path of the video; without one, of the folder.
    """
    cameras = run.tonemapper.num_cameras
    if not 0 <= output.camera_id < cameras:
        problem = f"the run has learned cameras 0 to {cameras - 1}"
        raise InputError(f"camera {output.camera_id}: {problem}")
    check_sides(out, shot, output)
    folder, video = out / shot.name, out / f"{shot.name}.mp4"
    sheet = out / f"{shot.name}_sheet.png"
    products = [video, sheet, *hdr_paths(out, shot.name)]
    note = open_sequence(run, shot, folder, output, products)
    result = video if output.video else folder
    pictures = [folder / f"{i:05d}.png" for i in range(len(shot.views))]
    stills = still_paths(pictures, output.hdr_still)
    wanted = [*wanted_files(pictures, video, output), *hdr_files(out, shot.name, output), *stills]
    if note.complete and all(path.exists() for path in wanted):
        say(f"{shot.name}: all {len(shot.views)} views are there already ({folder})")
        return result
    start = time.monotonic()
    mattes = ObjectMattes.of_run(run) if output.exr != "none" else None
    look = open_look(output)
    for i in track(range(len(pictures)), f"rendering {shot.name}"):
        write_view(run, shot, i, pictures[i], output, note.display_exposure, mattes, look)
    if output.video:
        write_video(video, (read_image(p) for p in pictures), shot.fps)
    write_hdr_videos(run, shot, pictures, out, output, note.display_exposure)
    write_hdr_stills(run, shot, pictures, output, note.display_exposure)
    write_sheet(sheet, pictures)
    for picture in pictures:
        if not output.png:
            picture.unlink(missing_ok=True)
        if output.exr == "none":
            picture.with_suffix(".exr").unlink(missing_ok=True)
    seconds = round(note.seconds + time.monotonic() - start, 2)
    done = note.model_copy(update={"complete": True, "seconds": seconds})
    notes.write(folder / "sequence.json", done)
    return result


def check_sides(out: Path, shot: Shot, output: Output) -> None:
    """InputError where the encoders of HDR files do not take pictures of this size."""
    files = hdr_files(out, shot.name, output)
    if "avif" in output.hdr_still:
        files.append(still_path(out / shot.name / "00000.png", "avif"))
    camera = shot.views[0].camera
    for path in files:
        check_side(path, camera.width // 2 * 2, camera.height // 2 * 2)


def wanted_files(pictures: Sequence[Path], video: Path, output: Output) -> list[Path]:
    """The files that a complete shot consists of."""
    wanted: list[Path] = []
    if output.exr != "none":
        wanted += [p.with_suffix(".exr") for p in pictures]
    if output.png:
        wanted += pictures
    if output.video:
        wanted.append(video)
    return wanted


def name_results(
    out: Path, shot: Shot, label: str, output: Output, result: Path
) -> dict[str, Path]:
    """What a user gets of a shot: `result` of `render_shot` and the HDR videos."""
    videos = hdr_files(out, shot.name, output)
    named = {f"{label}, {t}": path for t, path in zip(output.hdr_video, videos, strict=True)}
    with_pictures = output.video or output.png or output.exr != "none" or output.hdr_still
    if not with_pictures:
        return named
    return {label: result, **named}


def hdr_files(out: Path, name: str, output: Output) -> list[Path]:
    """The HDR videos that `output` asks for."""
    return hdr_paths(out, name, output.hdr_video, [output.hdr_codec])


def write_hdr_videos(
    run: Run,
    shot: Shot,
    pictures: Sequence[Path],
    out: Path,
    output: Output,
    display_exposure: float,
) -> None:
    """The HDR videos of a shot, from the EXR files beside its `pictures`.

    Exposed at the EV that was asked for, else as for a display.
    """
    files = [picture.with_suffix(".exr") for picture in pictures]
    exposure = display_exposure if output.ev is None else 2.0**output.ev
    balanced = output.white_balance, output.camera_id
    for transfer in output.hdr_video:
        path = hdr_path(out, shot.name, transfer, output.hdr_codec)
        codec = output.hdr_codec
        write_hdr_shot(run, files, path, transfer, codec, shot.fps, exposure, *balanced)


def write_hdr_stills(
    run: Run, shot: Shot, pictures: Sequence[Path], output: Output, display_exposure: float
) -> None:
    """The HDR stills that are missing, from the EXR files beside the `pictures`."""
    balanced = output.white_balance, output.camera_id
    for picture, view in zip(pictures, shot.views, strict=True):
        ev = ev_of(view, output)
        exposure = display_exposure if ev is None else 2.0**ev
        missing = [kind for kind in output.hdr_still if not still_path(picture, kind).exists()]
        if missing:
            radiance = next(neutral_radiance(run, [picture.with_suffix(".exr")], *balanced))
            sdr = read_image(picture)
            for kind in missing:
                write_hdr_still(still_path(picture, kind), kind, radiance, exposure, sdr)


def write_sheet(path: Path, pictures: Sequence[Path]) -> None:
    """A contact sheet of up to `SHEET_VIEWS` pictures, spread evenly over the shot."""
    count = min(SHEET_VIEWS, len(pictures))
    chosen = sorted({round(i) for i in np.linspace(0, len(pictures) - 1, count)})
    cells = [read_image(pictures[i]) for i in chosen]
    rows = [cells[i : i + SHEET_COLUMNS] for i in range(0, len(cells), SHEET_COLUMNS)]
    write_png(path, contact_sheet(rows))


def open_sequence(
    run: Run, shot: Shot, folder: Path, output: Output, products: Sequence[Path]
) -> notes.Sequence:
    """The note of a shot, new or as it was left.

    Pictures and `products` of other settings or of another checkpoint are removed.
    InputError for files that no `render` has written.
    """
    key = fingerprint(run, shot.views, shot.fps, picture_settings(output))
    path = folder / "sequence.json"
    found = notes.read(path, notes.Sequence)
    if found is not None and found.key == key:
        return found
    if found is not None:
        say(f"{shot.name}: settings or checkpoint changed, rendering again")
    old = [*numbered_pictures(folder), *(p for p in products if p.exists())]
    if old and not path.is_file():
        problem = "already exists and was not made by render"
        raise InputError(f"{old[0]}: {problem}; choose another --out")
    for file in old:
        file.unlink()
    note = notes.Sequence(
        key=key,
        step=run.step,
        fps=shot.fps,
        display_exposure=display_exposure(run, shot.views),
        views=[notes.SequenceView(time=v.time, ev=ev_of(v, output)) for v in shot.views],
        seconds=0.0,
    )
    notes.write(path, note)
    return note


def picture_settings(output: Output) -> dict[str, Any]:
    """The settings that the pictures and EXR files of a shot depend on."""
    later = {"hdr_video", "hdr_codec", "hdr_still"}  # made from them
    if output.lens == "pinhole":
        later.add("lens")  # as before there was a choice
    return {name: value for name, value in vars(output).items() if name not in later}


def numbered_pictures(folder: Path) -> list[Path]:
    """Pictures and EXR files in `folder` whose names begin with a digit."""
    endings = {".png", ".exr", ".jpg", ".avif"}
    return [p for p in folder.glob("[0-9]*") if p.suffix in endings]


def ev_of(view: PathView, output: Output) -> float | None:
    """The EV at which a view is developed; None: tone-mapped for a display."""
    return output.ev if view.ev is None else view.ev


def write_view(
    run: Run,
    shot: Shot,
    index: int,
    picture: Path,
    output: Output,
    exposure: float,
    mattes: ObjectMattes | None,
    look: Look | None,
) -> None:
    """Write `picture` and the EXR beside it where one of them is missing.

    `exposure` is that of the display.
    """
    view = shot.views[index]
    exr = picture.with_suffix(".exr")
    with_vectors = output.exr != "none"
    with_exr = with_vectors or bool(output.hdr_video or output.hdr_still)  # made from EXR
    if picture.exists() and (exr.exists() or not with_exr):
        return
    steps = neighbor_views(shot.views, index) if with_vectors else {}
    lens_view = view_through_lens(run, view, output)
    if lens_view is None:
        still = render_still(run, view, output.between, with_vectors, steps)
    else:
        lenses = {side: view_through_lens(run, v, output) for side, v in steps.items()}
        steps = {side: each.view for side, each in lenses.items() if each is not None}
        rendered = render_still(run, lens_view.view, output.between, with_vectors, steps)
        still = lens_view.distort_still(rendered)
    ev = ev_of(view, output)
    if with_exr:
        header = radiance_header(run, output.white_balance, output.camera_id)
        if ev is None:
            header["displayExposure"] = exposure
        else:
            header["developedEV"] = float(ev)
        stored = balance(run, still.radiance, output.white_balance, output.camera_id)
        stored_still = replace(still, radiance=stored)
        objects = matte_pictures(mattes, view, lens_view)
        half = output.exr != "float"
        write_still(exr, stored_still, view, half, header, output.exr_vectors, objects)
    if look is None and lens_view is not None:
        rgb = develop(run, still.radiance, ev, output.camera_id, exposure)
    elif look is None:
        rgb = develop_view(run, view, still.radiance, ev, output.camera_id, exposure)
    else:
        white = exposure if ev is None else 2.0**ev
        rgb = look.develop(white * balance(run, still.radiance, "neutral", output.camera_id))
    write_png(picture, rgb)


def view_through_lens(run: Run, view: PathView, output: Output) -> LensView | None:
    """The view through the clip's lens; None for a pinhole camera."""
    if output.lens == "pinhole":
        return None
    return LensView.of(view, original_lens(run.scene.manifest, output.camera_id))


def matte_pictures(
    mattes: ObjectMattes | None, view: PathView, lens_view: LensView | None
) -> dict[str, np.ndarray]:
    """The mattes of a view by name, through the lens if there is one."""
    if mattes is None:
        return {}
    if lens_view is None:
        return mattes.coverage(view)
    return lens_view.distort_mattes(mattes.coverage(lens_view.view))


def open_look(output: Output) -> Look | None:
    """The look that develops pictures, where one is asked for."""
    if output.ocio is None:
        return None
    return Look(output.ocio, output.view, output.display)


def neighbor_views(views: Sequence[PathView], index: int) -> dict[int, PathView]:
    """The next (1) and the previous (-1) view of a shot, where there is one."""
    return {side: views[index + side] for side in (1, -1) if 0 <= index + side < len(views)}
