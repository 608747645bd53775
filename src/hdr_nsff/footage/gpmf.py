"""Exposures that a GoPro wrote into its video: the track in General Purpose Metadata
Format (GPMF, https://github.com/gopro/gpmf-parser).

The track's packets are nested entries of a key of four letters, a type, the size of a
value, their number, and the values, padded to four bytes. `SHUT` holds exposure times
in seconds, `ISOE` the sensor's sensitivity, both once a frame. `WRGB` holds gains of
red, green and blue (white balance), ten times a second. The header holds settings in
the same format.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from hdr_nsff.core.video import open_video

HEADER_BYTES = 8
NESTED = 0  # the type of an entry that holds entries
TYPES = {b"f": ">f4", b"S": ">u2", b"L": ">u4", b"s": ">i2", b"l": ">i4"}
# of frames, by which their number may differ from that of the written exposures
MAX_MISSING_SHARE = 0.02
MAX_DEPTH = 16  # of entries in entries: cameras write four
MAX_BOX = 1 << 20  # bytes of settings: cameras write a few thousand


@dataclass(frozen=True)
class GoProFrames:
    """What a GoPro wrote of every frame of a video."""

    seconds: np.ndarray  # (T,) exposure time
    iso: np.ndarray  # (T,) of the sensor
    colors: np.ndarray | None = None  # (T, 3) log2 gains of red, green and blue

    @property
    def ev(self) -> np.ndarray:
        """log2 of (exposure time x ISO / 100), (T,)."""
        return np.log2(self.seconds) + np.log2(self.iso / 100)


def read_gopro(path: Path, num_frames: int) -> GoProFrames | None:
    """What a GoPro wrote of the `num_frames` frames of a video.

    None where the video has no such track, or one that does not fit its frames.
    """
    seconds: list[float] = []
    iso: list[float] = []
    gains: list[tuple[int, np.ndarray]] = []  # of a packet, from which frame on
    for packet in metadata_packets(path):
        first = len(seconds)
        for key, values in entries(packet):
            if key == b"SHUT":
                seconds += values.tolist()
            elif key == b"ISOE":
                iso += values.tolist()
            elif key == b"WRGB":
                gains.append((first, values[: len(values) // 3 * 3].reshape(-1, 3)))
    if not seconds or not all(0 < value < np.inf for value in seconds):
        return None
    if len(iso) != len(seconds) or not all(0 < value < np.inf for value in iso):
        iso = [100.0] * len(seconds)
    if abs(len(seconds) - num_frames) > max(1, MAX_MISSING_SHARE * num_frames):
        return None
    colors = frame_gains(gains, len(seconds), num_frames)
    return GoProFrames(per_frame(seconds, num_frames), per_frame(iso, num_frames), colors)


def frame_gains(
    gains: list[tuple[int, np.ndarray]], num_written: int, num_frames: int
) -> np.ndarray | None:
    """The log2 gains (num_frames, 3) of every frame between those that packets hold.

    `gains`: of a packet the number of its first frame, and gains (N, 3) at times evenly
    spaced up to the next packet's; `num_written` frames in all. None without gains, or
    with impossible ones.
    """
    if not any(len(values) for _, values in gains):
        return None
    ends = [first for first, _ in gains[1:]] + [num_written]
    at = np.concatenate(
        [
            np.linspace(first, end, len(values), endpoint=False)
            for (first, values), end in zip(gains, ends, strict=True)
        ]
    )
    known = np.concatenate([values for _, values in gains])
    if not ((known > 0) & (known < np.inf)).all():
        return None
    frames = np.arange(num_frames)
    return np.stack([np.interp(frames, at, np.log2(known[:, c])) for c in range(3)], -1)


def per_frame(values: list[float], num_frames: int) -> np.ndarray:
    """Written values for `num_frames` frames: the last one stays, surplus ones go."""
    missing = max(0, num_frames - len(values))
    return np.pad(np.array(values), (0, missing), mode="edge")[:num_frames]


def metadata_packets(path: Path) -> Iterator[bytes]:
    """The packets of a video's track of GPMF; none where it has none."""
    from av.error import FFmpegError

    try:
        with open_video(path) as container:
            tracks = [s for s in container.streams if "MET" in s.metadata.get("handler_name", "")]
            if tracks:
                yield from (bytes(packet) for packet in container.demux(tracks[0]))
    except (FFmpegError, OSError):
        return  # the frames were read: whatever is wrong with this track, they count


def entries(data: bytes) -> Iterator[tuple[bytes, np.ndarray]]:
    """Keys and values of all entries of numbers in a packet."""
    for key, kind, size, content in raw_entries(data):
        if kind in TYPES and size % np.dtype(TYPES[kind]).itemsize == 0:
            yield key, np.frombuffer(content, TYPES[kind]).astype(np.float64)


def raw_entries(data: bytes, depth: int = 0) -> Iterator[tuple[bytes, bytes, int, bytes]]:
    """Key, type, bytes a value and content of all entries, nested up to `MAX_DEPTH`.

    An entry that is cut short, as in a damaged file, ends its level.
    """
    start = 0
    while start + HEADER_BYTES <= len(data):
        key, kind, each = data[start : start + 4], data[start + 4 : start + 5], data[start + 5]
        size = each * int.from_bytes(data[start + 6 : start + HEADER_BYTES], "big")
        content = data[start + HEADER_BYTES : start + HEADER_BYTES + size]
        if len(content) < size:
            return
        if kind[0] != NESTED:
            yield key, kind, size, content
        elif depth < MAX_DEPTH:
            yield from raw_entries(content, depth + 1)
        start += HEADER_BYTES + -(-size // 4) * 4


def stabilized(path: Path) -> bool | None:
    """Whether a GoPro wrote into a video's header that its electronic stabilization was
    on (`EISE`); None where it wrote nothing of it.
    """
    try:
        with path.open("rb") as file:
            header = box(file, path.stat().st_size, b"moov", b"udta", b"GPMF")
    except OSError:
        return None
    for key, _, _, content in raw_entries(header):
        if key == b"EISE":
            return content[:1] == b"Y"
    return None


def box(file: BinaryIO, end: int, name: bytes, *inside: bytes) -> bytes:
    """The content of a box of an MP4 file, and of one `inside` it, up to `MAX_BOX`
    bytes; empty where there is none (ISO 14496-12, 4.2).

    Looks from where the file is read on, up to its byte `end`.
    """
    while file.tell() + 8 <= end:
        start = file.tell()
        size, kind = int.from_bytes(file.read(4), "big"), file.read(4)
        if size == 1:
            size = int.from_bytes(file.read(8), "big")
        last = end if size == 0 else start + size
        if not file.tell() <= last <= end:
            return b""
        if kind == name and inside:
            return box(file, last, *inside)
        if kind == name:
            return file.read(min(last - file.tell(), MAX_BOX))
        file.seek(last)
    return b""
