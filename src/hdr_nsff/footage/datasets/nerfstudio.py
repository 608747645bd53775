"""nerfstudio's layout: `transforms.json` with OpenGL poses and intrinsics for all or
per frame; pictures named in `val_filenames` and `test_filenames` are held out.
`depth_file_path` holds millimeters, as nerfstudio's default unit has it.

Its `mask_path` says which pixels to leave out of training, not what moves, and is not
used. What the layout cannot say (exposures, times in frames, flow, moving masks) stands
under the key `hdr_nsff` where `export` wrote the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json
from hdr_nsff.footage.arrays import read_array
from hdr_nsff.footage.datasets.capture import (
    Capture,
    Clock,
    Extra,
    Picture,
    named_file,
    named_map,
    number_of,
    parse_extra,
    read_document,
    reorder,
    source_of,
    turns,
)
from hdr_nsff.footage.ingest import natural
from hdr_nsff.footage.pose_formats import GivenPoses, from_transforms

NAME = "transforms.json"
HELD_OUT = ("val_filenames", "test_filenames")
EXTRA = "hdr_nsff"
VIEWS = "held_out/"  # where `export` puts the views of a truth folder
MILLIMETERS = 1000.0  # a unit of the poses in what depth files hold


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout: poses, and the pictures that they are of.
    Poses of pictures elsewhere are for `--poses`; a file cut short is one, so that
    somebody says so.
    """
    if not (folder / NAME).is_file():
        return False
    try:
        names = [f["file_path"] for f in read_json(folder / NAME)["frames"]]
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
    outside = held_out_names(path, document)
    kept = [k for k, f in enumerate(document["frames"]) if f["file_path"] not in outside]
    if not kept:
        raise InputError(
            f"{path}: every picture is in {' or '.join(HELD_OUT)}; leave some to train on"
        )
    frames = [document["frames"][k] for k in kept]
    given = reorder(from_transforms(path, document), kept)
    extra = (
        parse_extra(path, document[EXTRA], [f["file_path"] for f in frames])
        if EXTRA in document
        else None
    )
    if extra is not None:
        return exported(folder, frames, given, extra, bool(outside))
    every = stored_times(path, document["frames"])
    times = [every[k] for k in kept]
    clock, cameras = Clock.of(times), turns(times)
    order = sorted(range(len(frames)), key=lambda k: (cameras[k], times[k]))
    return Capture(
        layout="nerfstudio",
        root=folder,
        pictures=[picture(folder, frames[k], clock(times[k]), cameras[k]) for k in order],
        poses=reorder(given, order),
        withheld=bool(outside),
        depth_scale=1 / MILLIMETERS,
        notes=notes(frames),
    )


def notes(frames: list[dict[str, Any]]) -> tuple[str, ...]:
    """What is in the file and not used."""
    masked = any("mask_path" in f for f in frames)
    return (
        ("its `mask_path` says what to leave out of training, not what moves: not used",)
        if masked
        else ()
    )


def held_out_names(path: Path, document: dict[str, Any]) -> set[str]:
    """The pictures that are not for training."""
    names: set[str] = set()
    for key in HELD_OUT:
        listed = document.get(key, [])
        if not isinstance(listed, list) or not all(isinstance(n, str) for n in listed):
            raise InputError(
                f"{path}: `{key}` is no list of file names; it says which pictures are held out, mend it"
            )
        names |= set(listed)
    trained = document.get("train_filenames")
    if trained is not None and not is_names(trained):
        raise InputError(f"{path}: `train_filenames` is no list of file names; correct it")
    known = {f["file_path"] for f in document["frames"]}
    if lost := names - known:
        raise InputError(
            f"{path}: {min(lost)} is listed as held out, but no frame has that `file_path`; mend the lists"
        )
    return names - set(trained or ())


def is_names(value: Any) -> bool:
    """Whether a value of a JSON is a list of file names."""
    return isinstance(value, list) and all(isinstance(n, str) for n in value)


def stored_times(path: Path, frames: list[dict[str, Any]]) -> list[float]:
    """`time` of the frames, else their order by file name."""
    if any("time" in f for f in frames):
        return [number_of(path, f, "time", "which says when it was taken") for f in frames]
    order = sorted(range(len(frames)), key=lambda k: natural(Path(frames[k]["file_path"])))
    return [float(order.index(k)) for k in range(len(frames))]


def picture(folder: Path, frame: dict[str, Any], time: float, camera_id: int) -> Picture:
    """A frame as the layout has it."""
    name = frame["file_path"]
    file = named_file(folder, name, f"a training picture of {NAME}")
    depth = named_depth(folder, frame)
    return Picture(source_of(folder, file), time, camera_id, depth=depth)


def named_depth(folder: Path, frame: dict[str, Any]) -> Path | None:
    """The depth map of a frame, if it names one."""
    if not isinstance(frame.get("depth_file_path"), str):
        return None
    return named_map(folder, frame["depth_file_path"], f"the depth of {frame['file_path']}")


def static_points(folder: Path, name: str | None) -> np.ndarray | None:
    """The static points (P, 3) of an export, if it has them."""
    if name is None:
        return None
    path = named_map(folder, name, "the static points")
    points = read_array(path)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(
            f"{path}: expected finite points of shape (P, 3), not {points.shape}; export again"
        )
    return points


def exported(
    folder: Path, frames: list[dict[str, Any]], given: GivenPoses, extra: Extra, withheld: bool
) -> Capture:
    """A scene of ours, as `export` wrote it."""
    own = [extra.frames[f["file_path"]] for f in frames]
    order = sorted(range(len(frames)), key=lambda k: (own[k].camera_id, own[k].time))

    def path_of(name: str | None, purpose: str, frame: dict[str, Any]) -> Path | None:
        if name is None:
            return None
        return named_map(folder, name, f"the {purpose} of {frame['file_path']}")

    pictures = [
        Picture(
            source=source_of(
                folder, named_file(folder, f["file_path"], f"a training picture of {NAME}")
            ),
            time=e.time,
            camera_id=e.camera_id,
            bracket=e.bracket,
            mask=path_of(e.moving, "moving mask", f),
            depth=path_of(e.disparity, "disparity", f),
            confidence=path_of(e.confidence, "trust in the disparity", f),
            flow={
                to: p
                for to, n in e.flow.items()
                if (p := path_of(n, f"optical flow to {to}", f)) is not None
            },
        )
        for f, e in ((frames[k], own[k]) for k in order)
    ]
    poses = reorder(given, order)
    return Capture(
        layout="nerfstudio, written by hdr-nsff",
        root=folder,
        pictures=pictures,
        poses=GivenPoses(poses.names, poses.K, poses.c2w, poses.size, extra.near, extra.far),
        withheld=withheld,
        depth_kind="disparity" if extra.depth_kind == "scene" else "relative",
        points=static_points(folder, extra.points),
        exposures=extra.exposures(),
        fps=extra.fps,
    )
