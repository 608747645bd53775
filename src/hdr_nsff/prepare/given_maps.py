"""Masks and depth maps that the user gives: one file per frame as recorded, in order.

They are checked as soon as the frames are known, before any step that takes long.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import mask_gray
from hdr_nsff.footage.depth_files import read_depth
from hdr_nsff.footage.frame_files import RECORDED, natural_key, sorted_folders
from hdr_nsff.prepare.lens import undistorted
from hdr_nsff.prepare.work import Work

DEPTH_FILES = {".npy", ".exr", ".png"}
ADVICE = "correct the files, or leave the option out to estimate them"


def check_given_maps(work: Work) -> None:
    """InputError where given masks or depth maps do not fit the frames."""
    if isinstance(work.config.masks, Path):
        user_masks(work, work.config.masks)
    if isinstance(work.config.depth, Path):
        size = (work.manifest.height, work.manifest.width)
        for path in depth_files(work, work.config.depth):
            read_depth(path, work.config.depth_kind, size)


def user_masks(work: Work, folder: Path) -> np.ndarray:
    """The moving masks (T, H, W) in the user's folder, undistorted like the frames."""
    m = work.manifest
    masks = []
    brightest = 0.0
    files = given_files(work, "--mask", folder, RECORDED)
    for f, path in zip(m.frames, files, strict=True):
        gray = mask_gray(path)
        mask, brightest = gray > 0.5, max(brightest, float(gray.max()))
        if mask.shape != (m.height, m.width):
            raise InputError(
                f"--mask {path}: the mask is {mask.shape[1]}x{mask.shape[0]}, "
                f"frame {f.index} is {m.width}x{m.height}; make it that size"
            )
        masks.append(undistorted(work, mask, f.camera_id))
    if 0 < brightest <= 0.5:
        raise InputError(
            f"--mask {folder}: no mask is white anywhere, the brightest pixel is "
            f"{255 * brightest:.3g} of 255; paint moving pixels white (255)"
        )
    return np.stack(masks)


def depth_files(work: Work, folder: Path) -> list[Path]:
    """The depth map of each frame in the user's folder."""
    return given_files(work, "--depth", folder, DEPTH_FILES)


def given_files(work: Work, option: str, folder: Path, suffixes: set[str]) -> list[Path]:
    """The file for each frame in the user's folder of maps: as many files as frames, in
    order (of each camera, in a folder like the footage's).
    """
    of_folder = {each: maps_in(each, suffixes) for each in map_folders(work, folder)}
    found = [path for own in of_folder.values() for path in own]
    count = len(work.manifest.frames)
    rows: Sequence[int] = range(count)
    if work.segment is not None:
        count, rows = work.segment.clip_frames, work.segment.rows
    if len(found) != count:
        raise InputError(
            f"{option} {folder}: {len(found)} maps for {count} frames{without_map(work, found)}; "
            f"one per used frame, in order; {ADVICE}"
        )
    counts = {each.name: len(own) for each, own in of_folder.items() if own}
    if work.capture is None and len(set(counts.values())) > 1:
        listed = " and ".join(f"{number} in {name}" for name, number in counts.items())
        raise InputError(
            f"{option} {folder}: {listed}; every camera needs one per used frame; {ADVICE}"
        )
    return [found[row] for row in rows]


def map_folders(work: Work, folder: Path) -> list[Path]:
    """The folders of maps, in the order of the cameras or tracks: by their names, else
    sorted as cameras are.
    """
    cameras = work.footage.cameras
    if len(cameras) == 1:
        return [folder]
    names = [own[0].stem if work.footage.video else own[0].parent.name for own in cameras]
    named = [folder / name for name in names]
    distinct = len(set(names)) == len(names)
    return named if distinct and all(each.is_dir() for each in named) else sorted_folders(folder)


def maps_in(folder: Path, suffixes: set[str]) -> list[Path]:
    """The maps directly in a folder, in order."""
    shown = [path for path in folder.iterdir() if not path.name.startswith(".")]
    return sorted((p for p in shown if p.suffix.lower() in suffixes), key=natural_key)


def without_map(work: Work, found: list[Path]) -> str:
    """The first frame that lacks a map, in words, where maps are named like frames."""
    names = {path.stem for path in found}
    sources = [Path(f.source) for f in work.manifest.frames]
    lacking = [source.name for source in sources if source.stem not in names]
    return f", none for {lacking[0]}" if 0 < len(lacking) < len(sources) else ""
