"""The views of a truth folder as pictures for the writers of layouts: where they stand
in the scene, and what the true camera records of them at the exposure at which they are
compared. `export --truth` alone imports this; nothing that learns does.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.progress import say
from hdr_nsff.footage.layouts.writer import HeldOutPicture, Source, copy
from hdr_nsff.geometry import alignment
from hdr_nsff.scene.manifest import FrameEntry, inside
from hdr_nsff.scene.truth import Truth, TruthView, scene_brackets, true_pictures


def views_of(source: Source, folder: Path) -> list[HeldOutPicture]:
    """The views of the truth `folder` in the world of the scene.

    They are carried over as `evaluate` does it. InputError where the truth is not of
    this scene; prints which views have no place in it.
    """
    truth = Truth.open(folder)
    frames = source.manifest.frames
    true = truth.clip_c2w
    if true is not None and len(true) != len(frames):
        raise InputError(
            f"{folder}: the truth is of a clip of {len(true)} frames, the scene has "
            f"{len(frames)}; prepare the whole clip"
        )
    scale = None
    if true is not None:
        estimated = np.array([f.c2w for f in frames], np.float64)
        scale = alignment.scale_between(np.array(true), estimated)
    lost = [v.name for v in truth.views if v.c2w is not None and scale is None]
    if lost:
        say(
            f"{folder}: {len(lost)} views, {lost[0]} first, are off the clip's path, and "
            "the cameras of the scene fix no scale: left out"
        )
    brackets = scene_brackets(truth, frames, bracket_exposures(source))
    return [
        carry_view(source, folder, truth, view, brackets, scale or 1.0)
        for view in truth.views
        if view.name not in lost
    ]


def carry_view(
    source: Source,
    folder: Path,
    truth: Truth,
    view: TruthView,
    brackets: dict[int, int],
    scale: float,
) -> HeldOutPicture:
    """One view in the world of the scene.

    `scale` is scene units per unit of the truth, `brackets` the bracket of the scene
    for each of the truth.
    """
    m = source.manifest
    anchor = next((f for f in m.frames if f.index == view.anchor), None)
    if anchor is None or view.bracket not in brackets:
        what = f"anchored at frame {view.anchor}" if anchor is None else "of an exposure"
        raise InputError(
            f"{folder}: view {view.name} is {what} that the scene does not have; "
            "prepare the whole clip"
        )
    c2w = np.array(anchor.c2w)
    if view.c2w is not None:
        if truth.clip_c2w is None:
            raise InputError(
                f"{folder}: view {view.name} has a pose of its own, but clip_c2w is missing; "
                "make the truth again"
            )
        true_anchor = np.array(truth.clip_c2w[view.anchor])
        c2w = alignment.transfer_pose(c2w, true_anchor, np.array(view.c2w), scale)
    return HeldOutPicture(
        name=view.name,
        time=view.time,
        camera_id=anchor.camera_id,
        bracket=brackets[view.bracket],
        K=np.array(view.K or anchor.K),
        c2w=c2w,
        mask=None if view.mask is None else inside(folder, view.mask),
        write=partial(write_picture, folder, truth, view, (m.height, m.width)),
    )


def write_picture(
    folder: Path, truth: Truth, view: TruthView, size: tuple[int, int], path: Path
) -> None:
    """Write what was recorded of a view at its bracket, as stored.

    Where nothing was: what the true camera records, in 8 bits. InputError for pictures
    of another size than the scene's, (H, W).
    """
    rgb = true_pictures(truth, view, folder)[1][view.bracket]
    height, width = size
    if rgb.shape[:2] != size:
        raise InputError(
            f"{folder}: view {view.name} has {rgb.shape[1]}x{rgb.shape[0]} pixels, the "
            f"scene's frames {width}x{height}; prepare the scene at the truth's size with "
            "--max-size"
        )
    if view.bracket in view.recorded:
        copy(inside(folder, view.recorded[view.bracket]), path)
    else:
        write_png(path, rgb)


def bracket_exposures(source: Source) -> list[float]:
    """The exposure of every bracket in stops.

    Where the scene does not know them all: their order by brightness, which is all that
    is needed where truth and scene have equally many.
    """
    m = source.manifest
    known = [ev for ev in m.bracket_ev if ev is not None]
    if known and len(known) == len(m.bracket_ev):
        return known
    count = 1 + max(f.bracket for f in m.frames)
    means = [mean_brightness(source, [f for f in m.frames if f.bracket == b]) for b in range(count)]
    rank = np.argsort(np.argsort(means))
    return rank.astype(float).tolist()


def mean_brightness(source: Source, frames: list[FrameEntry]) -> float:
    """The mean of all recorded values of some frames."""
    return float(np.mean([read_image(source.file(f.image)).mean() for f in frames]))
