"""Pictures and videos of a report.

They are those of the standard set of `render` and the comparisons of `evaluate`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from hdr_nsff.core import notes
from hdr_nsff.core.images import read_image
from hdr_nsff.core.page import Figure, figure, video
from hdr_nsff.scene.scene import Frame
from hdr_nsff.training.run_folder import Run

MAX_EMBEDDED_BYTES = 8_000_000  # larger videos are linked, not embedded (hand-chosen)
VIDEOS = {
    "training": "As filmed, in HDR",
    "fixed": "Fixed camera",
    "bullet": "Bullet time: time stands still",
    "slowmo": "Slow motion",
}
NUM_ROWS = 3  # of frames side by side
COMPARISON_WIDTH = 1400  # pixels: three pictures beside each other


@dataclass(frozen=True)
class Link:
    """A video beside the report."""

    address: str  # relative to the report
    caption: str
    megabytes: float


@dataclass(frozen=True)
class Videos:
    """The videos of a run."""

    embedded: list[Figure]
    linked: list[Link]
    absent: list[str]  # captions of those that were not made
    reason: str  # why


@dataclass(frozen=True)
class SideBySide:
    """Rows of the same view in every kind of picture."""

    rows: list[list[Figure]]
    moves: bool  # whether the field has scene flow


@dataclass(frozen=True)
class ViewGroup:
    """Comparisons of one group of held-out views."""

    title: str
    figures: list[Figure]
    missing: list[str]  # files that are not there


@dataclass(frozen=True)
class HeldOutViews:
    """Comparisons of all groups."""

    groups: list[ViewGroup]
    with_radiance: bool  # whether a second row compares radiance


def find_videos(renders: Path, beside: Path) -> Videos:
    """The videos in the folder `renders`: embedded if short, else linked.

    Links are relative to the folder `beside`. Those that are missing are named.
    """
    embedded, linked, absent = [], [], []
    for name, caption in VIDEOS.items():
        path = renders / f"{name}.mp4"
        if not path.is_file():
            absent.append(caption.split(":")[0].lower())
        elif path.stat().st_size <= MAX_EMBEDDED_BYTES:
            embedded.append(video(path, caption))
        else:
            address = quote(Path(os.path.relpath(path, beside)).as_posix())
            linked.append(Link(address, caption, path.stat().st_size / 1e6))
    return Videos(embedded, linked, absent, why_absent(renders))


def why_absent(renders: Path) -> str:
    """The reason for missing videos, as far as the plan of `render` names it."""
    plan = notes.read(renders / "plan.json", notes.RenderPlan)
    if plan is not None and plan.refused:
        return " ".join(plan.refused)
    return "`hdr-nsff render RUN` makes the standard set."


def side_by_side(run: Run, renders: Path) -> SideBySide | None:
    """Rows of recorded frame, tone-mapped HDR, depth, scene flow and three exposures.

    None where `render` has not made them, or not of the views of `training`/.
    """
    ranges = notes.read(renders / "views.json", notes.PictureRanges)
    sequence = notes.read(renders / "training" / "sequence.json", notes.Sequence)
    if ranges is None or sequence is None:
        return None
    columns = picture_captions(ranges)
    if not all(holds_pictures(renders / folder, len(sequence.views)) for folder in columns):
        return None
    rows = []
    for i in spread(len(sequence.views), NUM_ROWS):
        frame = recorded_frame(run, sequence.views[i])
        ev = run.tonemapper.exposures()[frame.bracket].item()
        recorded = frame.image.cpu().numpy()
        row = [figure(recorded, f"recorded, frame {frame.index}, EV {ev:+.1f}")]
        for folder, caption in columns.items():
            row.append(figure(read_image(renders / folder / f"{i:05d}.png"), caption))
        rows.append(row)
    return SideBySide(rows, ranges.moves)


def holds_pictures(folder: Path, count: int) -> bool:
    """Whether a folder holds the numbered pictures of `count` views, and of no more."""
    there = [(folder / f"{i:05d}.png").is_file() for i in range(count + 1)]
    return all(there[:count]) and not there[count]


def picture_captions(ranges: notes.PictureRanges) -> dict[str, str]:
    """The folders of the standard set's pictures with their captions."""
    near, far = ranges.depth_range
    captions = {
        "training": "HDR, tone-mapped",
        "depth": f"depth, {near:.2g} (red) to {far:.2g} (blue)",
    }
    if ranges.moves:
        captions["scene_flow"] = f"motion until the next frame, up to {ranges.fastest:.2g} px"
    for ev in ranges.exposures:
        captions[f"ldr/ev{ev:+.1f}"] = f"developed at EV {ev:+.1f}"
    return captions


def spread(count: int, number: int) -> list[int]:
    """At most `number` positions of `count`, evenly from the first to the last."""
    positions = np.linspace(0, count - 1, min(number, count)).tolist()
    return sorted({round(position) for position in positions})


def recorded_frame(run: Run, view: notes.SequenceView) -> Frame:
    """The frame filmed at a view, else the training frame nearest in time."""
    for frame in run.scene.test:
        if frame.index == view.frame:
            return frame
    return min(run.scene.train, key=lambda f: (f.index != view.frame, abs(f.time - view.time)))


def held_out_views(folder: Path, metrics: dict[str, Any] | None) -> HeldOutViews | None:
    """Comparisons of the best, the middle and the worst view of every group.

    From the pictures of `evaluate` in `folder`; None before it has run.
    """
    if metrics is None:
        return None
    groups = []
    for group in metrics["groups"]:
        views = [view for view in metrics["views"] if view["group"] == group]
        groups.append(compare_group(folder, group, views))
    return HeldOutViews(groups, with_radiance=bool(metrics.get("hdr_scores")))


def compare_group(folder: Path, group: str, views: Sequence[dict[str, Any]]) -> ViewGroup:
    """The comparisons of one group."""
    ranked = sorted(views, key=lambda view: view["psnr"])
    chosen = {ranked[i]["name"]: ranked[i] for i in (len(ranked) - 1, len(ranked) // 2, 0)}
    size = f"{len(views)} views"
    if len(views) > len(chosen):
        size = f"best, middle and worst of {len(views)}"
    figures, missing = [], []
    for name, view in chosen.items():
        path = folder / f"{name}.png"
        if path.is_file():
            caption = f"{name}, time {view['time']:g}: {view['psnr']:.2f} dB"
            figures.append(figure(read_image(path), caption, COMPARISON_WIDTH))
        else:
            missing.append(path.name)
    return ViewGroup(f"{group}: {size}", figures, missing)
