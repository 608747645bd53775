"""The files of a shot, which is a named list of views.

Each shot gets a folder of numbered files and a `sequence.json` with a hash of
everything the pictures depend on. A restart keeps the pictures of the same hash;
another hash starts over.

Radiance is written in units of the reference exposure (1 = where it saturates).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import check_rate, check_side
from hdr_nsff.core.images import contact_sheet, read_image, write_png
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.video import write_video
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.radiometry.hdr_stills import still_path, still_paths
from hdr_nsff.rendering.develop import display_exposure
from hdr_nsff.rendering.fingerprint import fingerprint
from hdr_nsff.rendering.hdr_shots import hdr_files, hdr_paths, write_hdr_stills, write_hdr_videos
from hdr_nsff.rendering.mattes import ObjectMattes
from hdr_nsff.rendering.output import Output, Shot, ev_of, picture_settings
from hdr_nsff.rendering.write_view import open_look, write_view
from hdr_nsff.scene.scene import Frame
from hdr_nsff.training.run_folder import Run

SHEET_VIEWS = 12  # on a contact sheet
SHEET_COLUMNS = 4


def render_shot(run: Run, shot: Shot, out: Path, output: Output, of_set: bool = False) -> Path:
    """Write the shot's stills to `out/<name>/`, its video and contact sheet beside it.

    Returns the path of the video; without one, of the folder. `of_set`: it is one of
    the standard set.
    """
    cameras = run.tonemapper.num_cameras
    if not 0 <= output.camera_id < cameras:
        problem = f"the run has learned cameras 0 to {cameras - 1}"
        raise InputError(f"camera {output.camera_id}: {problem}")
    check_encodable(out, shot, output)
    folder, video = out / shot.name, out / f"{shot.name}.mp4"
    sheet = out / f"{shot.name}_sheet.png"
    products = [video, sheet, *hdr_paths(out, shot.name)]
    note = open_sequence(run, shot, folder, output, products, of_set)
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


def filmed_frame(run: Run, view: PathView) -> Frame | None:
    """The frame that was filmed from a view at its time, if any."""
    for frame in [*run.scene.train, *run.scene.test]:
        if frame.time == view.time and torch.equal(frame.camera.c2w, view.camera.c2w):
            return frame
    return None


def describe_view(run: Run, view: PathView, output: Output) -> notes.SequenceView:
    """A view of a shot in its note."""
    frame = filmed_frame(run, view)
    index = None if frame is None else frame.index
    return notes.SequenceView(time=view.time, ev=ev_of(view, output), frame=index)


def is_made_by_path(run: Run, shot: Shot, out: Path, output: Output) -> bool:
    """Whether the shot is there, made with `--path` and otherwise than asked."""
    found = notes.read(out / shot.name / "sequence.json", notes.Sequence)
    if found is None or found.of_set or not found.complete:
        return False
    return found.key != fingerprint(run, shot.views, shot.fps, picture_settings(output))


def open_sequence(
    run: Run,
    shot: Shot,
    folder: Path,
    output: Output,
    products: Sequence[Path],
    of_set: bool = False,
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
        views=[describe_view(run, v, output) for v in shot.views],
        seconds=0.0,
        of_set=of_set,
    )
    notes.write(path, note)
    return note


def numbered_pictures(folder: Path) -> list[Path]:
    """Pictures and EXR files in `folder` whose names begin with a digit."""
    endings = {".png", ".exr", ".jpg", ".avif"}
    return [p for p in folder.glob("[0-9]*") if p.suffix in endings]


def check_encodable(out: Path, shot: Shot, output: Output) -> None:
    """InputError where the encoders of HDR files do not take this size or rate."""
    files = hdr_files(out, shot.name, output)
    for path in files:
        check_rate(path, output.hdr_codec, shot.fps)
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


def write_sheet(path: Path, pictures: Sequence[Path]) -> None:
    """A contact sheet of up to `SHEET_VIEWS` pictures, spread evenly over the shot."""
    count = min(SHEET_VIEWS, len(pictures))
    chosen = sorted({round(i) for i in np.linspace(0, len(pictures) - 1, count)})
    cells = [read_image(pictures[i]) for i in chosen]
    rows = [cells[i : i + SHEET_COLUMNS] for i in range(0, len(cells), SHEET_COLUMNS)]
    write_png(path, contact_sheet(rows))
