"""Footage: a video, a folder of frames, or a folder of such folders (one per
synchronized camera), read frame by frame.

Frames come out as recorded rgb in [0, 1]. EXR and DNG are linear; they are scaled by
one constant for the whole footage and encoded as x^(1/2.2), so that what follows sees
one kind of recording. Exposures come from EXIF or from a CSV beside the frames.
"""

from __future__ import annotations

import csv
import hashlib
import io
import logging
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_exr, read_image, read_video, video_info
from hdr_nsff.core.picture_size import check_size
from hdr_nsff.scene.scene import LARGEST_EV

RECORDED = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
LINEAR = {".exr", ".dng"}
FRAMES = RECORDED | LINEAR
ACCEPTED = "a video file, a folder of PNG, JPEG, TIFF, EXR or DNG frames, or a folder of such folders (one per camera)"
# pixels: SSIM compares windows of this size (Wang et al. 2004), optical flow needs 9
MIN_SIDE = 11
MIN_MAX_SIZE = 32  # pixels: least longest side that frames may be shrunk to


@dataclass(frozen=True)
class Footage:
    """What a clip consists of; nothing is decoded yet."""

    path: Path
    cameras: list[list[Path]]  # per camera its frame files in order, or the one video file
    video: bool
    count: int  # frames per camera; 0 where a video's header does not say
    fps: float
    linear: bool  # EXR or DNG
    # gray that shows through transparent pixels; None: transparency is not looked at
    over: float | None = None

    @property
    def files(self) -> dict[str, Path]:
        """Every file by its name relative to the footage."""
        root = self.path.parent if self.video else self.path
        return {f.relative_to(root).as_posix(): f for files in self.cameras for f in files}


@dataclass(frozen=True)
class FootageFrame:
    """One decoded frame."""

    camera_id: int
    number: int  # position in its camera's footage, before any stride
    source: str  # file name relative to the footage; `#number` for a frame of a video
    rgb: np.ndarray  # (H, W, 3) float32 recorded, in [0, 1]


def open_footage(clip: Path) -> Footage:
    """What there is to read at `clip`; InputError where it is missing, empty, mixed or
    not understood.
    """
    if clip.is_file():
        if clip.suffix.lower() in FRAMES:
            raise InputError(f"{clip}: one frame is no footage; give {ACCEPTED}")
        if not clip.stat().st_size:
            raise InputError(f"{clip}: the file is empty; copy it again")
        info = video_info(clip)
        return Footage(clip, [[clip]], True, info.frames, info.fps, False)
    if not clip.is_dir():
        raise InputError(f"{clip}: no such file or folder; give {ACCEPTED}")
    cameras = (
        [files]
        if (files := frame_files(clip))
        else [f for d in sorted_folders(clip) if (f := frame_files(d))]
    )
    if not cameras:
        raise InputError(f"{clip}: no frames in this folder; give {ACCEPTED}")
    for files in cameras[1:]:
        if len(files) != len(cameras[0]):
            raise InputError(
                f"{files[0].parent}: {len(files)} frames, but {cameras[0][0].parent} has {len(cameras[0])}; "
                "synchronized cameras need the same number of frames each"
            )
    linear = {f.suffix.lower() in LINEAR for files in cameras for f in files}
    if len(linear) > 1:
        raise InputError(
            f"{clip}: linear (EXR, DNG) and recorded (PNG, JPEG, TIFF) frames are mixed; keep one kind in the folder"
        )
    return Footage(clip, cameras, False, len(cameras[0]), 24.0, linear.pop())


def check_choice(
    start: int, end: int | None, stride: int, max_size: int, hold_out: int | None
) -> None:
    """InputError for a choice of frames that makes no sense whatever the footage is."""
    if start < 0 or stride < 1 or (end is not None and end <= start):
        last = "the end" if end is None else end
        raise InputError(
            f"frames {shorten(start)} to {shorten(last)} in steps of {shorten(stride)}: "
            "nothing to read; correct --start, --end, --stride"
        )
    if max_size < MIN_MAX_SIZE:
        raise InputError(
            f"--max-size {shorten(max_size)}: too small to find anything in; "
            f"use at least {MIN_MAX_SIZE}"
        )
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


def natural(path: Path) -> list[tuple[int, int, str]]:
    """A key that sorts frame2 before frame10."""
    return [
        (0, int(p), "") if p.isdecimal() else (1, 0, p.lower())
        for p in re.split(r"(\d+)", path.name)
        if p
    ]


def frame_files(folder: Path) -> list[Path]:
    """The frames directly in `folder`, in order."""
    found = [
        p
        for p in folder.iterdir()
        if p.suffix.lower() in FRAMES and not p.name.startswith(".") and p.is_file()
    ]
    return sorted(found, key=natural)


def sorted_folders(folder: Path) -> list[Path]:
    """The folders directly in `folder`, in order."""
    return sorted(
        (p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")), key=natural
    )


def hash_file(path: Path) -> str:
    """The sha256 of a file, in hexadecimal; InputError where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check its permissions, or copy it again"
        ) from error


def read_frames(
    footage: Footage, start: int, end: int | None, stride: int, max_size: int
) -> Iterator[FootageFrame]:
    """The chosen frames, camera by camera, shrunk so that the longest side is at most
    `max_size` pixels.

    InputError for unreadable or truncated files, frames of different sizes, and
    negative, NaN or infinite radiance.
    """
    chosen = range(start, end if end is not None else (footage.count or 10**9), stride)
    scale = (
        linear_scale([f for files in footage.cameras for f in files[start:end:stride]])
        if footage.linear
        else 1.0
    )
    first: tuple[str, tuple[int, ...]] | None = None
    for camera_id, files in enumerate(footage.cameras):
        for number, source, image in decode(footage, files, chosen):
            name, shape = first = first or (source, image.shape)
            if image.shape != shape:
                raise InputError(
                    f"{source}: {image.shape[1]}x{image.shape[0]} pixels, but {name} has {shape[1]}x{shape[0]}; all frames must have one size"
                )
            image = shrink(image, max_size)
            rgb = np.clip(image * scale, 0, 1) ** np.float32(1 / 2.2) if footage.linear else image
            yield FootageFrame(camera_id, number, source, rgb)


def decode(
    footage: Footage, files: list[Path], chosen: range
) -> Iterator[tuple[int, str, np.ndarray]]:
    """(number, source, image (H, W, 3)) of the chosen frames of one camera."""
    if footage.video:
        yield from decode_video(files[0], chosen)
        return
    for number in chosen[: len(files[chosen.start : chosen.stop : chosen.step])]:
        yield (
            number,
            files[number].relative_to(footage.path).as_posix(),
            read_frame(files[number], footage.over),
        )


def decode_video(path: Path, chosen: range) -> Iterator[tuple[int, str, np.ndarray]]:
    """(number, source, image (H, W, 3)) of the chosen frames; InputError where it ends
    before its header says.
    """
    info, last = video_info(path), 0.0
    for number, (image, seconds) in enumerate(read_video(path)):
        if number >= chosen.stop:
            return
        last = seconds
        if number in chosen:
            yield number, f"{path.name}#{number}", image
    if last + 3 / info.fps < info.seconds:
        raise InputError(
            f"{path}: the video is cut short ({last:.1f} of {info.seconds:.1f} s can be read); copy it again"
        )


def read_frame(path: Path, over: float | None = None) -> np.ndarray:
    """One frame file as float32 (H, W, 3): recorded rgb (`over` the gray that shows
    through it), or linear radiance for EXR and DNG.
    """
    suffix = path.suffix.lower()
    if suffix == ".dng":
        return read_dng(path)
    if suffix != ".exr":
        return read_image(path, over)
    channels = read_exr(path)
    if "RGB" not in channels:
        if "Y" not in channels:
            raise InputError(
                f"{path}: no R, G, B channels (found {', '.join(channels)}); write the picture as RGB"
            )
        return np.repeat(channels["Y"][..., None], 3, -1)
    if channels["RGB"].min() < 0:
        raise InputError(
            f"{path}: negative radiance; clip at zero or subtract the black level before writing the EXR"
        )
    return channels["RGB"]


def read_dng(path: Path) -> np.ndarray:
    """A raw photograph as linear rgb (H, W, 3), 1 where the sensor saturates; daylight
    white balance, the same for every frame.
    """
    try:
        import rawpy
    except ImportError as error:
        raise InputError(
            f"{path}: DNG frames need rawpy; install it with `pip install 'hdr-nsff[prepare]'`"
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
    """The constant that brings linear frames into [0, 1]: 1 where nothing is brighter
    than 1, else 1 / the 99.9th percentile.

    The same for all frames, so that their exposures keep their ratios; what is brighter
    is saturated, as on a sensor.
    """
    images = [read_frame(f) for f in files]
    if not images or max(float(i.max()) for i in images) <= 1:
        return 1.0
    return 1 / max(
        float(np.percentile(np.concatenate([i[::4, ::4].ravel() for i in images]), 99.9)), 1e-12
    )


def shrink(image: np.ndarray, max_size: int) -> np.ndarray:
    """`image` with its longest side at most `max_size` pixels, area-averaged."""
    h, w = image.shape[:2]
    factor = max_size / max(h, w)
    if factor >= 1:
        return image
    size = (max(1, round(w * factor)), max(1, round(h * factor)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


HOLD_OUT = 8  # every this many frames are kept out of training, where nobody says otherwise


def held_out(count: int, every: int, cycle: int) -> list[int]:
    """Which of `count` frames are kept out of training: every `every`-th, never the
    first or the last; none for 0.

    `every` grows until it has no common factor with the exposure cycle, so that all
    exposures are kept out in turn.
    """
    if every <= 0:
        return []
    while math.gcd(every, cycle) > 1:
        every += 1
    return list(range(every // 2, count - 1, every))


def every_of(frames: Sequence[int]) -> int | None:
    """The smallest `every` for which `held_out` keeps out just these `frames` of a clip
    that ends soon after them; None where there is none.
    """
    candidates = range(2, 2 * frames[0] + 2)
    return next(
        (every for every in candidates if held_out(frames[-1] + 2, every, 1) == list(frames)), None
    )


def between(count: int, cycle: int) -> list[int]:
    """Which of `count` frames are kept out of training by the protocol novel-view-time:
    every second one, never the first or the last.

    With an even exposure cycle every second frame would always show the same exposures:
    there, each cycle begins with the other half, so that of a cycle of 2 the frames 0,
    3, 4, 7, 8, ... are trained on.
    """
    phase = [k // cycle if cycle % 2 == 0 else 0 for k in range(count)]
    return [k for k in range(1, count - 1) if (k + phase[k]) % 2]


def parse_exposures(exposures: str | None, ev: str | None) -> list[float] | None:
    """The EV (log2 exposure) of each frame of one cycle from `--exposures 1/1000,1/250`
    (seconds) or `--ev -4,-2`, None for neither.
    """
    if exposures is None or exposures.strip() == "auto":
        if ev is None or ev.strip() == "auto":
            return None
        cycle = [number(v, "--ev") for v in ev.split(",")]
        for value in cycle:
            check_number("--ev", value, -LARGEST_EV, LARGEST_EV)
        return cycle
    if ev is not None:
        raise InputError("--exposures and --ev both given; leave one out")
    return [log2_seconds(v, "--exposures") for v in exposures.split(",")]


def number(text: str, where: str) -> float:
    """A finite number written as 2, -0.5 or 1/3; InputError saying `where` otherwise."""
    try:
        above, _, below = text.partition("/")
        value = float(above) / (float(below) if "/" in text else 1.0)
    except ZeroDivisionError as error:
        raise InputError(
            f"{where}: {text.strip()!r} divides by zero; write times like 1/250 and EV like -2"
        ) from error
    except ValueError as error:
        raise InputError(
            f"{where}: {text.strip()!r} is not a number; write times like 1/250 and EV like -2"
        ) from error
    if not math.isfinite(value):
        raise InputError(
            f"{where}: {text.strip()!r} is not finite; write times like 1/250 and EV like -2"
        )
    return value


def log2_seconds(text: str, where: str) -> float:
    """The EV of an exposure time in seconds."""
    seconds = number(text, where)
    if seconds <= 0:
        raise InputError(
            f"{where}: an exposure of {text.strip()} seconds cannot be; write times like 1/250"
        )
    return math.log2(seconds)


def read_exposure_csv(footage: Footage) -> tuple[Path, dict[str, float]] | None:
    """The CSV beside the frames and its EV by frame (`file name` or `#number`), None
    where there is none.

    Columns: `file` (or `frame`, a number from 0), and `exposure` (seconds) or `ev`.
    InputError that names the line of what is not understood.
    """
    path = footage.path.with_suffix(".csv") if footage.video else footage.path / "exposures.csv"
    if not path.is_file():
        return None
    reader = csv.DictReader(io.StringIO(read_utf8(path), newline=""), skipinitialspace=True)
    try:
        columns = reader.fieldnames or []
        name = next((c for c in ("file", "frame") if c in columns), None)
        value = next((c for c in ("exposure", "ev") if c in columns), None)
        if name is None or value is None:
            found = shorten(", ".join(columns)) or "none"
            raise InputError(
                f"{path}: its columns are {found}; it needs `file` or `frame`, "
                "and `exposure` (seconds) or `ev`, separated by commas"
            )
        rows = {}
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            check_cells(row, (name, value), where)
            key = row[name].strip()
            read = log2_seconds if value == "exposure" else number
            rows[f"#{key}" if name == "frame" else key] = read(row[value], where)
    except csv.Error as error:
        raise InputError(
            f"{path}, line {reader.line_num + 1}: no readable CSV ({error}); correct the line"
        ) from error
    return path, rows


def read_utf8(path: Path) -> str:
    """A text file, with or without a byte order mark; InputError that names the line
    where it is not UTF-8.
    """
    data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InputError(
            f"{path}, line {line}: not UTF-8 text; save the list as CSV UTF-8"
        ) from error


def check_cells(row: dict[str | Any, Any], columns: Sequence[str], where: str) -> None:
    """InputError where a row of a CSV has no cell in one of `columns`, or more cells than
    there are columns; empty ones at its end are passed over.
    """
    lost = next((c for c in columns if row[c] is None), None)
    if lost is not None:
        raise InputError(f"{where}: no value for column {shorten(lost)}; complete the line")
    if any(row.get(None, ())):
        raise InputError(
            f"{where}: more values than columns; separate values by commas, decimals by a point"
        )


def read_exif_ev(path: Path) -> float | None:
    """log2 of (exposure time x ISO / 100 / f-number^2) from a file's EXIF, None where
    it has no exposure time.
    """
    import exifread

    logging.getLogger("exifread").setLevel(logging.ERROR)  # it warns of every picture without EXIF
    try:
        with open(path, "rb") as file:
            tags = exifread.process_file(file, details=False)
    except Exception:  # damaged EXIF: many unrelated types, and no exposure time
        return None

    def value(name: str) -> float | None:
        tag = tags.get(name)
        try:
            return float(tag.values[0]) if tag is not None else None
        except (ArithmeticError, ValueError, TypeError, IndexError):
            return None

    seconds = value("EXIF ExposureTime") or 0.0
    iso, aperture = value("EXIF ISOSpeedRatings") or 100.0, value("EXIF FNumber") or 1.0
    exposure = seconds * iso / 100 / aperture**2
    return math.log2(exposure) if 0 < exposure < math.inf else None
