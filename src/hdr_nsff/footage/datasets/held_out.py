"""What a public data set holds out for testing -> a truth folder outside the scene,
which `evaluate` alone reads.

The only file of the package that opens held-out pictures, masks and radiance; `prepare`
calls it once the scene is complete, and nothing that it learns goes back. Poses are
those of the data set, so they fit the scene as they are, or are carried over where the
scene's own were estimated. What a view recorded is tied to a bracket of the scene
through a training picture of the same exposure.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr, write_exr
from hdr_nsff.core.hashes import hash_file
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.io import holds_nothing, write_json
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage.datasets import maps
from hdr_nsff.footage.datasets.capture import Capture, select_poses
from hdr_nsff.footage.datasets.held_out_views import (
    Exposure,
    HeldOut,
    read_views,
    training_poses,
)
from hdr_nsff.footage.ingest import shrink
from hdr_nsff.footage.pose_files import fit_poses
from hdr_nsff.footage.pose_formats import GivenPoses
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.scene.manifest import FrameEntry, Manifest
from hdr_nsff.scene.truth import Truth, TruthView

NOTE = "made_of.json"
SAME_EV = 0.01  # stops: exposures closer than that are one
MAX_ROUNDING_8_BIT = 1e-6  # off whole codes of 8 bits up to which 8 bits hold a picture


def truth_folder(place: Path) -> Path | None:
    """`place` where it holds a finished truth, else None."""
    whole = (place / "truth.json").is_file() and (place / NOTE).is_file()
    return place if whole else None


def write_truth(
    capture: Capture,
    manifest: Manifest,
    own_time: Callable[[float], float],
    out: Path,
    max_size: int,
) -> Path | None:
    """Write the held-out views to the truth folder `out`; None where no view is left.

    Only views whose time is within the scene's count. What is there and right stays.
    `own_time` turns frames of the set into frames of the scene; pictures are shrunk as
    the frames were.
    """
    views, given = read_views(capture)
    brackets = Brackets.of(capture, manifest)
    rows = comparable_views(views, manifest, own_time, brackets)
    if not rows:
        say("truth: no held-out view can be compared with this scene")
        if truth_folder(out) is not None:  # of other settings
            (out / "truth.json").unlink()
        return None
    chosen = [(views[row], pictures) for row, pictures in rows.items()]
    poses = select_poses(given, list(rows))
    if claim_folder(out, truth_key(chosen, manifest, max_size, poses)):
        return out
    size = write_pictures(out, capture, chosen, max_size)
    view_poses = fit_poses(capture.root, poses, list(range(len(chosen))), size)
    clip_rows = [capture.row[f.source] for f in manifest.frames]
    clip = fit_poses(capture.root, training_poses(capture), clip_rows, size)
    records = [
        view_record(view, sorted(pictures), manifest, own_time, clip, K, c2w)
        for (view, pictures), K, c2w in zip(chosen, view_poses.K, view_poses.c2w, strict=True)
    ]
    truth = Truth(
        bracket_ev=brackets.ev,
        reference_bracket=manifest.reference_bracket,
        bracket_frame=brackets.frame,
        K=clip.K[0].tolist(),
        clip_c2w=clip.c2w.tolist(),
        views=records,
    )
    write_json(out / "truth.json", truth.model_dump())
    say(f"truth: {len(chosen)} held-out views in {out}; `hdr-nsff evaluate RUN --truth {out}`")
    return out


# Which views


def comparable_views(
    views: Sequence[HeldOut],
    manifest: Manifest,
    own_time: Callable[[float], float],
    brackets: Brackets,
) -> dict[int, dict[int, Path]]:
    """Which views a run of this scene can be compared with, and their pictures.

    Rows of `views`, and for each its pictures by bracket. Prints what is left out.
    """
    times = [f.time for f in manifest.frames if f.split == "train"]
    first, last = min(times), max(times)
    rows = [
        row
        for row, view in enumerate(views)
        if view.time is None or first <= own_time(view.time) <= last
    ]
    lost = len(views) - len(rows)
    if lost:
        say(
            f"truth: {lost} of {len(views)} held-out views lie outside the times of the "
            "training pictures: left out"
        )
    kept = {}
    for row in rows:
        pictures = brackets.of_pictures(views[row])
        if any(brackets.frame[bracket] is not None for bracket in pictures):
            kept[row] = pictures
    lost = len(rows) - len(kept)
    if lost:
        say(f"truth: {lost} held-out views are of exposures that no training picture has: left out")
    return kept


def view_record(
    view: HeldOut,
    brackets: Sequence[int],
    manifest: Manifest,
    own_time: Callable[[float], float],
    clip: Poses,
    K: np.ndarray,
    c2w: np.ndarray,
) -> TruthView:
    """The record of a view with pictures of `brackets`.

    `clip` are the set's poses of the scene's frames, K (3, 3) and c2w (3, 4) the
    view's.
    """
    exact = next((f for f in manifest.frames if f.source == view.anchor), None)
    anchor = exact or nearest_frame(manifest.frames, clip.c2w, c2w)
    bracket = manifest.reference_bracket
    if bracket not in brackets:
        bracket = brackets[0]
    same_lens = np.allclose(K, clip.K[anchor.index])
    return TruthView(
        name=view.name,
        time=anchor.time if view.time is None else own_time(view.time),
        bracket=bracket,
        anchor=anchor.index,
        c2w=None if exact else c2w.tolist(),
        K=None if same_lens else K.tolist(),
        radiance=f"radiance/{view.name}.exr" if view.radiance else None,
        recorded={b: recorded_name(view, b) for b in brackets},
        mask=f"masks/{view.name}.png" if view.mask else None,
    )


def recorded_name(view: HeldOut, bracket: int) -> str:
    """The file of what a view recorded at a bracket."""
    return f"recorded/{view.name}_{bracket}.png"


def nearest_frame(frames: Sequence[FrameEntry], clip: np.ndarray, c2w: np.ndarray) -> FrameEntry:
    """The frame whose camera is nearest: in place, and then in direction.

    `clip` (T, 3, 4) are the cameras of the frames, `c2w` (3, 4) is the other one.
    """
    distance = np.linalg.norm(clip[:, :, 3] - c2w[:, 3], axis=1)
    turn = 1 - clip[:, :, 2] @ c2w[:, 2]
    order = np.lexsort((turn, np.round(distance, 9)))
    return frames[int(order[0])]


# Exposures


@dataclass
class Brackets:
    """The brackets of the scene, and behind them those of held-out views alone."""

    capture: Capture
    entries: list[FrameEntry]
    ev: list[float | None]
    # a frame of the scene for each; None for exposures that no training picture has
    frame: list[int | None]

    @staticmethod
    def of(capture: Capture, manifest: Manifest) -> Brackets:
        """The brackets of a scene."""
        frames: list[int | None] = []
        for bracket in range(len(manifest.bracket_ev)):
            own = [f.index for f in manifest.frames if f.bracket == bracket]
            frames.append(own[0] if own else None)
        return Brackets(capture, manifest.frames, list(manifest.bracket_ev), frames)

    def of_pictures(self, view: HeldOut) -> dict[int, Path]:
        """The pictures of a view by bracket, where that is known."""
        found = {}
        for path, exposure in view.recorded:
            bracket = self.of_exposure(exposure)
            if bracket is not None:
                found[bracket] = path
        return found

    def of_exposure(self, exposure: Exposure) -> int | None:
        """The bracket of an exposure; None where it is unknown."""
        if exposure is None:
            return 0 if len(self.ev) == 1 else None
        if isinstance(exposure, list):
            sources = set(exposure)
            return next((f.bracket for f in self.entries if f.source in sources), None)
        for frame in self.entries:
            own = self.capture.by_source[frame.source].ev
            if own is not None and abs(own - exposure) < SAME_EV:
                return frame.bracket
        return self.add(exposure)

    def add(self, exposure: float) -> int | None:
        """The bracket of an exposure that no training picture has.

        None where the scene's exposures are unknown.
        """
        for frame in self.entries:
            own = self.capture.by_source[frame.source].ev
            relative = self.ev[frame.bracket]
            if own is None or relative is None:
                continue
            value = exposure - own + relative
            for bracket, ev in enumerate(self.ev):
                if ev is not None and abs(ev - value) < SAME_EV:
                    return bracket
            self.ev.append(value)
            self.frame.append(None)
            return len(self.ev) - 1
        return None


# Files


def truth_key(
    chosen: Sequence[tuple[HeldOut, dict[int, Path]]],
    manifest: Manifest,
    max_size: int,
    given: GivenPoses,
) -> str:
    """The hash of all that a truth folder depends on."""

    def hashed(path: Path | None) -> str | None:
        return None if path is None else hash_file(path)

    files: list[Any] = []
    for view, pictures in track(chosen, "held-out views"):
        recorded = {bracket: hash_file(path) for bracket, path in pictures.items()}
        maps_of_view = (hashed(view.radiance), hashed(view.mask))
        files.append((view.name, view.time, view.anchor, *maps_of_view, recorded))
    frames = [(f.source, f.time, f.bracket) for f in manifest.frames]
    poses = [given.K.tolist(), given.c2w.tolist()]
    exposures = (manifest.bracket_ev, manifest.reference_bracket)
    depends_on = [files, frames, *exposures, max_size, poses]
    return hashlib.sha256(json.dumps(depends_on).encode()).hexdigest()


def claim_folder(out: Path, key: str) -> bool:
    """Whether the truth folder `out` is complete and was made with this `key`.

    Otherwise a note of that is written, and files made of something else are removed.
    InputError where the folder holds something else.
    """
    found = notes.read(out / NOTE, notes.TruthNote)
    if found is not None and found.key == key:
        if not (out / "truth.json").is_file():
            return False
        return all((out / name).is_file() for v in Truth.open(out).views for name in v.files)
    is_ours = (out / NOTE).is_file()
    if out.exists() and not is_ours and not holds_nothing(out):
        raise InputError(
            f"{out}: already exists and was not made by prepare; "
            "choose another place with --truth-out"
        )
    (out / "truth.json").unlink(missing_ok=True)
    for name in ("recorded", "radiance", "masks"):
        shutil.rmtree(out / name, ignore_errors=True)
    notes.write(out / NOTE, notes.TruthNote(key=key))
    return False


def write_pictures(
    out: Path, capture: Capture, chosen: Sequence[tuple[HeldOut, dict[int, Path]]], max_size: int
) -> tuple[int, int]:
    """Write what the views recorded, their radiance and masks; the size (H, W) of all.

    Files that are there already stay.
    """
    size: tuple[int, int] | None = None
    for view, pictures in track(chosen, "truth"):
        for bracket, path in pictures.items():
            rgb = shrink(read_image(path, capture.over), max_size)
            size = size or (rgb.shape[0], rgb.shape[1])
            if rgb.shape[:2] != size:
                raise InputError(
                    f"{path}: another size than the other held-out views; all must have one"
                )
            write_recorded(out / recorded_name(view, bracket), rgb)
        assert size is not None, view.name
        write_mask(out / f"masks/{view.name}.png", view, size, capture.white_moves)
        write_radiance(out / f"radiance/{view.name}.exr", view, size)
    assert size is not None
    return size


def write_recorded(path: Path, rgb: np.ndarray) -> None:
    """Write a picture (H, W, 3) in 8 bits where these hold it, else in 16."""
    if path.is_file():
        return
    error = np.abs(rgb - np.rint(rgb * 255) / 255).max()
    write_png(path, rgb, bits=8 if error < MAX_ROUNDING_8_BIT else 16)


def write_mask(path: Path, view: HeldOut, size: tuple[int, int], white_moves: bool) -> None:
    """Write the moving mask of a view at `size` (H, W), if it has one."""
    if view.mask is not None and not path.is_file():
        write_png(path, maps.moving_mask(view.mask, size, white_moves))


def write_radiance(path: Path, view: HeldOut, size: tuple[int, int]) -> None:
    """Write the radiance of a view at `size` (H, W), if it has one."""
    if view.radiance is None or path.is_file():
        return
    radiance = read_exr(view.radiance).get("RGB")
    if radiance is None:
        raise InputError(
            f"{view.radiance}: no R, G and B channels; it is the radiance of a held-out view, "
            "copy it again"
        )
    resized = maps.fit_size(view.radiance, radiance, size, cv2.INTER_AREA)
    write_exr(path, {"RGB": resized}, half=False)
