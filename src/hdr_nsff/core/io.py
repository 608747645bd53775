"""Files: PNG and TIFF images, OpenEXR, video, npy, json. Reading checks and says what
is wrong in one sentence (`InputError`); writing is atomic: a temporary file beside the
target, fsync, rename.
"""

from __future__ import annotations

import errno
import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.picture_size import check_size, encoded_size

SIDES = {
    1: "forward",
    -1: "backward",
}  # what channels of motion are called: to what is next, to what was before
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # chromaticities of R, G, B and white


@contextmanager
def atomic(path: Path | str) -> Iterator[Path]:
    """A temporary path beside `path` with the same suffix; renamed onto `path` once the
    block ends without an error.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=".partial-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
IMPOSSIBLE = (errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP)


@contextmanager
def writing_to(place: Path | str) -> Iterator[None]:
    """Turns a full disk, and a place that cannot or may not be read or written, into an
    InputError. What was complete stays; nothing is half-written.
    """
    try:
        yield
    except InputError:
        raise
    except UnicodeEncodeError as error:
        raise InputError(
            f"{place}: a file name that is no UTF-8 text ({error.object[:80]!r}); rename the file"
        ) from error
    except Exception as error:  # OpenEXR, FFmpeg and safetensors have types of their own for it
        if (sentence := about_the_disk(error, place)) is None:
            raise
        raise InputError(sentence) from error


def about_the_disk(error: Exception, place: Path | str) -> str | None:
    """What to say where the disk, not this program, is the cause of `error`; None for
    any other error.
    """
    code, text = (
        getattr(error, "errno", None),
        getattr(error, "strerror", None) or str(error).partition("\n")[0],
    )
    named = Path(getattr(error, "filename", None) or place)
    named = named.parent if named.name.startswith(".partial-") else named
    if code in FULL or any(m in str(error) for m in ("No space left", "File too large")):
        return f"{named}: the disk is full ({text}); free some space and run the same command again, it goes on where it was"
    if code in FORBIDDEN:
        return f"{named}: may not be read or written ({text}); check its permissions, or choose another place"
    if code in IMPOSSIBLE:
        return f"{str(named)[:200]}: cannot be read or written ({text}); mend the path, or choose another place"
    return None


def write_text(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8, atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path | str, value: Any) -> None:
    """Write `value` as readable JSON, atomically."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: Path | str) -> Any:
    """What a JSON file holds; ValueError where it holds none."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def write_npy(path: Path | str, array: np.ndarray) -> None:
    """Write an array, atomically."""
    buffer = BytesIO()  # numpy writing to a file itself forgets why it could not
    np.save(buffer, array, allow_pickle=False)
    with atomic(path) as temporary:
        temporary.write_bytes(
            buffer.getvalue()
        )  # not `getbuffer`: where writing fails, Python 3.12.1 crashes when it collects the view


def read_npy(path: Path | str) -> np.ndarray:
    """An array as it was written, memory-mapped, read-only."""
    try:
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError as error:
        raise InputError(f"{path}: missing; run `hdr-nsff prepare` again to make it") from error
    except (ValueError, EOFError, OSError) as error:
        raise InputError(
            f"{path}: not a readable .npy array ({error}); run `hdr-nsff prepare` with `--redo`"
        ) from error


def encode(path: Path | str, image: np.ndarray) -> None:
    """Write 8- or 16-bit (H, W) or (H, W, 3) RGB through OpenCV, atomically."""
    data = np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image)
    with atomic(path) as temporary:
        ok, buffer = cv2.imencode(Path(path).suffix, data)
        assert ok, f"could not encode {path}"
        temporary.write_bytes(buffer.tobytes())


def write_png(path: Path | str, rgb: np.ndarray, bits: int = 8) -> None:
    """Write `rgb` (H, W, 3) or (H, W) in [0, 1] (clipped here: a PNG is for looking at
    or a recorded image), or a bool mask.
    """
    if rgb.dtype == bool:
        encode(path, rgb.astype(np.uint8) * 255)
        return
    top = 2**bits - 1
    encode(path, np.rint(np.clip(rgb, 0, 1) * top).astype(np.uint8 if bits == 8 else np.uint16))


def read_image(path: Path | str, over: float | None = None) -> np.ndarray:
    """A PNG, JPEG or TIFF of 8 or 16 bits as float32 rgb (H, W, 3) in [0, 1]; `over` is
    the gray in [0, 1] that shows through transparent pixels (None: transparency is not
    looked at).
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such image; put it back or mend the name")
    raw = np.frombuffer(path.read_bytes(), np.uint8)
    if path.suffix.lower() == ".png" and not raw.tobytes().rstrip(b"\0").endswith(
        b"IEND\xaeB`\x82"
    ):
        raise InputError(f"{path}: the PNG is cut short; copy it again")
    if path.suffix.lower() in {".jpg", ".jpeg"} and b"\xff\xd9" not in raw[-64:].tobytes():
        raise InputError(f"{path}: the JPEG is cut short; copy it again")
    size = encoded_size(raw.tobytes())
    if size is not None:
        check_size(path, *size)
    try:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH if over is None else cv2.IMREAD_UNCHANGED
        image = cv2.imdecode(raw, flags) if size is not None else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{path}: not a readable image (PNG, JPEG or TIFF); copy it again")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"{path}: {image.dtype} pixels; convert to 8 or 16 bits, or to EXR for linear data"
        )
    top = 255 if image.dtype == np.uint8 else 65535
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, -1)
    rgb = np.ascontiguousarray(image[..., 2::-1]).astype(np.float32) / top
    if image.shape[2] < 4:
        return rgb
    alpha = image[..., 3:].astype(np.float32) / top
    return rgb * alpha + np.float32(over or 0.0) * (1 - alpha)


def read_mask(path: Path | str) -> np.ndarray:
    """A mask image as bool (H, W): true above half."""
    return read_image(path).mean(-1) > 0.5


def write_exr(
    path: Path | str,
    channels: dict[str, np.ndarray],
    header: dict[str, Any] | None = None,
    half: bool = True,
) -> None:
    """Write channels {name: (H, W)} or {"RGB": (H, W, 3)}, never clamped; depth `Z`
    stays 32-bit. NaN is an error.

    Header defaults: ZIP compression, Rec. 709 chromaticities. Extra keys (str, float)
    become attributes.
    """
    arrays = {}
    for name, array in channels.items():
        assert np.isfinite(array).all(), f"{path}: channel {name} holds NaN or Inf"
        kind = np.float16 if half and name != "Z" else np.float32
        with np.errstate(over="ignore"):
            data = np.ascontiguousarray(
                array, dtype=kind
            )  # OpenEXR writes wrong pixels for anything not contiguous
        if kind == np.float16 and np.isinf(data).any():
            data = np.ascontiguousarray(
                array, dtype=np.float32
            )  # beyond 65504: keep the radiance, not the size
        arrays[name] = data
    full = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": REC709,
        **(header or {}),
    }
    with atomic(path) as temporary, OpenEXR.File(full, arrays) as file:
        file.write(str(temporary))


@contextmanager
def silent() -> Iterator[None]:
    """Keeps what C libraries print of their own to stderr away from the terminal: the
    error that is raised says it.
    """
    with open(os.devnull, "wb") as nowhere:
        stderr = os.dup(2)
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


def read_exr(path: Path | str) -> dict[str, np.ndarray]:
    """Channels of an EXR as float32: {"RGB": (H, W, 3)} and {name: (H, W)} for the
    others. InputError for a file cut short, NaN or Inf.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with silent(), OpenEXR.File(str(path), header_only=True) as file:
            (left, top), (right, bottom) = file.header()["dataWindow"]
        check_size(path, int(right) - int(left) + 1, int(bottom) - int(top) + 1)
        with silent(), OpenEXR.File(str(path)) as file:
            if not file.parts:
                raise InputError(f"{path}: the EXR is cut short or damaged; copy it again")
            channels = {n: np.array(c.pixels, dtype=np.float32) for n, c in file.channels().items()}
    except InputError:
        raise
    except Exception as error:  # OpenEXR raises several unrelated types
        raise InputError(
            f"{path}: not a readable EXR ({str(error).partition(chr(10))[0] or type(error).__name__}); copy it again"
        ) from error
    if "RGB" not in channels and "RGBA" in channels:
        channels["RGB"] = np.ascontiguousarray(channels["RGBA"][..., :3])
    for name, array in channels.items():
        if not np.isfinite(array).all():
            raise InputError(
                f"{path}: channel {name} holds NaN or Inf; mend it in the program that wrote it"
            )
    return channels


def write_video(
    path: Path | str,
    frames: Iterable[np.ndarray],
    fps: float = 24.0,
    crf: int = 16,
    footage: bool = False,
) -> int:
    """Write rgb frames (H, W, 3) in [0, 1] as H.264 MP4 (8 bits, Rec. 709 tags, fast
    start), atomically; the number of frames written.

    `footage` keeps the color of every pixel (4:4:4) and the grain: for video to be
    measured, browsers do not play it. Odd sizes lose their last row or column (4:2:0
    needs even ones).
    """
    import av

    count = 0
    pixels = "yuv444p" if footage else "yuv420p"
    options = {"crf": str(crf)} | ({"tune": "grain", "preset": "slow"} if footage else {})
    with (
        atomic(path) as temporary,
        av.open(str(temporary), "w", options={"movflags": "+faststart"}) as container,
    ):
        stream: Any = None
        for frame in frames:
            h, w = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
            if stream is None:
                stream = container.add_stream(
                    "libx264", rate=Fraction(fps).limit_denominator(1001), options=options
                )
                stream.width, stream.height, stream.pix_fmt = w, h, pixels
                tag(stream.codec_context)
            data = np.rint(np.clip(frame[:h, :w], 0, 1) * 255).astype(np.uint8)
            picture = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(data), format="rgb24"
            ).reformat(format=pixels, dst_colorspace="ITU709", dst_color_range="MPEG")
            tag(picture)
            container.mux(stream.encode(picture))
            count += 1
        if stream is None:
            raise InputError(f"{path}: no frames to write")
        container.mux(stream.encode())
    return count


def tag(target: Any) -> None:
    """Rec. 709 color tags on a codec context or a frame (players guess otherwise)."""
    target.colorspace, target.color_range, target.color_primaries, target.color_trc = 1, 1, 1, 1


def read_video(path: Path | str) -> Iterator[tuple[np.ndarray, float]]:
    """Frames of a video as float32 rgb (H, W, 3) in [0, 1] with their time in seconds.
    InputError where nothing can be decoded.
    """
    import av

    path = Path(path)
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path}: no video stream in this file")
            for frame in container.decode(video=0):
                deep = frame.format.components[0].bits > 8
                array = np.rot90(
                    frame.to_ndarray(format="rgb48le" if deep else "rgb24"),
                    round(frame.rotation / 90),
                )
                yield (
                    array.astype(np.float32) / np.float32(65535 if deep else 255),
                    float(frame.time or 0.0),
                )
    except (av.FFmpegError, OSError, UnicodeDecodeError) as error:  # the last of its metadata
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise InputError(
            f"{path}: not a readable video, or cut short ({reason}); check that it plays, or copy it again"
        ) from error


@dataclass(frozen=True)
class VideoInfo:
    """What a video's header says."""

    frames: int  # 0: not said
    fps: float
    seconds: float  # of the picture; 0: not said


def video_info(path: Path | str) -> VideoInfo:
    """The header of a video. InputError where the file is no video or cut short."""
    import av

    path = Path(path)
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path}: no video stream in this file")
            stream = container.streams.video[0]
            if stream.codec_context is None:
                raise InputError(f"{path}: a video in an unknown format; convert it to H.264")
            check_size(path, stream.codec_context.width, stream.codec_context.height)
            end = max((entry.pos + entry.size for entry in stream.index_entries), default=0)
            if end > path.stat().st_size:  # decoders stop at the cut without a word
                raise InputError(f"{path}: the video is cut short; copy it again")
            alone = len(container.streams) == 1  # else the sound may be what lasts longest
            seconds = (
                float(stream.duration * stream.time_base)
                if stream.duration and stream.time_base
                else 0.0
            )
            if not seconds and alone and container.duration:
                seconds = container.duration / 1e6
            return VideoInfo(stream.frames, float(stream.average_rate or 24), seconds)
    except (av.FFmpegError, OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise InputError(
            f"{path}: not a readable video, or cut short ({reason}); check that it plays, or copy it again"
        ) from error


def contact_sheet(
    rows: list[list[np.ndarray]], gap: int = 4, background: float = 0.12
) -> np.ndarray:
    """One picture (H, W, 3) of a table of pictures; gray (H, W) ones become rgb, all
    cells take the size of the largest.
    """
    cells = [[c if c.ndim == 3 else np.repeat(c[..., None], 3, -1) for c in row] for row in rows]
    h = max(c.shape[0] for row in cells for c in row)
    w = max(c.shape[1] for row in cells for c in row)
    columns = max(len(row) for row in cells)
    sheet = np.full(
        (len(cells) * (h + gap) + gap, columns * (w + gap) + gap, 3), background, np.float32
    )
    for i, row in enumerate(cells):
        for j, cell in enumerate(row):
            y, x = gap + i * (h + gap), gap + j * (w + gap)
            sheet[y : y + cell.shape[0], x : x + cell.shape[1]] = cell
    return sheet


def colorize(
    values: np.ndarray,
    low: float | None = None,
    high: float | None = None,
    valid: np.ndarray | None = None,
) -> np.ndarray:
    """A scalar map (H, W) as rgb (H, W, 3) in [0, 1] through matplotlib's turbo, from
    percentiles 2 to 98 unless `low`, `high` are given.
    """
    import matplotlib

    known = values[valid] if valid is not None and valid.any() else values.reshape(-1)
    low = float(np.percentile(known, 2)) if low is None else low
    high = float(np.percentile(known, 98)) if high is None else high
    rgb = matplotlib.colormaps["turbo"](np.clip((values - low) / max(high - low, 1e-12), 0, 1))[
        ..., :3
    ].astype(np.float32)
    return rgb if valid is None else rgb * valid[..., None]


def colorize_flow(flow: np.ndarray, maximum: float | None = None) -> np.ndarray:
    """Optical flow (H, W, 2) px as rgb (H, W, 3): hue is direction, saturation is
    length up to `maximum` (98th percentile).
    """
    length = np.linalg.norm(flow, axis=-1)
    maximum = maximum or max(float(np.percentile(length, 98)), 1e-6)
    hue = (np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360).astype(np.float32)
    hsv = np.stack([hue, np.clip(length / maximum, 0, 1).astype(np.float32), np.ones_like(hue)], -1)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
