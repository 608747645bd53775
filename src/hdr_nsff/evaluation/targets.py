"""The views that a run is compared with.

They are those of a truth folder, carried over to the estimated poses, or
recorded frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask
from hdr_nsff.core.progress import say
from hdr_nsff.footage.hold_out import widest_hold_out
from hdr_nsff.geometry import alignment
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.lens import undistorted_picture
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.scene.manifest import FrameEntry, Manifest, Protocol, inside
from hdr_nsff.scene.scene import Frame
from hdr_nsff.scene.truth import Truth, TruthView, as_exposed, scene_brackets, true_pictures
from hdr_nsff.tonemap.base import informative
from hdr_nsff.training.run_folder import Run

TRAINED_ON = "training view"  # the group of views that were trained on
MAX_TRAINING_VIEWS = 12  # compared where nothing was held out (hand-chosen: for speed)
TIME_TOLERANCE = 1e-6  # frames: closer times are the same


@dataclass(frozen=True)
class GeometryFile:
    """The file of a view's true depth and motion."""

    path: Path
    size: tuple[int, int]  # (H, W)
    rotation: np.ndarray  # (3, 3) from axes of the truth to axes of the scene, at this view


@dataclass(frozen=True)
class Target:
    """One view that a run is compared with."""

    name: str
    group: str
    view: PathView
    bracket: int
    camera_id: int
    rgb: dict[int, Tensor]  # {bracket: (H, W, 3)} recordings of the true camera in [0, 1]
    # (H, W, 3) exact, where known, in the camera's white balance: the unit of a run's
    # radiance
    radiance: Tensor | None
    moving: Tensor | None  # (H, W) bool
    geometry: GeometryFile | None = None  # where known
    # {EV: (H, W, 3)} recorded, at exposures of no frame of the clip
    novel: dict[float, Tensor] = field(default_factory=dict)
    drift: float = 0.0  # stops by which its exposure differs from its bracket's
    # stops by which its white balance differs from the clip's
    white_balance: tuple[float, ...] = (0.0, 0.0, 0.0)

    def protocol(self, times: Sequence[float]) -> Protocol | None:
        """The published comparison that the view belongs to; None if it was trained on.

        `times`: of the training frames.
        """
        if self.group == TRAINED_ON:
            return None
        return "novel-view" if is_among(self.view.time, times) else "novel-view-time"


def is_among(time: float, times: Sequence[float]) -> bool:
    """Whether `time` is one of `times`, in frames."""
    return min(abs(time - t) for t in times) < TIME_TOLERANCE


def moving_of(target: Target) -> Tensor | None:
    """The moving mask (H, W), None where it is unknown or empty."""
    if target.moving is None or not target.moving.any():
        return None
    return target.moving


def exact_of(target: Target) -> Tensor:
    """The exact radiance of a target that has one."""
    assert target.radiance is not None, target.name
    return target.radiance


def recordable(target: Target) -> Tensor:
    """True (H, W) where some exposure of the clip records all channels unclipped.

    Of the exposures at which the view is known.
    """
    unclipped = [informative(rgb.reshape(-1, 3)) for rgb in target.rgb.values()]
    return torch.stack(unclipped).any(0).view(target.rgb[target.bracket].shape[:2])


def choose_targets(
    run: Run, truth: Truth | None, folder: Path | None
) -> tuple[str, list[Target], list[str]]:
    """The kind of the targets in words; the targets; sentences about other views.

    The last are views of the truth that had to be left out.
    """
    if truth is not None and folder is not None:
        targets, notes = truth_targets(run, truth, folder)
        held_out = any(t.group != TRAINED_ON for t in targets)
        exact = any(t.radiance is not None for t in targets)
        views = "held-out views" if held_out else "training views"
        kind = f"{views} with exact radiance" if exact else f"{views} as recorded"
        return kind, targets, notes
    if run.scene.test:
        return "held-out frames", frame_targets(run.scene.test, "held-out frame"), []
    manifest = run.scene.manifest
    every = widest_hold_out(len({frame.time for frame in manifest.frames}), manifest.cycle)
    advice = f" (`prepare --hold-out {every}` does that)" if every else ""
    note = f"nothing was held out{advice}: these numbers are of frames the field was trained on"
    say(note)
    stride = max(1, -(-len(run.scene.train) // MAX_TRAINING_VIEWS))
    while math.gcd(stride, manifest.cycle) > 1:  # all exposures, in turn
        stride += 1
    frames = run.scene.train[::stride]
    return "training views (not held out)", frame_targets(frames, TRAINED_ON), [note]


def frame_targets(frames: Sequence[Frame], group: str) -> list[Target]:
    """Recorded frames of the clip."""
    return [
        Target(
            name=f"{frame.index:05d}",
            group=group,
            view=PathView(frame.camera, frame.time),
            bracket=frame.bracket,
            camera_id=frame.camera_id,
            rgb={frame.bracket: frame.image.cpu()},
            radiance=None,
            moving=frame.moving,
            drift=frame.drift,
            white_balance=frame.white_balance,
        )
        for frame in frames
    ]


def truth_targets(run: Run, truth: Truth, folder: Path) -> tuple[list[Target], list[str]]:
    """The views of a truth folder, carried over to the estimated poses.

    And sentences about views that were left out.
    """
    check_frames(run.scene.manifest, truth, folder)
    learned_ev = run.tonemapper.exposures().tolist()
    truth = as_exposed(truth, run.scene.manifest.frames, learned_ev)
    scale = world_scale(run, truth)
    times = run.scene.times.tolist()
    targets, notes = [], []
    for view in truth.views:
        if view.c2w is not None and scale is None:
            reason = "its pose is off the clip's path and the estimated cameras fix no scale"
            notes.append(f"{view.name}: left out, {reason}")
        elif not times[0] <= view.time <= times[-1]:
            reason = f"its time {view.time:g} is outside the training frames"
            notes.append(f"{view.name}: left out, {reason}")
        else:
            targets.append(truth_target(run, truth, view, folder, scale or 1.0))
    trained_on = [t.name for t in targets if t.group == TRAINED_ON]
    if trained_on:
        count = f"{len(trained_on)} views, {trained_on[0]} first,"
        problem = "are frames that the run was trained on; they are not held-out views"
        notes.append(f"{count} {problem}")
    for note in notes:
        say(note)
    if not targets:
        reason = notes[0] if notes else "it lists none"
        problem = f"no view of this truth can be compared with the run ({reason})"
        raise InputError(f"{folder}: {problem}; check that it is the truth of this clip")
    exact = [t.radiance for t in targets if t.radiance is not None]
    if exact and not any(radiance.any() for radiance in exact):
        raise InputError(f"{folder}: the radiance of every view is 0; make the truth again")
    return targets, notes


def check_frames(manifest: Manifest, truth: Truth, folder: Path) -> None:
    """InputError where the frames of a scene are not those that the truth counts."""
    num_frames = len(manifest.frames)
    for of_clip in (truth.clip_c2w, truth.clip_drift):
        if of_clip is not None and len(of_clip) != num_frames:
            problem = f"the truth is of a clip of {len(of_clip)} frames"
            advice = "prepare the whole clip"
            raise InputError(f"{folder}: {problem}, the scene has {num_frames}; {advice}")
    if truth.bracket_frame is not None or manifest.num_cameras * manifest.num_tracks > 1:
        return  # `prepare` wrote the truth for this scene, or the numbers are of a camera
    places = {name: place for place, name in enumerate(manifest.inputs)}
    for frame in manifest.frames:
        number = number_in_clip(frame, places)
        if number is not None and number != frame.index:
            problem = f"counts all frames of the clip, but frame {frame.index} of the scene is"
            advice = "prepare it without --start, --stride and --segment"
            raise InputError(f"{folder}: {problem} frame {number} there; {advice}")


def number_in_clip(frame: FrameEntry, places: dict[str, int]) -> int | None:
    """The number of a frame in the footage of one camera, whose files have these
    `places`; None where it is unknown.
    """
    _, mark, number = frame.source.rpartition("#")
    if mark and number.isdecimal():
        return int(number)
    return places.get(frame.source)


def truth_target(run: Run, truth: Truth, view: TruthView, folder: Path, scale: float) -> Target:
    """One view of a truth folder; InputError where its files do not fit together."""
    exact, true = true_pictures(truth, view, folder)
    anchor = anchor_of(run, view, folder)
    lens = run.scene.manifest.lens.get(anchor.camera_id)
    distorted = lens is not None and truth.lens is None  # as the scene's frames were
    if lens is not None and distorted:
        true = {b: undistorted_picture(rgb, lens.lens()) for b, rgb in true.items()}
        exact = None if exact is None else undistorted_picture(exact, lens.lens())
    pictures = {bracket: torch.from_numpy(rgb) for bracket, rgb in true.items()}
    radiance = None
    if exact is not None:
        white_balance = np.array(truth.white_balance, np.float32)
        radiance = torch.from_numpy(exact * white_balance)
    pose = np.array(anchor.c2w)
    if view.c2w is not None:
        assert truth.clip_c2w is not None, "world_scale refuses this"
        anchor_pose = np.array(truth.clip_c2w[view.anchor])
        pose = alignment.transfer_pose(pose, anchor_pose, np.array(view.c2w), scale)
    height, width = pictures[view.bracket].shape[:2]
    size = (height, width)
    match = scene_brackets(truth, run.scene.manifest.frames, run.tonemapper.exposures().tolist())
    if view.bracket not in match:
        problem = f"view {view.name} is of an exposure that the scene does not have"
        raise InputError(f"{folder}: {problem}; prepare it again")
    known: dict[int, Tensor] = {}
    novel: dict[float, Tensor] = {}
    for bracket in sorted(pictures, key=lambda each: each != view.bracket):  # its own first
        rgb, ev = pictures[bracket], truth.bracket_ev[bracket]
        if bracket in match:
            known.setdefault(match[bracket], rgb)
        elif ev is not None:
            novel[ev] = rgb
    moving = moving_mask(run, view, folder, size)
    if lens is not None and distorted and moving is not None and view.mask is not None:
        moving = torch.from_numpy(undistorted_picture(moving.numpy(), lens.lens()))
    geometry = None if distorted else geometry_file(truth, view, folder, size, pose)
    return Target(
        name=view.name,
        group=group_of(run, view),
        view=PathView(camera_of(run, truth, view, anchor, pose, size), view.time),
        bracket=match[view.bracket],
        camera_id=anchor.camera_id,
        rgb=known,
        radiance=radiance,
        moving=moving,
        geometry=geometry,
        novel=novel,
    )


def anchor_of(run: Run, view: TruthView, folder: Path) -> FrameEntry:
    """The frame of the scene that a truth view is anchored at.

    InputError where the scene has no camera of it.
    """
    for entry in run.scene.manifest.frames:
        if entry.index == view.anchor and entry.c2w is not None and entry.K is not None:
            return entry
    problem = f"view {view.name} is anchored at frame {view.anchor}"
    reason = "which the scene does not have"
    raise InputError(f"{folder}: {problem}, {reason}; prepare the whole clip")


def camera_of(
    run: Run,
    truth: Truth,
    view: TruthView,
    anchor: FrameEntry,
    pose: np.ndarray,
    size: tuple[int, int],
) -> Camera:
    """The camera of a truth view at `pose` (3, 4) for pictures of `size` (H, W).

    With a K of its own, else with that of its anchor: of the anchor's lens where frames
    were undistorted and the truth has no distortion.
    """
    manifest = run.scene.manifest
    height, width = size
    c2w = torch.from_numpy(pose).float()
    if view.K is not None:
        return Camera(torch.tensor(view.K), c2w, width, height)
    K = np.array(anchor.K)
    lens = manifest.lens.get(anchor.camera_id)
    if lens is not None and truth.lens is not None:
        K = lens.lens().unzoomed(K)
    camera = Camera(torch.from_numpy(K).float(), c2w, manifest.width, manifest.height)
    return camera.resized(width, height)


def group_of(run: Run, view: TruthView) -> str:
    """The kind of a view for this run."""
    if view.c2w is not None:
        return "off-path"
    for frame in run.scene.train:
        if frame.index == view.anchor and is_among(view.time, [frame.time]):
            return TRAINED_ON
    return "view" if is_among(view.time, run.scene.times.tolist()) else "view+time"


def geometry_file(
    truth: Truth, view: TruthView, folder: Path, size: tuple[int, int], pose: np.ndarray
) -> GeometryFile | None:
    """The file of a truth view's depth and motion; `pose` (3, 4): that in the scene."""
    if view.geometry is None:
        return None
    assert truth.clip_c2w is not None, "Truth.problem refuses this"
    true_pose = np.array(view.c2w or truth.clip_c2w[view.anchor])
    rotation = pose[:, :3] @ true_pose[:, :3].T
    return GeometryFile(inside(folder, view.geometry), size, rotation)


def moving_mask(run: Run, view: TruthView, folder: Path, size: tuple[int, int]) -> Tensor | None:
    """The moving mask (H, W) of a truth view, None where it is unknown.

    Without one of its own, that of the scene where the view is a frame of the clip.
    """
    if view.mask is not None:
        mask = read_mask(inside(folder, view.mask))
        if mask.shape != size:
            problem = f"but the pictures of {view.name} are {size}"
            raise InputError(f"{folder / view.mask}: a mask of {mask.shape}, {problem}")
        return torch.from_numpy(mask)
    if view.c2w is not None:
        return None
    for frame in run.scene.train + run.scene.test:
        if frame.index == view.anchor and frame.time == view.time:
            own = frame.moving
            return own if own is not None and own.shape == size else None
    return None


def trajectories(run: Run, truth: Truth) -> tuple[np.ndarray, np.ndarray] | None:
    """True and estimated poses (T, 3, 4) of the clip's frames.

    None where the truth has none.
    """
    if truth.clip_c2w is None:
        return None
    estimated = [entry.c2w for entry in run.scene.manifest.frames]
    return np.array(truth.clip_c2w), np.array(estimated, dtype=np.float64)


def world_scale(run: Run, truth: Truth) -> float | None:
    """Estimated scene units per true unit; None where the cameras do not spread."""
    paths = trajectories(run, truth)
    if paths is None:
        if any(v.c2w is not None for v in truth.views):
            problem = "views have poses of their own, but clip_c2w is missing"
            raise InputError(f"truth.json: {problem}; they cannot be carried over")
        return None
    return alignment.scale_between(*paths)
