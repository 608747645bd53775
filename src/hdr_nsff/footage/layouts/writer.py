"""What the writers of public layouts share: which scene, into which folder, file by
file. Pictures and maps that a layout takes as they are, are copied byte by byte.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic, read_npy
from hdr_nsff.footage.datasets.capture import Extra, ExtraFrame
from hdr_nsff.scene.manifest import FrameEntry, Manifest, inside
from hdr_nsff.scene.scene import Scene

NOTE = "hdr_nsff_export.json"


@dataclass(frozen=True)
class Source:
    """A whole scene folder."""

    folder: Path
    manifest: Manifest
    points: np.ndarray | None  # (P, 3) float32

    @staticmethod
    def open(folder: Path) -> Source:
        """Read and check a scene folder; InputError where it is not whole."""
        m = Scene.open(folder).manifest
        points = np.array(read_npy(inside(folder, m.points))) if m.points else None
        return Source(folder, m, points)

    def file(self, name: str) -> Path:
        """A file of the scene."""
        return inside(self.folder, name)

    def disparity(self, frame: FrameEntry) -> np.ndarray | None:
        """Disparity (H, W) half of a frame, if it has one."""
        return None if frame.disparity is None else np.array(read_npy(self.file(frame.disparity)))

    def extra(self, frames: dict[str, ExtraFrame]) -> Extra:
        """What no layout can say of the scene; `frames` by the names of their pictures."""
        m = self.manifest
        assert m.near is not None and m.far is not None, "`Scene.open` refuses this"
        return Extra(
            fps=m.fps,
            reference_bracket=m.reference_bracket,
            bracket_ev=m.bracket_ev or [None] * (1 + max(f.bracket for f in m.frames)),
            exposure_given=m.exposure_given,
            near=m.near,
            far=m.far,
            depth_kind=m.depth_kind,
            frames=frames,
        )


@dataclass(frozen=True)
class HeldOutPicture:
    """A view that is kept back, in the world of the scene."""

    name: str
    time: float  # in frames, may be fractional
    camera_id: int
    bracket: int
    K: np.ndarray  # (3, 3) pixels
    c2w: np.ndarray  # (3, 4)
    mask: Path | None  # PNG, moving = 255
    write: Callable[[Path], None]  # its picture, to a PNG


def claim(out: Path, layout: str, scene: Path) -> None:
    """Make `out` ready; what an earlier export left there is removed. InputError where
    it holds something else.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; --layout writes a folder, name another one")
    if out.is_dir() and any(out.iterdir()):
        if notes.read(out / NOTE, notes.Layout) is None:
            raise InputError(
                f"{out}: is there already and was not made by export; choose an empty or new folder"
            )
        for path in out.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != NOTE:
                path.unlink()
    notes.write(out / NOTE, notes.Layout(layout=layout, scene=str(scene)))


def copy(source: Path, target: Path) -> None:
    """Copy a file, atomically."""
    with atomic(target) as temporary:
        shutil.copyfile(source, temporary)


def z_depth(disparity: np.ndarray) -> np.ndarray:
    """Z-depth (H, W) float32 of a disparity (H, W); 0 where it is unknown."""
    d = disparity.astype(np.float32)
    return np.where(d > 0, 1 / np.where(d > 0, d, 1), 0).astype(np.float32)
