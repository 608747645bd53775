"""HDR-NeRF's real scenes: still, five exposures of every pose, one after the other in
`input_images/`, and a row for every picture in `poses_bounds_exps.npy` (N, 18): LLFF's
3x5 matrix (columns down, right, back), near and far, exposure time in seconds.

Every second pose is trained on, the first one too, the others are held out with all
five exposures: their protocol. As in the synthetic scenes, one picture per training
pose counts, of the first, third and fifth exposure in turn (they draw it at random).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.datasets.capture import Capture, Picture, reorder, source_of
from hdr_nsff.footage.datasets.hdr_nerf import COUNT, TRAINED
from hdr_nsff.footage.ingest import frame_files
from hdr_nsff.footage.pose_formats import GivenPoses, llff_rows, llff_table

NAME = "poses_bounds_exps.npy"
PICTURES = "input_images"


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout."""
    return (folder / NAME).is_file()


def read(folder: Path) -> Capture:
    """One picture of every training pose; InputError where something is missing or
    short.
    """
    given, ev = rows(folder)
    files = pictures(folder, len(ev))
    poses = range(0, len(ev) // COUNT, 2)
    chosen = [COUNT * pose + TRAINED[k % len(TRAINED)] for k, pose in enumerate(poses)]
    return Capture(
        layout="HDR-NeRF (real)",
        root=folder,
        pictures=[
            Picture(source_of(folder, files[row]), float(k), ev=ev[row])
            for k, row in enumerate(chosen)
        ],
        poses=reorder(given, chosen),
        withheld=len(ev) > COUNT,
        still=True,
    )


def held_out_rows(count: int) -> list[range]:
    """The rows of the exposures of each held-out pose, of `count` rows."""
    return [range(COUNT * pose, COUNT * (pose + 1)) for pose in range(1, count // COUNT, 2)]


def rows(folder: Path) -> tuple[GivenPoses, list[float]]:
    """Camera and EV of every picture."""
    path = folder / NAME
    table = llff_table(path, 18)
    seconds = table[:, 17]
    if len(table) % COUNT:
        raise InputError(
            f"{path}: {len(table)} rows, but every pose has {COUNT}, one per exposure; copy the file again"
        )
    if not (np.isfinite(seconds).all() and (seconds > 0).all()):
        raise InputError(
            f"{path}: an exposure time in its last column is not above 0; copy the file again"
        )
    return llff_rows(table[:, :17]), np.log2(seconds).tolist()


def pictures(folder: Path, count: int) -> list[Path]:
    """All pictures in order."""
    place = folder / PICTURES
    files = frame_files(place) if place.is_dir() else []
    if len(files) != count:
        raise InputError(
            f"{place}: {len(files)} pictures, but {NAME} holds the cameras and exposures of {count}; copy both again"
        )
    return files
