"""The views that a run is held against: those of a truth folder, carried over to the
estimated poses, or recorded frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core import io
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.geometry import alignment
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.paths import View
from hdr_nsff.scene.manifest import FrameEntry, Protocol, inside
from hdr_nsff.scene.truth import Truth, TruthView, scene_brackets, true_pictures
from hdr_nsff.tonemap.base import informative
from hdr_nsff.training.run_folder import Run

SEEN = "training view"  # the group of views that were trained on


@dataclass(frozen=True)
class GeometryFile:
    """Where a view's true depth and motion are."""

    path: Path
    size: tuple[int, int]  # (H, W)
    turn: (
        np.ndarray
    )  # (3, 3): axes of the truth to those of the scene, as the view's two poses have it


@dataclass(frozen=True)
class Target:
    """One view to be met."""

    name: str
    group: str
    view: View
    bracket: int
    camera_id: int
    rgb: dict[int, Tensor]  # {bracket: (H, W, 3)} what the camera would record (or did) in [0, 1]
    radiance: (
        Tensor | None
    )  # (H, W, 3) exact, where known, in the camera's white balance: the unit of a run's radiance
    moving: Tensor | None  # (H, W) bool
    geometry: GeometryFile | None = None  # where known
    # {EV: (H, W, 3)} recorded, at exposures of no frame of the clip
    novel: dict[float, Tensor] = field(default_factory=dict)

    def protocol(self, times: Sequence[float]) -> Protocol | None:
        """Which of the published comparisons the view belongs to, of a run trained at
        `times`; None where it was trained on.
        """
        if self.group == SEEN:
            return None
        return (
            "novel-view"
            if min(abs(self.view.time - t) for t in times) < 1e-6
            else "novel-view-time"
        )


def moving_of(target: Target) -> Tensor | None:
    """The moving mask, None where it is unknown or empty."""
    return target.moving if target.moving is not None and target.moving.any() else None


def exact_of(target: Target) -> Tensor:
    """The exact radiance of a target that has one."""
    assert target.radiance is not None, target.name
    return target.radiance


def recordable(target: Target) -> Tensor:
    """True (H, W) where at least one exposure of the clip, of those at which the view
    is known, records all channels unclipped.
    """
    return (
        torch.stack([informative(rgb.reshape(-1, 3)) for rgb in target.rgb.values()])
        .any(0)
        .view(target.rgb[target.bracket].shape[:2])
    )


def choose_targets(
    run: Run, truth: Truth | None, folder: Path | None
) -> tuple[str, list[Target], list[str]]:
    """What the targets are, in words; the targets; sentences about what had to be left
    out.
    """
    if truth is not None and folder is not None:
        targets, notes = truth_targets(run, truth, folder)
        held_out = any(t.group != SEEN for t in targets)
        exact = any(t.radiance is not None for t in targets)
        what = f"{'held-out' if held_out else 'training'} views {'with exact radiance' if exact else 'as recorded'}"
        return what, targets, notes
    if run.scene.test:
        return "held-out frames", frame_targets(run, test=True), []
    note = "nothing was held out (`prepare --hold-out 8` does that): these numbers are of frames the field was trained on"
    say(note)
    return "training views (not held out)", frame_targets(run, test=False), [note]


def frame_targets(run: Run, test: bool) -> list[Target]:
    """Recorded frames: those held out, or up to 12 training frames."""
    frames = run.scene.test if test else run.scene.train[:: max(1, -(-len(run.scene.train) // 12))]
    group = "held-out frame" if test else SEEN
    return [
        Target(
            f"{f.index:05d}",
            group,
            View(f.camera, f.time),
            f.bracket,
            f.camera_id,
            {f.bracket: f.image.cpu()},
            None,
            f.moving,
        )
        for f in frames
    ]


def truth_targets(run: Run, truth: Truth, folder: Path) -> tuple[list[Target], list[str]]:
    """The views of a truth folder, carried over to the estimated poses."""
    entries = run.scene.manifest.frames
    if truth.clip_c2w is not None and len(truth.clip_c2w) != len(entries):
        raise InputError(
            f"{folder}: the truth is of a clip of {len(truth.clip_c2w)} frames, the scene has {len(entries)}; prepare the whole clip"
        )
    scale = world_scale(run, truth)
    times = run.scene.times.tolist()
    targets, notes = [], []
    for view in truth.views:
        if view.c2w is not None and scale is None:
            notes.append(
                f"{view.name}: left out, its pose is off the clip's path and the estimated cameras fix no scale"
            )
        elif not times[0] <= view.time <= times[-1]:
            notes.append(
                f"{view.name}: left out, its time {view.time:g} is outside the training frames"
            )
        else:
            targets.append(truth_target(run, truth, view, folder, scale or 1.0))
    if seen := [t.name for t in targets if t.group == SEEN]:
        notes.append(
            f"{len(seen)} views, {seen[0]} first, are frames that the run was trained on; they are no held-out views"
        )
    for note in notes:
        say(note)
    if not targets:
        raise InputError(
            f"{folder}: no view of this truth can be compared with the run ({notes[0] if notes else 'it lists none'}); "
            "check that it is the truth of this clip"
        )
    exact = [t.radiance for t in targets if t.radiance is not None]
    if exact and not any(e.any() for e in exact):
        raise InputError(f"{folder}: the radiance of every view is 0; make the truth anew")
    return targets, notes


def truth_target(run: Run, truth: Truth, view: TruthView, folder: Path, scale: float) -> Target:
    """One view of a truth folder; InputError where its files do not fit together."""
    exact, true = true_pictures(truth, view, folder)
    pictures = {b: torch.from_numpy(rgb) for b, rgb in true.items()}
    anchor = next((e for e in run.scene.manifest.frames if e.index == view.anchor), None)
    if anchor is None or anchor.c2w is None or anchor.K is None:
        raise InputError(
            f"{folder}: view {view.name} is anchored at frame {view.anchor}, which the scene does not have; prepare the whole clip"
        )
    pose = np.array(anchor.c2w)
    if view.c2w is not None:
        assert truth.clip_c2w is not None, "world_scale refuses this"
        pose = alignment.carry(
            pose, np.array(truth.clip_c2w[view.anchor]), np.array(view.c2w), scale
        )
    height, width = pictures[view.bracket].shape[:2]
    match = scene_brackets(truth, run.scene.manifest.frames, run.tonemapper.exposures().tolist())
    if view.bracket not in match:
        raise InputError(
            f"{folder}: view {view.name} is of an exposure that the scene does not have; prepare it again"
        )
    return Target(
        view.name, group_of(run, view), View(camera_of(run, view, anchor, pose, (height, width)), view.time),
        match[view.bracket], anchor.camera_id,
        {match[b]: rgb for b, rgb in pictures.items() if b in match},
        None if exact is None else torch.from_numpy(exact * np.array(truth.white_balance, np.float32)),
        moving_mask(run, view, folder, (height, width)),
        geometry_file(truth, view, folder, (height, width), pose),
        {ev: rgb for b, rgb in pictures.items() if b not in match and (ev := truth.bracket_ev[b]) is not None},
    )  # fmt: skip


def camera_of(
    run: Run, view: TruthView, anchor: FrameEntry, pose: np.ndarray, size: tuple[int, int]
) -> Camera:
    """The camera of a truth view at `pose` (3, 4) for pictures of `size` (H, W): with a
    K of its own, else with that of its anchor.
    """
    m, (height, width) = run.scene.manifest, size
    c2w = torch.from_numpy(pose).float()
    if view.K is not None:
        return Camera(torch.tensor(view.K), c2w, width, height)
    return Camera(torch.tensor(anchor.K), c2w, m.width, m.height).resized(width, height)


def group_of(run: Run, view: TruthView) -> str:
    """What kind of view it is to this run."""
    if view.c2w is not None:
        return "off-path"
    if any(f.index == view.anchor and abs(f.time - view.time) < 1e-6 for f in run.scene.train):
        return SEEN
    return (
        "view" if min(abs(view.time - t) for t in run.scene.times.tolist()) < 1e-6 else "view+time"
    )


def geometry_file(
    truth: Truth, view: TruthView, folder: Path, size: tuple[int, int], pose: np.ndarray
) -> GeometryFile | None:
    """Where depth and motion of a truth view are, whose `pose` (3, 4) in the scene is
    known.
    """
    if view.geometry is None:
        return None
    assert truth.clip_c2w is not None, "Truth.problem refuses this"
    true = np.array(view.c2w or truth.clip_c2w[view.anchor])
    return GeometryFile(inside(folder, view.geometry), size, pose[:, :3] @ true[:, :3].T)


def moving_mask(run: Run, view: TruthView, folder: Path, size: tuple[int, int]) -> Tensor | None:
    """The moving mask (H, W) of a truth view; without one, that of the scene where the
    view is a frame of the clip.
    """
    if view.mask is not None:
        mask = io.read_mask(inside(folder, view.mask))
        if mask.shape != size:
            raise InputError(
                f"{folder / view.mask}: a mask of {mask.shape}, but the pictures of {view.name} are {size}"
            )
        return torch.from_numpy(mask)
    frames = [
        f
        for f in run.scene.train + run.scene.test
        if f.index == view.anchor and f.time == view.time and view.c2w is None
    ]
    own = frames[0].moving if frames else None
    return own if own is not None and own.shape == size else None


def trajectories(run: Run, truth: Truth) -> tuple[np.ndarray, np.ndarray] | None:
    """True and estimated poses (T, 3, 4) of the clip's frames; None where the truth has
    none.
    """
    if truth.clip_c2w is None:
        return None
    return np.array(truth.clip_c2w), np.array(
        [e.c2w for e in run.scene.manifest.frames], dtype=np.float64
    )


def world_scale(run: Run, truth: Truth) -> float | None:
    """Estimated scene units per true unit; None where the cameras do not spread."""
    paths = trajectories(run, truth)
    if paths is None:
        if any(v.c2w is not None for v in truth.views):
            raise InputError(
                "truth.json: views have poses of their own, but clip_c2w is missing; they cannot be carried over"
            )
        return None
    return alignment.scale_between(*paths)
