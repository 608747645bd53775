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
from hdr_nsff.footage.datasets.capture import (
    Capture,
    Picture,
    named_file,
    read_document,
    read_object,
    source_of,
)
from hdr_nsff.footage.pose_formats import from_transforms

COUNT = 5
TRAINED = (0, 2, 4)


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout."""
    return (folder / TRAIN).is_file() and any(
        (folder / f"exposure_{split}.json").is_file() for split in ("train", "test")
    )


def read(folder: Path) -> Capture:
    """One picture of every training view; InputError where something is missing or
    short.
    """
    path = folder / TRAIN
    document = read_document(path, "the training views and their poses")
    table = exposures(folder, "train")
    pictures = []
    for k, frame in enumerate(document["frames"]):
        which = TRAINED[k % len(TRAINED)]
        file = named_file(
            folder, f"{frame['file_path']}_{which}.png", f"exposure {which} of training view {k}"
        )
        pictures.append(
            Picture(
                source_of(folder, file), float(k), ev=ev_of(folder, "train", table, frame, which)
            )
        )
    return Capture(
        layout="HDR-NeRF (synthetic)",
        root=folder,
        pictures=pictures,
        poses=from_transforms(path, document),
        withheld=(folder / TEST).is_file(),
        over=1.0,
        still=True,
    )


def exposures(folder: Path, split: str) -> dict[str, Any]:
    """`exposure_{split}.json`: picture -> exposure time, names without a leading `./`."""
    table = read_object(
        folder / f"exposure_{split}.json", f"the exposure times of the {split} pictures"
    )
    return {plain(name): value for name, value in table.items()}


def plain(name: str) -> str:
    """A name without a leading `./`."""
    return name.removeprefix("./")


def ev_of(
    folder: Path, split: str, table: dict[str, Any], frame: dict[str, Any], which: int
) -> float:
    """The EV of exposure `which` of a view."""
    name = plain(f"{frame['file_path']}_{which}.png")
    try:
        seconds = float(table[name])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{folder / f'exposure_{split}.json'}: no exposure time for {shorten(name)}; copy the file again"
        ) from error
    if not (math.isfinite(seconds) and seconds > 0):
        raise InputError(
            f"{folder / f'exposure_{split}.json'}: an exposure time of {seconds:g} for {shorten(name)}; it must be above 0"
        )
    return math.log2(seconds)
