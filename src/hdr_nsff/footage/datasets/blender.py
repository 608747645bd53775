"""Blender layouts: `transforms_train.json` with OpenGL poses, a `time` per frame, RGBA
pictures shown over white.

- D-NeRF: `time` in [0, 1], one exposure.
- HDR-HexPlane: `exposures` in stops, `time` counts frames.
- HDR-4D: `exposures` in exposure times, and `exr_file_path`, the picture's true
  radiance: opened for held-out views alone.
- without `time` (NeRF's synthetic scenes): nothing moves, times only number the views.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.footage.datasets.capture import (
    Capture,
    Clock,
    Picture,
    number_cameras,
    select_poses,
)
from hdr_nsff.footage.datasets.set_files import (
    number_of,
    picture_file,
    read_document,
    source_of,
)
from hdr_nsff.footage.pose_formats import from_transforms
from hdr_nsff.geometry.paths import MAX_EV

TRAIN = "transforms_train.json"
TEST = "transforms_test.json"


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout."""
    return (folder / TRAIN).is_file()


def read(folder: Path) -> Capture:
    """The training pictures; InputError where something is missing or short."""
    path = folder / TRAIN
    document = read_document(path, "the training pictures and their poses")
    frames = document["frames"]
    kind = layout_name(frames)
    files = [
        picture_file(folder, frame["file_path"], f"training picture {number} of {TRAIN}")
        for number, frame in enumerate(frames)
    ]
    times = stored_times(path, frames)
    clock = Clock.of(times)
    cameras = number_cameras(times)
    evs = [exposure_of(path, frame, kind) for frame in frames]
    if any(ev is None for ev in evs) and any(ev is not None for ev in evs):
        raise InputError(
            f"{path}: only some frames have `exposures`, the exposure of a frame; "
            "copy the file again"
        )
    order = sorted(range(len(frames)), key=lambda k: (cameras[k], times[k]))
    pictures = [
        Picture(source_of(folder, files[k]), clock(times[k]), cameras[k], evs[k]) for k in order
    ]
    notes: tuple[str, ...] = ()
    if max(cameras):
        notes = (f"{max(cameras) + 1} pictures share a time: taken as that many cameras",)
    return Capture(
        layout=kind,
        root=folder,
        pictures=pictures,
        poses=select_poses(from_transforms(path, document), order),
        has_held_out=(folder / TEST).is_file(),
        over=1.0,
        is_static=not any("time" in frame for frame in frames),
        notes=notes,
    )


def stored_times(path: Path, frames: list[dict[str, Any]]) -> list[float]:
    """The times as stored; the number of the view where none is."""
    if not any("time" in frame for frame in frames):
        return [float(number) for number in range(len(frames))]
    return [number_of(path, f, "time", "the time it was taken at") for f in frames]


def layout_name(frames: list[dict[str, Any]]) -> str:
    """Which of the layouts these frames are of."""
    if any("exr_file_path" in frame for frame in frames):
        return "HDR-4D (Blender)"
    if any("exposures" in frame for frame in frames):
        return "HDR-HexPlane (Blender)"
    if any("time" in frame for frame in frames):
        return "D-NeRF (Blender)"
    return "NeRF synthetic (Blender)"


def exposure_of(path: Path, frame: dict[str, Any], kind: str) -> float | None:
    """The EV of a frame: HDR-4D stores exposure times, HDR-HexPlane stops."""
    if "exposures" not in frame:
        return None
    value = number_of(path, frame, "exposures", "its exposure")
    name = shorten(frame["file_path"])
    if kind.startswith("HDR-4D"):
        if value <= 0:
            raise InputError(
                f"{path}: {name} has an exposure time of {value:g}; it must be above 0"
            )
        value = math.log2(value)
    if abs(value) > MAX_EV:
        raise InputError(
            f"{path}: {name} has an exposure of {value:g} stops, beyond {MAX_EV:g}; correct it"
        )
    return value
