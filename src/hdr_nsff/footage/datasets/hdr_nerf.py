"""HDR-NeRF's synthetic layout: still scenes, five exposures `<file_path>_{0..4}.png` of
every view, their times in `exposure_{split}.json`, poses as Blender writes them.

One picture per view is trained on. The paper draws it at random from the first, third
and fifth exposure; we let these three alternate from view to view, which is the same
share of each and needs no seed. The second and fourth stay unseen: `evaluate` asks for
them as novel exposures.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.footage.datasets.blender import TEST, TRAIN
from hdr_nsff.footage.datasets.capture import Capture, Picture
from hdr_nsff.footage.datasets.set_files import (
    picture_file,
    read_document,
    read_object,
    source_of,
)
from hdr_nsff.footage.pose_formats import from_transforms

NUM_EXPOSURES = 5
TRAINED = (0, 2, 4)  # exposures that are trained on, in turn


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout."""
    tables = [folder / f"exposure_{split}.json" for split in ("train", "test")]
    return (folder / TRAIN).is_file() and any(table.is_file() for table in tables)


def read(folder: Path) -> Capture:
    """One picture of every training view.

    InputError where something is missing or short.
    """
    path = folder / TRAIN
    document = read_document(path, "the training views and their poses")
    times = exposure_times(folder, "train")
    pictures = []
    for number, frame in enumerate(document["frames"]):
        which = TRAINED[number % len(TRAINED)]
        purpose = f"exposure {which} of training view {number}"
        file = picture_file(folder, picture_name(frame, which), purpose)
        ev = ev_of(folder, "train", times, frame, which)
        pictures.append(Picture(source_of(folder, file), float(number), ev=ev))
    return Capture(
        layout="HDR-NeRF (synthetic)",
        root=folder,
        pictures=pictures,
        poses=from_transforms(path, document),
        has_held_out=(folder / TEST).is_file(),
        over=1.0,
        is_static=True,
    )


def exposure_times(folder: Path, split: str) -> dict[str, Any]:
    """`exposure_{split}.json`: picture -> exposure time, names without `./`."""
    path = folder / f"exposure_{split}.json"
    table = read_object(path, f"the exposure times of the {split} pictures")
    return {name.removeprefix("./"): value for name, value in table.items()}


def picture_name(frame: dict[str, Any], which: int) -> str:
    """The picture of a view at exposure `which`."""
    return f"{frame['file_path']}_{which}.png"


def ev_of(
    folder: Path, split: str, times: dict[str, Any], frame: dict[str, Any], which: int
) -> float:
    """The EV of exposure `which` of a view."""
    path = folder / f"exposure_{split}.json"
    name = picture_name(frame, which).removeprefix("./")
    try:
        seconds = float(times[name])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: no exposure time for {shorten(name)}; copy the file again"
        ) from error
    if not (math.isfinite(seconds) and seconds > 0):
        raise InputError(
            f"{path}: an exposure time of {seconds:g} for {shorten(name)}; it must be above 0"
        )
    return math.log2(seconds)
