"""Footage read frame by frame, as recorded rgb in [0, 1].

Linear frames and HDR video are encoded like recordings (`linear_light.py`), bars are
cut off, and large frames are shrunk.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_origin
from hdr_nsff.core.video import VideoInfo, frame_spans, read_video, video_info
from hdr_nsff.footage.footage import TRANSFERS, Footage
from hdr_nsff.footage.linear_light import encode_light, encode_signal, linear_scale
from hdr_nsff.footage.still_frames import read_frame

REC2020_CODE = 9  # of H.273: BT.2020 primaries
MAX_FRAMES = 10**9  # more than any footage has
# frames that may be missing at the end of a video: containers round durations
MAX_MISSING_FRAMES = 3
# bits of a camera by their largest code in a 16-bit file, as `read_image` gives it
NARROW_BITS = {float(np.float32(2**b - 1) / np.float32(65535)): b for b in (10, 12, 14)}
# of one frame with that code, from which on they count as clipped (hand-chosen: in a
# dark frame of full range, one or two pixels are the brightest)
MIN_CLIPPED_PIXELS = 30


@dataclass(frozen=True)
class FootageFrame:
    """One decoded frame."""

    camera_id: int
    number: int  # position in its camera's footage, before any stride
    source: str  # file name relative to the footage; `#number` for a frame of a video
    rgb: np.ndarray  # (H, W, 3) float32 recorded, in [0, 1]
    track: int = 0  # of one camera that records several at the same times
    seconds: float | None = None  # when it is shown, of videos


def read_frames(
    footage: Footage, start: int, end: int | None, stride: int, max_size: int
) -> Iterator[FootageFrame]:
    """The chosen frames, camera by camera, at most `max_size` pixels on a side.

    InputError for unreadable or truncated files, frames of different sizes, negative,
    NaN or infinite radiance, and after the last frame of a camera for codes that leave
    bits of their files unused.
    """
    stop = end if end is not None else MAX_FRAMES  # headers may count too few frames
    chosen = range(start, stop, stride)
    scale = 1.0
    if footage.linear:
        for files in footage.cameras:
            check_origins(files[start:end:stride])
        scale = linear_scale([f for files in footage.cameras for f in files[start:end:stride]])
    first: tuple[str, int, int] | None = None  # name, height, width
    for line, files in enumerate(footage.cameras):
        camera_id, track = (0, line) if footage.same_camera else (line, 0)
        tops: list[tuple[float, int]] = []
        for number, source, image, seconds in decode(footage, files, chosen):
            h, w = image.shape[:2]
            first = first or (source, h, w)
            name, height, width = first
            if (h, w) != (height, width):
                raise InputError(
                    f"{source}: {w}x{h} pixels, but {name} has {width}x{height}; all frames "
                    f"must have one size: crop them to {min(w, width)}x{min(h, height)}"
                )
            if not footage.video and not footage.linear:
                tops.append(brightest(image))
            rgb = shrink(footage.bars.cut(image), max_size)
            if footage.linear:
                rgb = encode_light(rgb * scale)
            yield FootageFrame(camera_id, number, source, rgb, track, seconds)
        check_range(files, tops)


def brightest(image: np.ndarray) -> tuple[float, int]:
    """The largest value of a frame (H, W, 3), and how many of its pixels have it, which
    are counted where it is the largest code of narrow bits.
    """
    top = image.max()
    clipped = (image == top).any(-1).sum() if float(top) in NARROW_BITS else 0
    return float(top), int(clipped)


def check_origins(files: list[Path]) -> None:
    """InputError where the data window moves between EXR frames of a camera, whose
    pixels would be compared at the wrong places.
    """
    pictures = [path for path in files if path.suffix.lower() == ".exr"]
    origins = [read_origin(path) for path in pictures]
    for path, origin in zip(pictures, origins, strict=True):
        if origin != origins[0]:
            raise InputError(
                f"{path}: the data window begins at {origin}, that of {pictures[0].name} at "
                f"{origins[0]}; write all frames with one data window"
            )


def check_range(files: list[Path], tops: list[tuple[float, int]]) -> None:
    """InputError where 16-bit files of a camera hold 10, 12 or 14 bits: no pixel of any
    frame is above their largest code, and many of one frame have it, since they are
    clipped. `tops` are what `brightest` found.

    Codes of 8 bits, as values in [0, 1], are never these.
    """
    top, clipped = max(tops, default=(0.0, 0))
    if clipped < MIN_CLIPPED_PIXELS:
        return
    bits = NARROW_BITS[top]
    factor = 2 ** (16 - bits)
    raise InputError(
        f"{files[0].parent}: looks like {bits}-bit values in 16-bit files (none is above "
        f"{2**bits - 1}), so that clipped pixels would count as recorded; multiply all values "
        f"by {factor}, with ImageMagick on a copy: "
        f"`mogrify -evaluate multiply {factor} *{files[0].suffix}`"
    )


def decode(
    footage: Footage, files: list[Path], chosen: range
) -> Iterator[tuple[int, str, np.ndarray, float | None]]:
    """(number, source, image (H, W, 3), seconds) of the chosen frames of one camera."""
    if footage.video:
        for number, image, seconds in decode_video(files[0], chosen):
            yield number, footage.frame_name(files, number), image, seconds
        return
    for number, path in list(enumerate(files))[chosen.start : chosen.stop : chosen.step]:
        yield number, footage.frame_name(files, number), read_frame(path, footage.over), None


def decode_video(path: Path, chosen: range) -> Iterator[tuple[int, np.ndarray, float]]:
    """(number, image (H, W, 3), seconds) of the chosen frames of a video.

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
                image = encode_signal(image, transfer, info.primaries == REC2020_CODE)
            yield number, image, seconds
    if last + MAX_MISSING_FRAMES / info.fps < info.seconds and not is_whole(path, info, last):
        raise InputError(
            f"{path}: the video is cut short ({last:.1f} of {info.seconds:.1f} s can be read); "
            "copy it again"
        )


def is_whole(path: Path, info: VideoInfo, last: float) -> bool:
    """Whether a video that was read up to the second `last` is all there: what it shows
    last is shown until its end. Where the rate varies, a frame may be held long.
    """
    start, end = frame_spans(path).max(0, initial=0.0)
    allowed = MAX_MISSING_FRAMES / info.fps
    return bool(start <= last + allowed and info.seconds <= end + allowed)


def shrink(image: np.ndarray, max_size: int) -> np.ndarray:
    """`image` with its longest side at most `max_size` pixels, area-averaged."""
    h, w = image.shape[:2]
    factor = max_size / max(h, w)
    if factor >= 1:
        return image
    width = max(1, round(w * factor))
    height = max(1, round(h * factor))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
