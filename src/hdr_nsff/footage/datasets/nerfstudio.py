"""nerfstudio's layout: `transforms.json` with OpenGL poses and intrinsics for all or
per frame; pictures named in `val_filenames` and `test_filenames` are held out.
`depth_file_path` holds millimeters, as nerfstudio's default unit has it.

Its `mask_path` masks pixels out of training, whether they move or not, and is not used.
What the layout has no place for (exposures, times in frames, flow, moving masks) stands
under the key `hdr_nsff` where `export` wrote the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.footage.arrays import read_array
from hdr_nsff.footage.datasets.capture import (
    Capture,
    Clock,
    Picture,
    number_cameras,
    select_poses,
)
from hdr_nsff.footage.datasets.extra import Extra, ExtraFrame, parse_extra
from hdr_nsff.footage.datasets.set_files import (
    map_file,
    number_of,
    picture_file,
    read_document,
    source_of,
)
from hdr_nsff.footage.depth_files import MILLIMETERS
from hdr_nsff.footage.frame_files import natural_key
from hdr_nsff.footage.pose_formats import GivenPoses, from_transforms

NAME = "transforms.json"
HELD_OUT = ("val_filenames", "test_filenames")
EXTRA = "hdr_nsff"
VIEWS = "held_out/"  # where `export` puts the views of a truth folder


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout: poses, and the pictures that they are of.

    Poses of pictures elsewhere are for `--poses`. A file cut short counts, so that
    reading it names the problem.
    """
    if not (folder / NAME).is_file():
        return False
    try:
        names = [frame["file_path"] for frame in read_json(folder / NAME)["frames"]]
    except (OSError, ValueError, TypeError, KeyError):
        return True
    return not names or any(isinstance(n, str) and has_folder(folder, n) for n in names)


def has_folder(folder: Path, name: str) -> bool:
    """Whether the folder of a named picture is there."""
    try:
        return (folder / name).parent.is_dir()
    except OSError:  # a name too long to be one
        return False


def read(folder: Path) -> Capture:
    """The training pictures; InputError where something is missing or short."""
    path = folder / NAME
    document = read_document(path, "the pictures and their poses")
    every = document["frames"]
    outside = held_out_names(path, document)
    kept = [k for k, frame in enumerate(every) if frame["file_path"] not in outside]
    if not kept:
        raise InputError(
            f"{path}: every picture is in {' or '.join(HELD_OUT)}; leave some to train on"
        )
    frames = [every[k] for k in kept]
    given = select_poses(from_transforms(path, document), kept)
    if EXTRA in document:
        extra = parse_extra(path, document[EXTRA], [frame["file_path"] for frame in frames])
        return exported(folder, frames, given, extra, bool(outside))
    all_times = stored_times(path, every)
    times = [all_times[k] for k in kept]
    clock = Clock.of(times)
    cameras = number_cameras(times)
    order = sorted(range(len(frames)), key=lambda k: (cameras[k], times[k]))
    pictures = [read_picture(folder, frames[k], clock(times[k]), cameras[k]) for k in order]
    notes: tuple[str, ...] = ()
    if any("mask_path" in frame for frame in frames):
        notes = ("its `mask_path` masks pixels out of training, not moving ones: not used",)
    return Capture(
        layout="nerfstudio",
        root=folder,
        pictures=pictures,
        poses=select_poses(given, order),
        has_held_out=bool(outside),
        depth_scale=1 / MILLIMETERS,
        notes=notes,
    )


def held_out_names(path: Path, document: dict[str, Any]) -> set[str]:
    """The pictures that are not for training."""
    held_out = {name for key in HELD_OUT for name in read_names(path, document, key)}
    lost = held_out - {frame["file_path"] for frame in document["frames"]}
    if lost:
        raise InputError(
            f"{path}: {shorten(min(lost))} is listed as held out, but no frame has that "
            "`file_path`; correct the lists"
        )
    return held_out - set(read_names(path, document, "train_filenames"))


def read_names(path: Path, document: dict[str, Any], key: str) -> list[str]:
    """The pictures listed under a key; none where it is missing."""
    listed = document.get(key, [])
    if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
        raise InputError(
            f"{path}: `{key}` is no list of file names; it lists which pictures are held out, "
            "correct it"
        )
    return listed


def stored_times(path: Path, frames: Sequence[dict[str, Any]]) -> list[float]:
    """`time` of the frames, else their order by file name."""
    if any("time" in frame for frame in frames):
        return [number_of(path, f, "time", "the time it was taken at") for f in frames]
    names = [Path(frame["file_path"]) for frame in frames]
    order = sorted(range(len(frames)), key=lambda k: natural_key(names[k]))
    times = [0.0] * len(frames)
    for position, k in enumerate(order):
        times[k] = float(position)
    return times


def read_picture(folder: Path, frame: dict[str, Any], time: float, camera_id: int) -> Picture:
    """A training picture, with its depth if it names one."""
    name = frame["file_path"]
    file = picture_file(folder, name, f"a training picture of {NAME}")
    depth = None
    if isinstance(frame.get("depth_file_path"), str):
        depth = map_file(folder, frame["depth_file_path"], f"the depth of {shorten(name)}")
    return Picture(source_of(folder, file), time, camera_id, depth=depth)


# Folders that `export` wrote


def exported(
    folder: Path, frames: list[dict[str, Any]], given: GivenPoses, extra: Extra, has_held_out: bool
) -> Capture:
    """A scene that `export` wrote in this layout."""
    own = [extra.frames[frame["file_path"]] for frame in frames]
    order = sorted(range(len(frames)), key=lambda k: (own[k].camera_id, own[k].time))
    poses = select_poses(given, order)
    return Capture(
        layout="nerfstudio, written by hdr-nsff",
        root=folder,
        pictures=[exported_picture(folder, frames[k]["file_path"], own[k]) for k in order],
        poses=replace(poses, near=extra.near, far=extra.far),
        has_held_out=has_held_out,
        depth_kind="disparity" if extra.depth_kind == "scene" else "relative",
        points=static_points(folder, extra.points),
        exposures=extra.exposures(),
        fps=extra.fps,
    )


def exported_picture(folder: Path, name: str, own: ExtraFrame) -> Picture:
    """A training picture with all of its maps."""

    def named(map_name: str | None, purpose: str) -> Path | None:
        if map_name is None:
            return None
        return map_file(folder, map_name, f"the {purpose} of {shorten(name)}")

    file = picture_file(folder, name, f"a training picture of {NAME}")
    flow = {
        to: map_file(folder, map_name, f"the optical flow to {shorten(to)} of {shorten(name)}")
        for to, map_name in own.flow.items()
    }
    return Picture(
        source=source_of(folder, file),
        time=own.time,
        camera_id=own.camera_id,
        bracket=own.bracket,
        mask=named(own.moving, "moving mask"),
        depth=named(own.disparity, "disparity"),
        confidence=named(own.confidence, "confidence of the disparity"),
        flow=flow,
    )


def static_points(folder: Path, name: str | None) -> np.ndarray | None:
    """The static points (P, 3) of an export, if it has them."""
    if name is None:
        return None
    path = map_file(folder, name, "the static points")
    points = read_array(path)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(
            f"{path}: expected finite points of shape (P, 3), not {points.shape}; export again"
        )
    return points
