"""Video: frames in and out through PyAV, which is imported when it is needed.

Frames are rgb (H, W, 3) in [0, 1]. Reading checks and refuses in one sentence
(`InputError`); writing is atomic, H.264 with Rec. 709 tags.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic
from hdr_nsff.core.picture_size import check_size

DEFAULT_FPS = 24.0  # where a video's header names no rate
# of the aspect of pixels from 1; the nearest one in use is 16:15 (PAL)
MAX_ROUNDED_ASPECT = 0.01
FRAMES_FOR_INTERLACING = 8  # that are looked at: telecined film marks some of its frames
REC709_TAG = 1  # the code of Rec. 709 in H.264's color description, all four fields


def write_video(
    path: Path | str,
    frames: Iterable[np.ndarray],
    fps: float = DEFAULT_FPS,
    crf: int = 16,
    footage: bool = False,
) -> int:
    """Write rgb frames (H, W, 3) in [0, 1] as H.264 MP4, atomically; their number.

    8 bits, Rec. 709 tags, fast start. `footage` keeps the color of every pixel (4:4:4)
    and the grain: for video to be measured, browsers do not play it. Odd sizes lose
    their last row or column (4:2:0 needs even ones), so pictures have at least 2 pixels
    a side.
    """
    import av

    count = 0
    pixels = "yuv444p" if footage else "yuv420p"
    options = {"crf": str(crf)}
    if footage:
        options |= {"tune": "grain", "preset": "slow"}
    with (
        atomic(path) as temporary,
        av.open(str(temporary), "w", options={"movflags": "+faststart"}) as container,
    ):
        stream: Any = None
        for frame in frames:
            height = frame.shape[0] // 2 * 2
            width = frame.shape[1] // 2 * 2
            if stream is None:
                rate = Fraction(fps).limit_denominator(1001)
                stream = container.add_stream("libx264", rate=rate, options=options)
                stream.width, stream.height = width, height
                stream.pix_fmt = pixels
                tag_rec709(stream.codec_context)
            data = np.rint(np.clip(frame[:height, :width], 0, 1) * 255).astype(np.uint8)
            rgb = av.VideoFrame.from_ndarray(np.ascontiguousarray(data), format="rgb24")
            picture = rgb.reformat(format=pixels, dst_colorspace="ITU709", dst_color_range="MPEG")
            tag_rec709(picture)
            container.mux(stream.encode(picture))
            count += 1
        if stream is None:
            raise InputError(f"{path}: no frames to write")
        container.mux(stream.encode())
    return count


def tag_rec709(target: Any) -> None:
    """Rec. 709 color tags on a codec context or a frame (players guess otherwise)."""
    target.colorspace = REC709_TAG
    target.color_range = REC709_TAG
    target.color_primaries = REC709_TAG
    target.color_trc = REC709_TAG


def open_video(path: Path | str) -> Any:
    """PyAV's container of a video to be read, in whatever encoding its titles are."""
    import av

    return av.open(str(path), metadata_errors="replace")


def read_video(path: Path | str) -> Iterator[tuple[np.ndarray, float]]:
    """Frames of a video as float32 rgb (H, W, 3) in [0, 1] with their time in seconds.

    Rotated, mirrored and with square pixels as the file says. InputError where nothing
    can be decoded.
    """
    import av

    path = Path(path)
    try:
        with open_video(path) as container:
            if not container.streams.video:
                raise InputError(f"{path}: no video stream in this file")
            aspect = pixel_aspect(container.streams.video[0])
            for frame in container.decode(video=0):
                deep = frame.format.components[0].bits > 8
                # not rgb48le: FFmpeg spoils its colors where the width is odd
                array = frame.reformat(
                    format="gbrp16le" if deep else "rgb24", width=round(frame.width * aspect)
                ).to_ndarray()
                turned = turn(array, frame.rotation, is_mirrored(frame))
                top = np.float32(65535 if deep else 255)
                yield turned.astype(np.float32) / top, float(frame.time or 0.0)
    except (av.FFmpegError, OSError, UnicodeDecodeError) as error:
        raise unreadable(path, error) from error


def pixel_aspect(stream: Any) -> float:
    """Width of a pixel over its height: not 1 for anamorphic lenses and HDV. Frames are
    widened by it, as players show them, so that rows stay rows.

    Encoders that scale to whole pixels leave 408:407 and the like. That counts as 1:
    to widen 256 pixels to 257 would only blur them.
    """
    aspect = float(stream.sample_aspect_ratio or 1)
    return aspect if abs(aspect - 1) > MAX_ROUNDED_ASPECT else 1.0


def is_mirrored(frame: Any) -> bool:
    """Whether the display matrix of a frame mirrors it: its determinant is negative."""
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            a, b, _, c, d = struct.unpack("<5i", bytes(data)[:20])
            return a * d - b * c < 0
    return False


def turn(picture: np.ndarray, degrees: float, mirrored: bool) -> np.ndarray:
    """A picture (H, W, 3) as players show it: mirrored top to bottom, then turned
    counterclockwise, as FFmpeg takes display matrices apart.
    """
    upright = picture[::-1] if mirrored else picture
    return np.rot90(upright, round(degrees / 90))


@dataclass(frozen=True)
class VideoInfo:
    """What a video's header says."""

    frames: int  # 0: unknown, as where a header counts only the first fragment
    fps: float
    seconds: float  # of the picture; 0: unknown
    transfer: int = 2  # code of H.273: 16 PQ, 18 HLG, 2 unknown
    primaries: int = 2  # code of H.273: 1 Rec. 709, 9 BT.2020, 2 unknown
    bits: int = 8


def video_info(path: Path | str) -> VideoInfo:
    """The header of a video. InputError where the file is no video or cut short."""
    import av

    path = Path(path)
    try:
        with open_video(path) as container:
            if not container.streams.video:
                raise InputError(f"{path}: no video stream in this file")
            stream = container.streams.video[0]
            codec = stream.codec_context
            if codec is None:
                raise InputError(f"{path}: a video in an unknown format; convert it to H.264")
            check_size(path, round(codec.width * pixel_aspect(stream)), codec.height)
            end = max((entry.pos + entry.size for entry in stream.index_entries), default=0)
            if end > path.stat().st_size:  # decoders stop at the cut without a word
                raise InputError(f"{path}: the video is cut short; copy it again")
            seconds = duration_of(container, stream)
            pixels = codec.format
            in_fragments = len(stream.index_entries) > stream.frames
            hidden = sum(entry.is_discard for entry in stream.index_entries)  # by an edit list
            return VideoInfo(
                0 if in_fragments else stream.frames - hidden,
                float(stream.average_rate or DEFAULT_FPS),
                seconds,
                codec.color_trc,
                codec.color_primaries,
                pixels.components[0].bits if pixels is not None else 8,
            )
    except (av.FFmpegError, OSError, UnicodeDecodeError) as error:
        raise unreadable(path, error) from error


def is_interlaced(path: Path | str) -> bool:
    """Whether most of the first frames are marked as interlaced.

    False where none can be decoded: whoever reads the frames refuses the file.
    """
    import av

    try:
        with open_video(path) as container:
            first = list(islice(container.decode(video=0), FRAMES_FOR_INTERLACING))
    except (av.FFmpegError, OSError, UnicodeDecodeError):
        return False
    return sum(bool(frame.interlaced_frame) for frame in first) > len(first) / 2


def duration_of(container: Any, stream: Any) -> float:
    """Seconds of the picture; 0 where the file does not say."""
    if (
        stream.duration
        and stream.time_base
        and (found := float(stream.duration * stream.time_base))
    ):
        return found
    alone = len(container.streams) == 1  # else the sound may be what lasts longest
    if alone and container.duration:
        return container.duration / 1e6
    return 0.0


def unreadable(path: Path, error: Exception) -> InputError:
    """The sentence for a file that PyAV cannot read."""
    reason = getattr(error, "strerror", None) or type(error).__name__
    problem = f"not a readable video, or cut short ({reason})"
    return InputError(f"{path}: {problem}; check that it plays, or copy it again")


def frame_times(path: Path | str) -> np.ndarray:
    """Seconds (T,) at which the frames of a video are shown, in order; nothing is
    decoded. InputError where the file is no video.
    """
    return frame_spans(path)[:, 0]


def frame_spans(path: Path | str) -> np.ndarray:
    """Seconds (T, 2) from which and until which the frames are shown, as above."""
    import av

    path = Path(path)
    try:
        with open_video(path) as container:
            if not container.streams.video:
                raise InputError(f"{path}: no video stream in this file")
            found = [
                (float(p.pts * p.time_base), float((p.duration or 0) * p.time_base))
                for p in container.demux(video=0)
                if p.pts is not None and not p.is_discard
            ]
    except (av.FFmpegError, OSError, UnicodeDecodeError) as error:
        raise unreadable(path, error) from error
    starts, lengths = np.array(sorted(found)).reshape(-1, 2).T
    return np.stack([starts, starts + lengths], -1)
