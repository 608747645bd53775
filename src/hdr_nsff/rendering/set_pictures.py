"""Pictures of the standard set, made from the EXR sequence of its training path.

LDR views at three exposures, depth, motion, and an overview of all of them. Depth and
motion take one range for the whole sequence, so that colors compare between pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdr_nsff.core import notes
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import colorize, colorize_flow, contact_sheet, read_image, write_png
from hdr_nsff.core.progress import say, track
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.develop import develop_view
from hdr_nsff.rendering.exr_header import unbalance
from hdr_nsff.rendering.fingerprint import fingerprint
from hdr_nsff.rendering.output import Output, Shot
from hdr_nsff.rendering.shots import filmed_frame
from hdr_nsff.training.run_folder import Run

MIN_EV_RANGE = 0.5  # stops: a clip of less has one exposure (hand-chosen)
EV_STEP = 2.0  # stops between the pictures of a clip of one exposure
DEPTH_PERCENTILES = (2, 98)  # near and far end of the colors (hand-chosen on rendered scenes)
MOTION_PERCENTILE = 99  # of the lengths: full saturation (hand-chosen on rendered scenes)
# Pixels between those that enter the percentiles, which need no more.
DEPTH_STRIDE, MOTION_STRIDE = 4, 2
MIN_DEPTH = 1e-6  # scene units
MIN_MOTION_PX = 1e-3
OVERVIEW_ROWS = 4


@dataclass(frozen=True)
class SequenceRanges:
    """One range for the pictures of a sequence."""

    near: float  # z-depth, scene units
    far: float
    fastest: float  # motion until the next frame, pixels
    moves: bool  # whether the field has scene flow


def write_pictures(run: Run, out: Path, shot: Shot, output: Output) -> dict[str, Path]:
    """Write the pictures of the training path `shot`; folders and files by name.

    Its EXR sequence, written as `output` says, is in `out`/training.
    """
    evs = three_exposures(run.tonemapper.exposures().tolist())
    results = {f"LDR at EV {ev:+.1f}": ldr_folder(out, ev) for ev in evs}
    results["depth"] = out / "depth"
    path = out / "views.json"
    key = fingerprint(run, shot.views, evs)
    done = notes.read(path, notes.PictureRanges)
    if done is None or done.key != key:
        sources = [out / "training" / f"{i:05d}.exr" for i in range(len(shot.views))]
        ranges = find_ranges(sources)
        for i, source in enumerate(track(sources, "LDR, depth and motion pictures")):
            seen = read_exr(source)
            balanced = output.white_balance, output.camera_id
            seen["RGB"] = unbalance(run, seen["RGB"], *balanced)
            write_pictures_of_view(run, out, i, shot.views[i], seen, evs, ranges)
        write_overview(run, out, shot, evs, ranges.moves)
        done = notes.PictureRanges(
            key=key,
            depth_range=(ranges.near, ranges.far),
            fastest=ranges.fastest,
            moves=ranges.moves,
            exposures=evs,
        )
        notes.write(path, done)
    if done.moves:
        results["scene flow"] = out / "scene_flow"
    else:
        say("scene flow: this field has none, so there are no pictures of it")
    results["overview"] = out / "overview.png"
    return results


def three_exposures(ev: Sequence[float]) -> list[float]:
    """Darkest, middle and brightest exposure of the clip in EV.

    Two stops apart where it has one; the mean is the middle where it has two.
    """
    values = sorted(ev)
    if values[-1] - values[0] < MIN_EV_RANGE:
        return [values[0] - EV_STEP, values[0], values[0] + EV_STEP]
    middle = (values[0] + values[-1]) / 2
    if len(values) > 2:
        middle = values[len(values) // 2]
    return [values[0], middle, values[-1]]


def ldr_folder(out: Path, ev: float) -> Path:
    """The folder of the pictures developed at `ev`."""
    return out / "ldr" / f"ev{ev:+.1f}"


def find_ranges(sources: Sequence[Path]) -> SequenceRanges:
    """Percentiles of depth and of the motion's length over an EXR sequence."""
    depths, lengths = [], []
    moves = True
    for source in sources:
        seen = read_exr(source)
        depths.append(seen["Z"][::DEPTH_STRIDE, ::DEPTH_STRIDE].ravel())
        moves = moves and "content.forward.u" in seen
        if moves:
            length = np.hypot(seen["content.forward.u"], seen["content.forward.v"])
            lengths.append(length[::MOTION_STRIDE, ::MOTION_STRIDE].ravel())
    near, far = np.percentile(np.concatenate(depths), DEPTH_PERCENTILES).tolist()
    fastest = 0.0
    if moves:
        fastest = float(np.percentile(np.concatenate(lengths), MOTION_PERCENTILE))
    return SequenceRanges(
        max(near, MIN_DEPTH), max(far, MIN_DEPTH), max(fastest, MIN_MOTION_PX), moves
    )


def write_pictures_of_view(
    run: Run,
    out: Path,
    index: int,
    view: PathView,
    seen: dict[str, np.ndarray],
    evs: Sequence[float],
    ranges: SequenceRanges,
) -> None:
    """The pictures of one view, from the EXR channels `seen`."""
    name = f"{index:05d}.png"
    for ev in evs:
        picture = develop_view(run, view, seen["RGB"], ev, 0, 1.0)
        write_png(ldr_folder(out, ev) / name, picture)
    disparity = 1 / seen["Z"].clip(MIN_DEPTH)
    write_png(out / "depth" / name, colorize(disparity, 1 / ranges.far, 1 / ranges.near))
    if ranges.moves:
        flow = np.stack([seen["content.forward.u"], seen["content.forward.v"]], -1)
        write_png(out / "scene_flow" / name, colorize_flow(flow, ranges.fastest))


def write_overview(run: Run, out: Path, shot: Shot, evs: Sequence[float], moves: bool) -> None:
    """`overview.png`: rows of the recorded frame and of all pictures of its view.

    Tone-mapped HDR, three exposures, depth and motion.
    """
    folders = [out / "training", *(ldr_folder(out, ev) for ev in evs), out / "depth"]
    if moves:
        folders.append(out / "scene_flow")
    positions = np.linspace(0, len(shot.views) - 1, OVERVIEW_ROWS).tolist()
    rows = []
    for i in sorted({round(position) for position in positions}):
        frame = filmed_frame(run, shot.views[i])
        assert frame is not None, "a view of the training path"
        recorded = frame.image.cpu().numpy()
        rows.append([recorded, *(read_image(folder / f"{i:05d}.png") for folder in folders)])
    write_png(out / "overview.png", contact_sheet(rows))
