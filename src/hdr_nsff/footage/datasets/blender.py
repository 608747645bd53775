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

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.datasets.capture import (
    Capture,
    Clock,
    Picture,
    named_file,
    number_of,
    read_document,
    reorder,
    source_of,
    turns,
)
from hdr_nsff.footage.pose_formats import from_transforms

TRAIN, TEST = "transforms_train.json", "transforms_test.json"


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout."""
    return (folder / TRAIN).is_file()


def read(folder: Path) -> Capture:
    """The training pictures; InputError where something is missing or short."""
    path = folder / TRAIN
    document = read_document(path, "the training pictures and their poses")
    frames = document["frames"]
    files = [
        named_file(folder, f["file_path"], f"training picture {k} of {TRAIN}")
        for k, f in enumerate(frames)
    ]
    moves = any("time" in f for f in frames)
    times = training_times(path, frames)
    clock = Clock.of(times)
    cameras = turns(times)
    order = sorted(range(len(frames)), key=lambda k: (cameras[k], times[k]))
    evs = [exposure(path, f, layout(frames)) for f in frames]
    if any(e is None for e in evs) and any(e is not None for e in evs):
        raise InputError(
            f"{path}: only some frames have `exposures`; they say how each was exposed, copy the file again"
        )
    notes = (
        (f"{max(cameras) + 1} pictures share a time: taken as that many cameras",)
        if max(cameras)
        else ()
    )
    return Capture(
        layout=layout(frames),
        root=folder,
        pictures=[
            Picture(source_of(folder, files[k]), clock(times[k]), cameras[k], evs[k]) for k in order
        ],
        poses=reorder(from_transforms(path, document), order),
        withheld=(folder / TEST).is_file(),
        over=1.0,
        still=not moves,
        notes=notes,
    )


def training_times(path: Path, frames: list[dict[str, Any]]) -> list[float]:
    """The times as stored; the number of the view where none is."""
    if not any("time" in f for f in frames):
        return [float(k) for k in range(len(frames))]
    return [number_of(path, f, "time", "which says when it was taken") for f in frames]


def layout(frames: list[dict[str, Any]]) -> str:
    """Which of the layouts these frames are of."""
    if any("exr_file_path" in f for f in frames):
        return "HDR-4D (Blender)"
    if any("exposures" in f for f in frames):
        return "HDR-HexPlane (Blender)"
    return "D-NeRF (Blender)" if any("time" in f for f in frames) else "NeRF synthetic (Blender)"


def exposure(path: Path, frame: dict[str, Any], kind: str) -> float | None:
    """The EV of a frame: HDR-4D stores exposure times, HDR-HexPlane stops."""
    if "exposures" not in frame:
        return None
    value = number_of(path, frame, "exposures", "which says how it was exposed")
    if not kind.startswith("HDR-4D"):
        return value
    if value <= 0:
        raise InputError(
            f"{path}: {frame['file_path']} has an exposure time of {value:g}; it must be above 0"
        )
    return math.log2(value)
