"""HDR-NeRF's real scenes: still, five exposures of every pose, one after the other in
`input_images/`, and a row for every picture in `poses_bounds_exps.npy` (N, 18): LLFF's
3x5 matrix (columns down, right, back), near and far, exposure time in seconds. Rows
are in plain string order of the names, as LLFF sorts them.

Every second pose is trained on, the first one too, the others are held out with all
five exposures: their protocol. As in the synthetic scenes, one picture per training
pose counts, of the first, third and fifth exposure in turn (they draw it at random).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.datasets.capture import Capture, Picture, select_poses
from hdr_nsff.footage.datasets.hdr_nerf import NUM_EXPOSURES, TRAINED
from hdr_nsff.footage.datasets.set_files import source_of
from hdr_nsff.footage.frame_files import frame_files
from hdr_nsff.footage.pose_formats import (
    GivenPoses,
    llff_places,
    llff_rows,
    llff_table,
    order_note,
)

NAME = "poses_bounds_exps.npy"
PICTURES = "input_images"


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout."""
    return (folder / NAME).is_file()


def read(folder: Path) -> Capture:
    """One picture of every training pose.

    InputError where something is missing or short.
    """
    files, given, ev = read_cameras(folder)
    names = [file.name for file in files]
    note = order_note(names, llff_places(names))
    rows = []
    for number, pose in enumerate(range(0, len(ev) // NUM_EXPOSURES, 2)):
        rows.append(NUM_EXPOSURES * pose + TRAINED[number % len(TRAINED)])
    pictures = [
        Picture(source_of(folder, files[row]), float(number), ev=ev[row])
        for number, row in enumerate(rows)
    ]
    return Capture(
        layout="HDR-NeRF (real)",
        root=folder,
        pictures=pictures,
        poses=select_poses(given, rows),
        has_held_out=len(ev) > NUM_EXPOSURES,
        is_static=True,
        notes=() if note is None else (note,),
    )


def held_out_rows(count: int) -> list[range]:
    """The rows of the exposures of each held-out pose, of `count` rows."""
    starts = range(NUM_EXPOSURES, count, 2 * NUM_EXPOSURES)
    return [range(start, start + NUM_EXPOSURES) for start in starts]


def read_cameras(folder: Path) -> tuple[list[Path], GivenPoses, list[float]]:
    """All pictures in order, and the camera and the EV of each."""
    path = folder / NAME
    table = llff_table(path, 18)
    seconds = table[:, 17]
    if len(table) % NUM_EXPOSURES:
        raise InputError(
            f"{path}: {len(table)} rows, but every pose has {NUM_EXPOSURES}, one per exposure; "
            "copy the file again"
        )
    if not (np.isfinite(seconds).all() and (seconds > 0).all()):
        raise InputError(
            f"{path}: an exposure time in its last column is not above 0; copy the file again"
        )
    files = picture_files(folder, len(table))
    table = table[llff_places([file.name for file in files])]
    return files, llff_rows(table[:, :17]), np.log2(table[:, 17]).tolist()


def picture_files(folder: Path, count: int) -> list[Path]:
    """All pictures in order; InputError where there are not `count`."""
    place = folder / PICTURES
    files = frame_files(place) if place.is_dir() else []
    if len(files) != count:
        raise InputError(
            f"{place}: {len(files)} pictures, but {NAME} holds the cameras and exposures of "
            f"{count}; copy both again"
        )
    return files
