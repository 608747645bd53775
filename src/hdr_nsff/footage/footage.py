"""The footage at a path: a video, a folder of frames, or a folder of several of either
(one per synchronized camera). Nothing is decoded yet.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import SCENE_FILE, read_json
from hdr_nsff.core.video import is_interlaced, video_info
from hdr_nsff.footage.frame_files import (
    FRAMES,
    LINEAR,
    LOSSY,
    frame_files,
    sorted_folders,
    video_files,
)
from hdr_nsff.maths.hdr_signal import Transfer

ACCEPTED = (
    "a video file, a folder of PNG, JPEG, TIFF, EXR or DNG frames, "
    "or a folder of such folders or videos (one per camera)"
)
TaggedTransfer = Transfer | Literal["linear", "log100", "log316"]
# transfer functions that are undone, by their codes in H.273
TRANSFERS: dict[int, TaggedTransfer] = {
    8: "linear",
    9: "log100",
    10: "log316",
    16: "pq",
    18: "hlg",
}
TRANSFER_NAMES: dict[TaggedTransfer, str] = {
    "linear": "linear video",
    "log100": "log video (100:1)",
    "log316": "log video (316:1)",
    "pq": "PQ",
    "hlg": "HLG",
}
INTERLACED = "the video is interlaced: the odd and even rows of a frame show two moments"
FOLDER_FPS = 24.0  # frames per second assumed for a folder of frames
MAX_RATE_DIFFERENCE = 0.01  # of synchronized cameras: headers round the rate


@dataclass(frozen=True)
class Bars:
    """Black bars of equal width at opposite sides of the frames (`bars.py`), pixels."""

    rows: int = 0  # at the top, and as many at the bottom
    columns: int = 0  # at the left, and as many at the right

    def __bool__(self) -> bool:
        return self.rows > 0 or self.columns > 0

    def sentence(self) -> str:
        """What is cut off, in words."""
        sides = []
        if self.rows:
            sides.append(f"{self.rows} rows at the top and the bottom")
        if self.columns:
            sides.append(f"{self.columns} columns on the left and the right")
        return f"black bars are cut off: {' and '.join(sides)}"

    def cut(self, image: np.ndarray) -> np.ndarray:
        """An image (H, W, ...) without its bars."""
        height, width = image.shape[:2]
        return image[self.rows : height - self.rows, self.columns : width - self.columns]


@dataclass(frozen=True)
class Footage:
    """What a clip consists of."""

    path: Path
    cameras: list[list[Path]]  # per camera its frame files in order, or the one video file
    video: bool
    count: int  # frames per camera; 0 where a video's header has no count
    fps: float
    linear: bool  # EXR or DNG
    # gray that shows through transparent pixels; None: transparency is ignored
    over: float | None = None
    transfer: TaggedTransfer | None = None  # of HDR, log or linear video, by its tags
    same_camera: bool = False  # the `cameras` are tracks of one (`tracks.py`)
    bars: Bars = Bars()  # that are cut off the frames
    interlaced: bool = False  # of video, by the marks of its first frames

    @property
    def root(self) -> Path:
        """The folder that names of files are relative to."""
        return self.path if self.path.is_dir() else self.path.parent

    @property
    def files(self) -> dict[str, Path]:
        """Every file by its name relative to the footage."""
        return {f.relative_to(self.root).as_posix(): f for files in self.cameras for f in files}

    def frame_name(self, files: list[Path], number: int) -> str:
        """The name of a frame of the camera with `files`: that of its file, relative to
        the footage; `#number` follows for a frame of a video.
        """
        name = files[0 if self.video else number].relative_to(self.root).as_posix()
        return f"{name}#{number}" if self.video else name

    @property
    def lossless(self) -> bool:
        """Whether all frames are of formats that keep the noise of the sensor."""
        suffixes = {f.suffix.lower() for files in self.cameras for f in files}
        return not self.video and not suffixes & LOSSY

    def interlacing(self) -> str:
        """That a video is interlaced, and what to do, in words; "" where it is not."""
        clip = str(self.cameras[0][0])
        return f"{INTERLACED}; {deinterlacing(clip)}" if self.interlaced else ""


def deinterlacing(name: str) -> str:
    """What to do about an interlaced video, in words."""
    clip = shlex.quote(name)
    return f"deinterlace it first: `ffmpeg -i {clip} -vf bwdif=send_frame -crf 12 deinterlaced.mp4`"


def open_footage(clip: Path) -> Footage:
    """The footage at `clip`.

    InputError where it is missing, empty, mixed or not understood.
    """
    if clip.is_file():
        return open_video(clip)
    if not clip.is_dir():
        raise InputError(f"{clip}: no such file or folder; give {ACCEPTED}")
    if is_scene(clip):
        command = f"hdr-nsff train splat --scene {shlex.quote(str(clip))}"
        raise InputError(f"{clip}: is a prepared scene, no footage; train it with `{command}`")
    cameras = [frame_files(clip)]
    if not cameras[0]:
        if video_files(clip):
            return open_videos(clip)
        cameras = [frame_files(f) for f in sorted_folders(clip) if not (f / SCENE_FILE).exists()]
        cameras = [files for files in cameras if files]
    if not cameras:
        raise InputError(f"{clip}: no frames and no videos in this folder; give {ACCEPTED}")
    first = cameras[0]
    for files in cameras[1:]:
        if len(files) != len(first):
            raise InputError(
                f"{files[0].parent}: {len(files)} frames, but {first[0].parent} has "
                f"{len(first)}; synchronized cameras need the same number of frames each"
            )
    linear = {f.suffix.lower() in LINEAR for files in cameras for f in files}
    if len(linear) > 1:
        raise InputError(
            f"{clip}: linear (EXR, DNG) and recorded (PNG, JPEG, TIFF) frames are mixed; "
            "keep one kind in the folder"
        )
    return Footage(clip, cameras, False, len(first), FOLDER_FPS, linear.pop())


def is_scene(folder: Path) -> bool:
    """Whether a folder is a scene, as `prepare` writes it: data sets, too, may hold a
    file of that name.
    """
    try:
        document = read_json(folder / SCENE_FILE)
    except (OSError, ValueError):
        return False
    return isinstance(document, dict) and {"frames", "bracket_ev"} <= document.keys()


def open_video(clip: Path) -> Footage:
    """The footage of a video file; InputError where it is none."""
    if clip.suffix.lower() in FRAMES:
        raise InputError(f"{clip}: a single frame is not footage; give {ACCEPTED}")
    if not clip.stat().st_size:
        raise InputError(f"{clip}: the file is empty; copy it again")
    info = video_info(clip)
    transfer = TRANSFERS.get(info.transfer)
    footage = Footage(clip, [[clip]], True, info.frames, info.fps, False, transfer=transfer)
    return replace(footage, interlaced=is_interlaced(clip))


def open_videos(folder: Path) -> Footage:
    """The footage of a folder of videos, one per synchronized camera.

    InputError where they differ in length, rate or transfer function.
    """
    files = video_files(folder)
    first, *others = (open_video(file) for file in files)
    for other in others:
        names = f"{other.path}: {first.path.name} and this video"
        if other.count != first.count:
            raise InputError(
                f"{names} have {first.count} and {other.count} frames; synchronized cameras "
                "need the same number each, cut both to the same moments"
            )
        if abs(other.fps - first.fps) > MAX_RATE_DIFFERENCE * first.fps:
            raise InputError(
                f"{names} have {first.fps:.3g} and {other.fps:.3g} frames per second; "
                "synchronized cameras need one rate"
            )
        if other.transfer != first.transfer:
            raise InputError(
                f"{names} differ in their transfer functions by their tags; "
                "export both in one format"
            )
    return replace(first, path=folder, cameras=[[file] for file in files])
