"""Which files of a folder are frames or videos, in the order of their numbers."""

from __future__ import annotations

import re
from pathlib import Path

RECORDED = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
LINEAR = {".exr", ".dng"}
FRAMES = RECORDED | LINEAR
LOSSY = {".jpg", ".jpeg"}  # formats of frames
CHECK_PICTURE = "_check.png"  # ends the name of what `check` writes, which is no frame
VIDEOS = {".mp4", ".mov", ".mkv", ".m4v", ".avi", ".webm", ".mxf", ".mts"}
# a name that is a time, whose last zeros may be missing
SECONDS = re.compile(r"\d{9,}\.\d+", re.ASCII)
# a number in a name; after a dot or an underscore, a minus is no separator but its sign
NUMBER = re.compile(r"((?:(?<=[._])-)?\d+)")
DECIMALS = 30  # more than names of times have


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """A key that sorts frame2 before frame10, frame.-2 before frame.-1, and seconds
    since 1970 as decimals.
    """
    name = path.name
    if SECONDS.fullmatch(path.stem):
        whole, fraction = path.stem.split(".")
        name = f"{whole}.{fraction.ljust(DECIMALS, '0')}{path.suffix}"
    key = []
    for part in NUMBER.split(name):
        if part.removeprefix("-").isdecimal():  # not `isdigit`: ² is a digit, and no number
            key.append((0, int(part), ""))
        elif part:
            key.append((1, 0, part.lower()))
    return key


def frame_files(folder: Path) -> list[Path]:
    """The frames directly in `folder`, in order."""
    shown = [p for p in folder.iterdir() if not p.name.startswith(".")]
    shown = [p for p in shown if not p.name.endswith(CHECK_PICTURE)]
    found = [p for p in shown if p.suffix.lower() in FRAMES and p.is_file()]
    return sorted(found, key=natural_key)


def video_files(folder: Path) -> list[Path]:
    """The videos directly in `folder`, in order."""
    shown = [p for p in folder.iterdir() if not p.name.startswith(".")]
    found = [p for p in shown if p.suffix.lower() in VIDEOS and p.is_file()]
    return sorted(found, key=natural_key)


def sorted_folders(folder: Path) -> list[Path]:
    """The folders directly in `folder`, in order."""
    shown = [p for p in folder.iterdir() if not p.name.startswith(".")]
    return sorted((p for p in shown if p.is_dir()), key=natural_key)
