"""What a public data set keeps back for testing -> a truth folder outside the scene,
which `evaluate` alone reads.

The only file of the package that opens held-out pictures, masks and radiance; `prepare`
calls it once the scene is whole, and nothing that it learns goes back. Poses are those
of the data set, so they fit the scene as they are, or are carried over where the
scene's own were estimated. What a view recorded is tied to a bracket of the scene
through a training picture of the same exposure.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_exr, read_image, write_exr, write_json, write_png
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage.datasets import (
    blender,
    hdr_nerf,
    hdr_nerf_real,
    layout_of,
    llff,
    maps,
    nerfstudio,
)
from hdr_nsff.footage.datasets.capture import (
    Capture,
    Clock,
    Extra,
    named_file,
    named_map,
    parse_extra,
    read_document,
    reorder,
)
from hdr_nsff.footage.ingest import hash_file, shrink
from hdr_nsff.footage.pose_files import placed
from hdr_nsff.footage.pose_formats import GivenPoses, from_transforms
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.scene.scene import FrameEntry, Manifest
from hdr_nsff.scene.truth import Truth, TruthView

NOTE = "made_of.json"
SAME_EV = 0.01  # stops between two exposures that are one
Exposure = float | list[str] | None  # stored EV, or training pictures exposed like it, or not known


@dataclass(frozen=True)
class HeldOut:
    """One view that a data set keeps back."""

    name: str
    time: float | None  # in frames of the set; None: nothing moves
    recorded: list[tuple[Path, Exposure]]  # pictures of it
    radiance: Path | None = None
    mask: Path | None = None
    anchor: str | None = None  # the training picture whose pose it has exactly


def truth_folder(place: Path) -> Path | None:
    """`place` where it holds a finished truth, else None."""
    return place if (place / "truth.json").is_file() and (place / NOTE).is_file() else None


def read(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """The views that a set keeps back, and their poses, row by row. InputError where
    something is missing or short.
    """
    readers = {
        "nerfstudio": from_nerfstudio,
        "hdr-nerf": from_hdr_nerf,
        "hdr-nerf-real": from_hdr_nerf_real,
        "blender": from_blender,
        "hdr-gopro": from_llff,
    }
    name = layout_of(capture.root)
    assert name is not None, capture.root
    return readers[name](capture)


def from_blender(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """`transforms_test.json`; radiance where `exr_file_path` names it."""
    root, path = capture.root, capture.root / blender.TEST
    train = read_document(root / blender.TRAIN, "the training pictures and their poses")["frames"]
    clock = Clock.of(blender.training_times(root / blender.TRAIN, train))
    document = read_document(path, "the held-out views and their poses")
    views = []
    for k, (frame, stored) in enumerate(
        zip(document["frames"], blender.training_times(path, document["frames"]), strict=True)
    ):
        file = named_file(root, frame["file_path"], f"held-out view {k} of {blender.TEST}")
        ev = blender.exposure(path, frame, blender.layout(train))
        like: Exposure = [p.source for p in capture.pictures] if ev is None else ev
        exr = frame.get("exr_file_path")
        radiance = (
            named_file(root, exr, f"the radiance of held-out view {k}")
            if isinstance(exr, str)
            else None
        )
        time = None if capture.still else clock(stored)
        views.append(HeldOut(f"{k:04d}", time, [(file, like)], radiance))
    return views, from_transforms(path, document)


def from_hdr_nerf(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """All five exposures of every test view, and its radiance where
    `test_hdr/hdr_<number>.exr` is there.
    """
    root, path = capture.root, capture.root / blender.TEST
    document = read_document(path, "the held-out views and their poses")
    table = hdr_nerf.exposures(root, "test")
    views = []
    for k, frame in enumerate(document["frames"]):
        pictures: list[tuple[Path, Exposure]] = [
            (
                named_file(
                    root, f"{frame['file_path']}_{e}.png", f"exposure {e} of held-out view {k}"
                ),
                hdr_nerf.ev_of(root, "test", table, frame, e),
            )
            for e in range(hdr_nerf.COUNT)
        ]
        exr = root / "test_hdr" / f"hdr_{k:03d}.exr"
        views.append(HeldOut(f"{k:04d}", None, pictures, exr if exr.is_file() else None))
    return views, from_transforms(path, document)


def from_hdr_nerf_real(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """All five exposures of every second pose."""
    given, ev = hdr_nerf_real.rows(capture.root)
    files = hdr_nerf_real.pictures(capture.root, len(ev))
    poses = hdr_nerf_real.held_out_rows(len(ev))
    views = [
        HeldOut(f"{k:04d}", None, [(files[row], ev[row]) for row in rows])
        for k, rows in enumerate(poses)
    ]
    return views, reorder(given, [rows[0] for rows in poses])


def from_nerfstudio(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """The frames that `val_filenames` and `test_filenames` name."""
    root, path = capture.root, capture.root / nerfstudio.NAME
    document = read_document(path, "the pictures and their poses")
    outside = nerfstudio.held_out_names(path, document)
    frames = document["frames"]
    kept = [k for k, f in enumerate(frames) if f["file_path"] in outside]
    times = nerfstudio.stored_times(path, frames)
    clock = Clock.of(
        [t for t, f in zip(times, frames, strict=True) if f["file_path"] not in outside]
    )
    names = [f["file_path"] for f in frames]
    extra = (
        parse_extra(path, document[nerfstudio.EXTRA], names)
        if nerfstudio.EXTRA in document
        else None
    )
    views = []
    for k in kept:
        file = named_file(root, names[k], f"a held-out view of {nerfstudio.NAME}")
        plain = Path(names[k].removeprefix(nerfstudio.VIEWS)).with_suffix("").as_posix()
        name = re.sub(r"[^A-Za-z0-9._-]", "_", plain)
        if extra is None:
            views.append(HeldOut(name, clock(times[k]), [(file, None)]))
            continue
        own = extra.frames[names[k]]
        like: Exposure = [p.source for p in capture.pictures if p.bracket == own.bracket]
        mask = None
        if own.moving is not None:
            mask = named_map(root, own.moving, f"the moving mask of held-out view {name}")
        views.append(HeldOut(name, own.time, [(file, like)], mask=mask))
    return views, reorder(from_transforms(path, document), kept)


def from_llff(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """`mv_images/<time>/<camera>.png` of the cameras that no training picture of that
    time is from, `mv_images_time/` half a frame later, their masks in `mv_masks/` and
    `mv_masks_time/`. Of a set that `export` wrote, the ones that it noted.
    """
    dense = llff.dense_folder(capture.root)
    extra = llff.noted(dense, [Path(p.source).name for p in capture.pictures])
    if extra is not None and extra.held_out:
        return noted_views(capture, dense, extra)
    count = len(capture.pictures)
    views, rows = [], []
    for name, later in zip(llff.MULTI_VIEW, (0.0, 0.5), strict=True):
        if (folder := llff.multi_view(capture.root, name)) is None:
            continue
        masks = llff.multi_view(capture.root, name.replace("images", "masks"))
        steps = range(count if later == 0 else count - 1)
        cameras = cameras_of(folder, steps)
        for t in steps:
            for k in range(cameras):
                if later == 0 and t % cameras == k:
                    continue  # the training picture
                view = multi_view(capture, folder, masks, t, k, cameras, later)
                views.append(view)
                rows.append(k)
    return views, reorder(capture_poses(capture), rows)


def noted_views(capture: Capture, dense: Path, extra: Extra) -> tuple[list[HeldOut], GivenPoses]:
    """The views that `export --truth` wrote below `dense`: some times, some cameras."""
    views = []
    source = {Path(p.source).name: p.source for p in capture.pictures}
    for name, own in extra.held_out.items():
        like: Exposure = [p.source for p in capture.pictures if p.bracket == own.bracket]
        picture = named_file(dense, name, f"held-out view {own.name}")
        mask = (
            None
            if own.mask is None
            else named_file(dense, own.mask, f"the moving mask of held-out view {own.name}")
        )
        views.append(
            HeldOut(own.name, own.time, [(picture, like)], mask=mask, anchor=source[own.anchor])
        )
    return views, reorder(capture_poses(capture), [capture.row[str(v.anchor)] for v in views])


def cameras_of(folder: Path, steps: range) -> int:
    """How many cameras there are; InputError where a time is missing."""
    lost = next((t for t in steps if not (folder / f"{t:05d}").is_dir()), None)
    if lost is not None:
        raise InputError(
            f"{folder / f'{lost:05d}'}: missing; it holds what every camera saw at time {lost}, copy it again"
        )
    return max(len(list((folder / f"{t:05d}").glob("[0-9]*.png"))) for t in steps)


def multi_view(
    capture: Capture, folder: Path, masks: Path | None, t: int, k: int, cameras: int, later: float
) -> HeldOut:
    """What camera `k` (from 0) saw at time `t`; its pose is that of training picture
    `k`, its exposure that of its own pictures.
    """
    name = f"{t:05d}/{k + 1:05d}.png"
    if not (folder / name).is_file():
        raise InputError(
            f"{folder / name}: missing; it is what camera {k + 1} saw at time {t}, copy it again"
        )
    mask = masks / name if masks is not None else None
    if mask is not None and not mask.is_file():
        raise InputError(
            f"{mask}: missing; it is the moving mask of held-out view {folder.name}/{name}, copy it again"
        )
    if k >= len(capture.pictures):
        raise InputError(
            f"{folder / name}: camera {k + 1} has no training picture and so no pose; copy the pictures again"
        )
    own: Exposure = [capture.pictures[i].source for i in range(k, len(capture.pictures), cameras)]
    label = f"t{t + later:07.1f}_camera{k + 1}"
    return HeldOut(
        label, t + later, [(folder / name, own)], mask=mask, anchor=capture.pictures[k].source
    )


# The truth folder


def write_truth(
    capture: Capture,
    manifest: Manifest,
    own_time: Callable[[float], float],
    out: Path,
    max_size: int,
) -> Path | None:
    """Write the held-out views whose time is within the scene's to the truth folder
    `out`; what is there and right stays.

    `own_time` turns frames of the set into frames of the scene; pictures are shrunk as
    the frames were. None where no view is left.
    """
    views, given = read(capture)
    brackets = Brackets.of(capture, manifest)
    shown = comparable(views, manifest, own_time, brackets)
    if not shown:
        say("truth: no held-out view is left to compare with")
        if truth_folder(out) is not None:  # of other settings
            (out / "truth.json").unlink()
        return None
    rows = reorder(given, [row for row, _ in shown])
    chosen = [(views[row], pictures) for row, pictures in shown]
    if claim(out, key_of(chosen, manifest, max_size, rows)):
        return out
    size = write_pictures(out, capture, chosen, max_size)
    poses = placed(capture.root, rows, list(range(len(chosen))), size)
    clip = placed(
        capture.root, capture_poses(capture), [capture.row[f.source] for f in manifest.frames], size
    )
    truth = Truth(
        bracket_ev=brackets.ev,
        reference_bracket=manifest.reference_bracket,
        bracket_frame=brackets.frame,
        K=clip.K[0].tolist(),
        clip_c2w=clip.c2w.tolist(),
        views=[
            truth_view(view, sorted(pictures), manifest, own_time, clip, K, c2w)
            for (view, pictures), K, c2w in zip(chosen, poses.K, poses.c2w, strict=True)
        ],
    )
    write_json(out / "truth.json", truth.model_dump())
    say(f"truth: {len(chosen)} held-out views in {out}; `hdr-nsff evaluate RUN --truth {out}`")
    return out


def comparable(
    views: Sequence[HeldOut],
    manifest: Manifest,
    own_time: Callable[[float], float],
    brackets: Brackets,
) -> list[tuple[int, dict[int, Path]]]:
    """Which views a run of this scene can be compared with, and their pictures by
    bracket; says what is left out.
    """
    times = [f.time for f in manifest.frames if f.split == "train"]
    inside = [
        k
        for k, v in enumerate(views)
        if v.time is None or min(times) <= own_time(v.time) <= max(times)
    ]
    if lost := len(views) - len(inside):
        say(
            f"truth: {lost} of {len(views)} held-out views are of times that no training pictures surround: left out"
        )
    kept = [(k, brackets.of_pictures(views[k])) for k in inside]
    kept = [
        (k, pictures)
        for k, pictures in kept
        if any(brackets.frame[b] is not None for b in pictures)
    ]
    if lost := len(inside) - len(kept):
        say(
            f"truth: {lost} held-out views are of exposures that the training pictures do not tell: left out"
        )
    return kept


def truth_view(
    view: HeldOut,
    brackets: Sequence[int],
    manifest: Manifest,
    own_time: Callable[[float], float],
    clip: Poses,
    K: np.ndarray,
    c2w: np.ndarray,
) -> TruthView:
    """The record of a view with pictures of `brackets`; `clip` are the set's poses of
    the scene's frames.
    """
    exact = next((f for f in manifest.frames if f.source == view.anchor), None)
    anchor = exact or nearest(manifest.frames, clip.c2w, c2w)
    return TruthView(
        name=view.name,
        time=anchor.time if view.time is None else own_time(view.time),
        bracket=manifest.reference_bracket
        if manifest.reference_bracket in brackets
        else brackets[0],
        anchor=anchor.index,
        c2w=None if exact else c2w.tolist(),
        K=None if np.allclose(K, clip.K[anchor.index]) else K.tolist(),
        radiance=f"radiance/{view.name}.exr" if view.radiance else None,
        recorded={b: recording(view, b) for b in brackets},
        mask=f"masks/{view.name}.png" if view.mask else None,
    )


def capture_poses(capture: Capture) -> GivenPoses:
    """The poses of the training pictures."""
    assert capture.poses is not None, "every layout with held-out views has poses"
    return capture.poses


def recording(view: HeldOut, bracket: int) -> str:
    """The file of what a view recorded at a bracket."""
    return f"recorded/{view.name}_{bracket}.png"


@dataclass
class Brackets:
    """The brackets of the scene, and behind them exposures that only held-out views
    have.
    """

    capture: Capture
    entries: list[FrameEntry]
    ev: list[float | None]
    frame: list[
        int | None
    ]  # a frame of the scene for each, None for exposures that no training picture has

    @staticmethod
    def of(capture: Capture, m: Manifest) -> Brackets:
        """Those of a scene."""
        count = len(m.bracket_ev)
        frames = [next((f.index for f in m.frames if f.bracket == b), None) for b in range(count)]
        return Brackets(capture, m.frames, list(m.bracket_ev), frames)

    def of_pictures(self, view: HeldOut) -> dict[int, Path]:
        """The pictures of a view by bracket; those whose exposure cannot be told are
        left out.
        """
        found = {}
        for path, exposure in view.recorded:
            bracket = self.of_exposure(exposure)
            if bracket is not None:
                found[bracket] = path
        return found

    def of_exposure(self, exposure: Exposure) -> int | None:
        """The bracket of an exposure; None where it cannot be told."""
        if exposure is None:
            return 0 if len(self.ev) == 1 else None
        stored = {f.source: self.capture.by_source[f.source].ev for f in self.entries}
        if isinstance(exposure, list):
            return next((f.bracket for f in self.entries if f.source in set(exposure)), None)
        for f in self.entries:
            own = stored[f.source]
            if own is not None and abs(own - exposure) < SAME_EV:
                return f.bracket
        return self.novel(exposure, stored)

    def novel(self, exposure: float, stored: dict[str, float | None]) -> int | None:
        """The bracket of an exposure that no training picture has; None where the
        scene's exposures are not known.
        """
        for f in self.entries:
            own, relative = stored[f.source], self.ev[f.bracket]
            if own is None or relative is None:
                continue
            value = exposure - own + relative
            for b, ev in enumerate(self.ev):
                if ev is not None and abs(ev - value) < SAME_EV:
                    return b
            self.ev.append(value)
            self.frame.append(None)
            return len(self.ev) - 1
        return None


def key_of(
    chosen: Sequence[tuple[HeldOut, dict[int, Path]]], m: Manifest, max_size: int, given: GivenPoses
) -> str:
    """The hash of all that a truth folder depends on."""

    def hashed(path: Path | None) -> str | None:
        return None if path is None else hash_file(path)

    files: list[Any] = [
        (
            v.name,
            v.time,
            v.anchor,
            hashed(v.radiance),
            hashed(v.mask),
            {b: hashed(p) for b, p in pictures.items()},
        )
        for v, pictures in track(chosen, "held-out views")
    ]
    scene = [(f.source, f.time, f.bracket) for f in m.frames]
    poses = [given.K.tolist(), given.c2w.tolist()]
    return hashlib.sha256(
        json.dumps([files, scene, m.bracket_ev, m.reference_bracket, max_size, poses]).encode()
    ).hexdigest()


def claim(out: Path, key: str) -> bool:
    """Whether the truth folder of that make is whole. Otherwise notes what it is made
    of, and removes files of another make. InputError where it holds something else.
    """
    found = notes.read(out / NOTE, notes.Made)
    if found is not None and found.key == key:
        return (out / "truth.json").is_file() and all(
            (out / n).is_file() for v in Truth.open(out).views for n in v.files
        )
    if out.exists() and not (out / NOTE).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(
            f"{out}: is there already and was not made by prepare; choose another place with --truth-out"
        )
    (out / "truth.json").unlink(missing_ok=True)
    for name in ("recorded", "radiance", "masks"):
        shutil.rmtree(out / name, ignore_errors=True)
    notes.write(out / NOTE, notes.Made(key=key))
    return False


def write_pictures(
    out: Path, capture: Capture, shown: Sequence[tuple[HeldOut, dict[int, Path]]], max_size: int
) -> tuple[int, int]:
    """Write what the views recorded, their radiance and masks, those not there yet; the
    size (H, W) that all have.
    """
    size: tuple[int, int] | None = None
    for view, pictures in track(shown, "truth"):
        for bracket, path in pictures.items():
            rgb = shrink(read_image(path, capture.over), max_size)
            size = size or rgb.shape[:2]
            if rgb.shape[:2] != size:
                raise InputError(
                    f"{path}: another size than the other held-out views; all must have one"
                )
            exact = np.abs(rgb - np.rint(rgb * 255) / 255).max() < 1e-6
            if not (out / recording(view, bracket)).is_file():
                write_png(out / recording(view, bracket), rgb, bits=8 if exact else 16)
        assert size is not None, view.name
        if view.mask is not None and not (out / f"masks/{view.name}.png").is_file():
            write_png(
                out / f"masks/{view.name}.png",
                maps.moving_mask(view.mask, size, capture.white_moves),
            )
        if view.radiance is not None and not (exr := out / f"radiance/{view.name}.exr").is_file():
            radiance = read_exr(view.radiance).get("RGB")
            if radiance is None:
                raise InputError(
                    f"{view.radiance}: no R, G and B channels; it is the radiance of a held-out view, copy it again"
                )
            write_exr(
                exr, {"RGB": maps.fitted(view.radiance, radiance, size, maps.AREA)}, half=False
            )
    assert size is not None
    return size


def nearest(frames: Sequence[FrameEntry], clip: np.ndarray, c2w: np.ndarray) -> FrameEntry:
    """The frame whose camera is nearest: in place, and among those as near in
    direction.
    """
    distance = np.linalg.norm(clip[:, :, 3] - c2w[:, 3], axis=1)
    turn = 1 - clip[:, :, 2] @ c2w[:, 2]
    return frames[int(np.lexsort((turn, np.round(distance, 9)))[0])]
