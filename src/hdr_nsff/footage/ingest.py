"""Footage: a video, a folder of frames, or a folder of several of either (one per
synchronized camera), read frame by frame.

Frames come out as recorded rgb in [0, 1]. EXR and DNG are linear: they are scaled by
one constant for the whole footage and encoded as x^(1/2.2), so that what follows sees
one kind of recording. HLG and PQ video is brought there too, by its tags.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.exr import REC709, read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.core.io import SCENE_FILE
from hdr_nsff.core.picture_size import check_size
from hdr_nsff.core.video import read_video, video_info
from hdr_nsff.maths.hdr_signal import (
    PEAK_NITS,
    REC2020,
    Transfer,
    hlg_inverse_oetf,
    pq_decode,
    rgb_to_xyz,
)

RECORDED = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
LINEAR = {".exr", ".dng"}
FRAMES = RECORDED | LINEAR
VIDEOS = {".mp4", ".mov", ".mkv", ".m4v", ".avi", ".webm", ".mxf", ".mts"}
ACCEPTED = (
    "a video file, a folder of PNG, JPEG, TIFF, EXR or DNG frames, "
    "or a folder of such folders or videos (one per camera)"
)
LOSSY = {".jpg", ".jpeg"}  # formats of frames
TRANSFERS: dict[int, Transfer] = {16: "pq", 18: "hlg"}  # by their codes in H.273
REC2020_CODE = 9  # of H.273: BT.2020 primaries
GAMMA = 2.2  # linear footage is encoded as x^(1 / GAMMA)
WHITE_PERCENTILE = 99.9  # of linear radiance, becomes 1 (hand-chosen)
FOLDER_FPS = 24.0  # frames per second assumed for a folder of frames
MAX_FRAMES = 10**9  # more than any video without a frame count in its header has
# pixels: SSIM compares windows of this size (Wang et al. 2004), optical flow needs 9
MIN_SIDE = 11
MIN_MAX_SIZE = 32  # pixels: least longest side that frames may be shrunk to
# frames that may be missing at the end of a video: containers round durations
MAX_MISSING_FRAMES = 3
MAX_RATE_DIFFERENCE = 0.01  # of synchronized cameras: headers round the rate
HOLD_OUT = 8  # every this many frames are held out where nothing else is asked for


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
    """What a clip consists of; nothing is decoded yet."""

    path: Path
    cameras: list[list[Path]]  # per camera its frame files in order, or the one video file
    video: bool
    count: int  # frames per camera; 0 where a video's header has no count
    fps: float
    linear: bool  # EXR or DNG
    # gray that shows through transparent pixels; None: transparency is ignored
    over: float | None = None
    transfer: Transfer | None = None  # of HDR video, by its tags
    same_camera: bool = False  # the `cameras` are tracks of one (`tracks.py`)
    bars: Bars = Bars()  # that are cut off the frames

    @property
    def root(self) -> Path:
        """The folder that names of files are relative to."""
        return self.path if self.path.is_dir() else self.path.parent

    @property
    def files(self) -> dict[str, Path]:
        """Every file by its name relative to the footage."""
        return {f.relative_to(self.root).as_posix(): f for files in self.cameras for f in files}

    @property
    def lossless(self) -> bool:
        """Whether all frames are of formats that keep the noise of the sensor."""
        suffixes = {f.suffix.lower() for files in self.cameras for f in files}
        return not self.video and not suffixes & LOSSY


@dataclass(frozen=True)
class FootageFrame:
    """One decoded frame."""

    camera_id: int
    number: int  # position in its camera's footage, before any stride
    source: str  # file name relative to the footage; `#number` for a frame of a video
    rgb: np.ndarray  # (H, W, 3) float32 recorded, in [0, 1]
    track: int = 0  # of one camera that records several at the same times
    seconds: float | None = None  # when it is shown, of videos


# Which files


def open_footage(clip: Path) -> Footage:
    """The footage at `clip`.

    InputError where it is missing, empty, mixed or not understood.
    """
    if clip.is_file():
        return open_video(clip)
    if not clip.is_dir():
        raise InputError(f"{clip}: no such file or folder; give {ACCEPTED}")
    cameras = [frame_files(clip)]
    if not cameras[0]:
        cameras = [frame_files(f) for f in sorted_folders(clip) if not (f / SCENE_FILE).exists()]
        cameras = [files for files in cameras if files]
    if not cameras:
        return open_videos(clip)
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


def open_video(clip: Path) -> Footage:
    """The footage of a video file; InputError where it is none."""
    if clip.suffix.lower() in FRAMES:
        raise InputError(f"{clip}: a single frame is not footage; give {ACCEPTED}")
    if not clip.stat().st_size:
        raise InputError(f"{clip}: the file is empty; copy it again")
    info = video_info(clip)
    transfer = TRANSFERS.get(info.transfer)
    return Footage(clip, [[clip]], True, info.frames, info.fps, False, transfer=transfer)


def open_videos(folder: Path) -> Footage:
    """The footage of a folder of videos, one per synchronized camera.

    InputError without videos, and where they differ in length, rate or transfer
    function.
    """
    files = video_files(folder)
    if not files:
        raise InputError(f"{folder}: no frames and no videos in this folder; give {ACCEPTED}")
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


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """A key that sorts frame2 before frame10."""
    key = []
    for part in re.split(r"(\d+)", path.name):
        if part.isdecimal():  # not `isdigit`: ² is a digit, and no number
            key.append((0, int(part), ""))
        elif part:
            key.append((1, 0, part.lower()))
    return key


def frame_files(folder: Path) -> list[Path]:
    """The frames directly in `folder`, in order."""
    shown = [p for p in folder.iterdir() if not p.name.startswith(".")]
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


def hash_file(path: Path) -> str:
    """The sha256 of a file, in hexadecimal; InputError where it cannot be read."""
    if not path.is_file():  # pipes and devices may never end
        raise InputError(f"{path}: missing, or no ordinary file; copy it again")
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check its permissions, or copy it again"
        ) from error


# Settings


def check_choice(
    start: int, end: int | None, stride: int, max_size: int, hold_out: int | None
) -> None:
    """InputError for a choice of frames that makes no sense for any footage."""
    if start < 0 or stride < 1 or (end is not None and end <= start):
        last = "the end" if end is None else end
        raise InputError(
            f"frames {shorten(start)} to {shorten(last)} in steps of {shorten(stride)}: "
            "nothing to read; correct --start, --end, --stride"
        )
    if max_size < MIN_MAX_SIZE:
        raise InputError(f"--max-size {shorten(max_size)}: too small; use at least {MIN_MAX_SIZE}")
    if hold_out is not None and (hold_out < 0 or hold_out == 1):
        raise InputError(
            f"--hold-out {shorten(hold_out)}: leaves nothing to train on; use 0, or 2 and more"
        )


def check_frame_size(clip: Path, width: int, height: int) -> None:
    """InputError for frames that are too small to match or to compare."""
    if min(width, height) < MIN_SIDE:
        raise InputError(
            f"{clip}: frames are {width}x{height} pixels, at least {MIN_SIDE}x{MIN_SIDE} are "
            "needed; choose larger frames, or a larger --max-size"
        )


def check_number(option: str, value: float, least: float, most: float) -> None:
    """InputError for the value of an `option` that is not from `least` to `most`."""
    if not least <= value <= most:
        raise InputError(
            f"{option} {shorten(value)}: it must be a number from {least:g} to {most:g}"
        )


# Frames


def read_frames(
    footage: Footage, start: int, end: int | None, stride: int, max_size: int
) -> Iterator[FootageFrame]:
    """The chosen frames, camera by camera, at most `max_size` pixels on a side.

    InputError for unreadable or truncated files, frames of different sizes, and
    negative, NaN or infinite radiance.
    """
    stop = end if end is not None else (footage.count or MAX_FRAMES)
    chosen = range(start, stop, stride)
    scale = 1.0
    if footage.linear:
        scale = linear_scale([f for files in footage.cameras for f in files[start:end:stride]])
    first: tuple[str, int, int] | None = None  # name, height, width
    for line, files in enumerate(footage.cameras):
        camera_id, track = (0, line) if footage.same_camera else (line, 0)
        for number, source, image, seconds in decode(footage, files, chosen):
            h, w = image.shape[:2]
            first = first or (source, h, w)
            name, height, width = first
            if (h, w) != (height, width):
                raise InputError(
                    f"{source}: {w}x{h} pixels, but {name} has {width}x{height}; "
                    "all frames must have one size"
                )
            rgb = shrink(footage.bars.cut(image), max_size)
            if footage.linear:
                rgb = np.clip(rgb * scale, 0, 1) ** np.float32(1 / GAMMA)
            yield FootageFrame(camera_id, number, source, rgb, track, seconds)


def decode(
    footage: Footage, files: list[Path], chosen: range
) -> Iterator[tuple[int, str, np.ndarray, float | None]]:
    """(number, source, image (H, W, 3), seconds) of the chosen frames of one camera."""
    if footage.video:
        yield from decode_video(files[0], chosen)
        return
    for number, path in list(enumerate(files))[chosen.start : chosen.stop : chosen.step]:
        source = path.relative_to(footage.path).as_posix()
        yield number, source, read_frame(path, footage.over), None


def decode_video(path: Path, chosen: range) -> Iterator[tuple[int, str, np.ndarray, float]]:
    """(number, source, image (H, W, 3), seconds) of the chosen frames of a video.

    InputError where it ends before the duration in its header.
    """
    info = video_info(path)
    last = 0.0  # seconds
    for number, (image, seconds) in enumerate(read_video(path)):
        if number >= chosen.stop:
            return
        last = seconds
        if number in chosen:
            transfer = TRANSFERS.get(info.transfer)
            if transfer is not None:
                image = encode_light(image, transfer, info.primaries == REC2020_CODE)
            yield number, f"{path.name}#{number}", image, seconds
    if last + MAX_MISSING_FRAMES / info.fps < info.seconds:
        raise InputError(
            f"{path}: the video is cut short ({last:.1f} of {info.seconds:.1f} s can be read); "
            "copy it again"
        )


def encode_light(signal: np.ndarray, transfer: Transfer, rec2020: bool) -> np.ndarray:
    """HDR signals (H, W, 3) in [0, 1] as linear Rec. 709 light, encoded as x^(1/2.2).

    1 is the brightest scene light of HLG, and 1000 nits of PQ. Colors outside Rec. 709
    are clipped.
    """
    codes = np.rint(np.clip(signal, 0, 1) * 65535).astype(np.uint16)  # as decoded
    light = light_table(transfer)[codes]
    if rec2020:
        matrix = np.linalg.solve(rgb_to_xyz(REC709), rgb_to_xyz(REC2020))
        light = light @ matrix.T.astype(np.float32)
    return np.clip(light, 0, 1) ** np.float32(1 / GAMMA)


@functools.cache
def light_table(transfer: Transfer) -> np.ndarray:
    """Light (65536,) float32 of the signals of 16 bits, 1 is the peak."""
    signal = np.linspace(0, 1, 65536)
    light = pq_decode(signal) / PEAK_NITS if transfer == "pq" else hlg_inverse_oetf(signal)
    return light.astype(np.float32)


def read_frame(path: Path, over: float | None = None) -> np.ndarray:
    """One frame file as float32 (H, W, 3): recorded rgb, or linear for EXR and DNG.

    `over` is the gray that shows through transparent pixels.
    """
    suffix = path.suffix.lower()
    if suffix == ".dng":
        return read_dng(path)
    if suffix == ".exr":
        return read_linear_exr(path)
    return read_image(path, over)


def read_linear_exr(path: Path) -> np.ndarray:
    """Linear radiance (H, W, 3) of an EXR, gray or rgb; InputError below zero."""
    channels = read_exr(path)
    if "RGB" not in channels:
        if "Y" not in channels:
            found = shorten(", ".join(channels))
            raise InputError(
                f"{path}: no R, G, B channels (found {found}); write the picture as RGB"
            )
        return np.repeat(channels["Y"][..., None], 3, -1)
    if channels["RGB"].min() < 0:
        raise InputError(
            f"{path}: negative radiance; clip at zero or subtract the black level before "
            "writing the EXR"
        )
    return channels["RGB"]


def read_dng(path: Path) -> np.ndarray:
    """A raw photograph as linear rgb (H, W, 3), 1 where the sensor saturates.

    Daylight white balance, the same for every frame.
    """
    try:
        import rawpy
    except ImportError as error:
        raise InputError(
            f"{path}: DNG frames need rawpy; install it with `pip install rawpy`"
        ) from error
    try:
        with rawpy.imread(str(path)) as raw:
            check_size(path, raw.sizes.width, raw.sizes.height)
            image = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                output_bps=16,
                user_wb=[float(v) or 1.0 for v in raw.daylight_whitebalance],
            )
    except rawpy.LibRawError as error:
        raise InputError(f"{path}: not a readable DNG ({error!s}); copy it again") from error
    return image.astype(np.float32) / np.float32(65535)


def linear_scale(files: list[Path]) -> float:
    """The constant that brings linear frames into [0, 1].

    1 where nothing is brighter than 1, else 1 / the 99.9th percentile. The same for all
    frames, so that their exposures keep their ratios; what is brighter is saturated, as
    on a sensor.
    """
    images = [read_frame(f) for f in files]
    if not images or max(float(i.max()) for i in images) <= 1:
        return 1.0
    sampled = np.concatenate([i[::4, ::4].ravel() for i in images])
    white = float(np.percentile(sampled, WHITE_PERCENTILE))
    return 1 / max(white, 1e-12)


def shrink(image: np.ndarray, max_size: int) -> np.ndarray:
    """`image` with its longest side at most `max_size` pixels, area-averaged."""
    h, w = image.shape[:2]
    factor = max_size / max(h, w)
    if factor >= 1:
        return image
    width = max(1, round(w * factor))
    height = max(1, round(h * factor))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
