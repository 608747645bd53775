"""What the writers of public layouts share: the scene that they read, and the folder
that they write.

A layout is a table: the name of each file below the folder, and the function that
writes it. So everything is known, and checked, before anything is written. The folder
is made for other programs, which write beside the data: a note lists the files of the
export, exporting again replaces these, and all others stay. Pictures and maps that a
layout takes as they are, are copied byte by byte.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic, read_npy
from hdr_nsff.core.names import resolve_name
from hdr_nsff.core.progress import track
from hdr_nsff.footage.datasets.extra import Extra, ExtraFrame
from hdr_nsff.scene.manifest import FrameEntry, Manifest, inside
from hdr_nsff.scene.scene import Scene

NOTE = "hdr_nsff_export.json"
# name below the export's folder, with slashes -> what writes the file at a path
LayoutFiles = dict[str, Callable[[Path], None]]


@dataclass(frozen=True)
class Source:
    """A complete scene folder."""

    folder: Path
    manifest: Manifest
    points: np.ndarray | None  # (P, 3) float32, static, scene units

    @staticmethod
    def open(folder: Path) -> Source:
        """Read and check a scene folder; InputError where it is not complete."""
        manifest = Scene.open(folder).manifest
        points = None
        if manifest.points:
            points = np.array(read_npy(inside(folder, manifest.points)))
        return Source(folder, manifest, points)

    def file(self, name: str) -> Path:
        """The path of a file of the scene."""
        return inside(self.folder, name)

    def disparity(self, frame: FrameEntry) -> np.ndarray | None:
        """The disparity (H, W) half of a frame, in 1 / scene units, if it has one."""
        if frame.disparity is None:
            return None
        return np.array(read_npy(self.file(frame.disparity)))

    def extra(self, frames: dict[str, ExtraFrame]) -> Extra:
        """What no layout has a place for; `frames` by the names of their pictures."""
        m = self.manifest
        assert m.near is not None and m.far is not None, "`Scene.open` refuses this"
        brackets = 1 + max(f.bracket for f in m.frames)
        return Extra(
            fps=m.fps,
            reference_bracket=m.reference_bracket,
            bracket_ev=m.bracket_ev or [None] * brackets,
            exposure_given=m.exposure_given,
            near=m.near,
            far=m.far,
            depth_kind=m.depth_kind,
            frames=frames,
        )


@dataclass(frozen=True)
class HeldOutPicture:
    """A held-out view in the world of the scene."""

    name: str
    time: float  # in frames, may be fractional
    camera_id: int
    bracket: int
    K: np.ndarray  # (3, 3) pixels
    c2w: np.ndarray  # (3, 4)
    mask: Path | None  # PNG, moving = 255
    write: Callable[[Path], None]  # writes its picture to a PNG


def write_files(out: Path, layout: str, scene: Path, files: LayoutFiles) -> None:
    """Write the `files` of a layout into the folder `out`.

    Files of an earlier export there are removed, all others stay. InputError, before
    anything is changed, where `out` was not made by an export, or where another file
    stands at the place of one to write.
    """
    earlier = earlier_files(out)
    check_places(out, files, earlier)

    def note(names: Iterable[str]) -> None:
        made = notes.LayoutNote(layout=layout, scene=str(scene), files=sorted(names))
        notes.write(out / NOTE, made)

    note({*earlier, *files})  # holds also where this is killed half-way
    remove_files(out, earlier)
    for name, write in track(files.items(), "exporting"):
        write(out / name)
    note(files)


def earlier_files(out: Path) -> set[str]:
    """The names of the files that an earlier export wrote into `out`.

    InputError where it holds files and no export.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; --layout writes a folder, name another one")
    if not out.is_dir():
        return set()
    note = notes.read(out / NOTE, notes.LayoutNote)
    if note is not None:
        for name in note.files:
            resolve_name(out, name, "export")  # the note may have been edited
        return set(note.files)
    if any(not path.name.startswith(".") for path in out.iterdir()):
        raise InputError(
            f"{out}: already exists and was not made by export; choose an empty or new folder"
        )
    return set()


def check_places(out: Path, files: Iterable[str], earlier: set[str]) -> None:
    """InputError where another file stands in the place of one of `files`.

    Another is one that the `earlier` export did not write. Folders of files count too.
    """
    for name in files:
        resolve_name(out, name, "export")
        place = out / name
        blocked = place.is_dir() or (os.path.lexists(place) and name not in earlier)
        for folder in folders_of(name):
            if os.path.lexists(out / folder) and not (out / folder).is_dir():
                blocked = blocked or folder not in earlier
        if blocked:
            raise InputError(
                f"{place}: a file of the export, but something that the export did not write "
                "is in its place; move that away, or choose another folder"
            )


def remove_files(out: Path, names: Iterable[str]) -> None:
    """Remove the files `names` below `out`, and the folders that are empty then."""
    folders = set()
    for name in names:
        if not (out / name).is_dir():
            (out / name).unlink(missing_ok=True)
        folders.update(folders_of(name))
    for folder in sorted(folders, reverse=True):  # the inner ones first
        if (out / folder).is_dir() and not any((out / folder).iterdir()):
            (out / folder).rmdir()


def folders_of(name: str) -> list[str]:
    """The folders of a file: of a/b/c these are a/b and a."""
    return [folder.as_posix() for folder in PurePosixPath(name).parents][:-1]


def copy(source: Path, target: Path) -> None:
    """Copy a file, atomically."""
    with atomic(target) as temporary:
        shutil.copyfile(source, temporary)


def z_depth(disparity: np.ndarray) -> np.ndarray:
    """Z-depth (H, W) float32 of a disparity (H, W); 0 where it is unknown."""
    d = disparity.astype(np.float32)
    known = d > 0
    return np.where(known, 1 / np.where(known, d, 1), 0).astype(np.float32)
