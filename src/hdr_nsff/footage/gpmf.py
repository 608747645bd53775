"""Exposures that a GoPro wrote into its video: the track in General Purpose Metadata
Format (GPMF, https://github.com/gopro/gpmf-parser).

The track's packets are nested entries of a key of four letters, a type, the size of a
value, their number, and the values, padded to four bytes. `SHUT` holds exposure times
in seconds, `ISOE` the sensor's sensitivity, both once a frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdr_nsff.core.video import open_video

HEADER_BYTES = 8
NESTED = 0  # the type of an entry that holds entries
TYPES = {b"f": ">f4", b"S": ">u2", b"L": ">u4", b"s": ">i2", b"l": ">i4"}
# of frames, by which their number may differ from that of the written exposures
MAX_MISSING_SHARE = 0.02
MAX_DEPTH = 16  # of entries in entries: cameras write four


@dataclass(frozen=True)
class GoProFrames:
    """What a GoPro wrote of every frame of a video."""

    seconds: np.ndarray  # (T,) exposure time
    iso: np.ndarray  # (T,) of the sensor

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
    for packet in metadata_packets(path):
        for key, values in entries(packet):
            if key == b"SHUT":
                seconds += values.tolist()
            elif key == b"ISOE":
                iso += values.tolist()
    if not seconds or not all(0 < value < np.inf for value in seconds):
        return None
    if len(iso) != len(seconds) or not all(0 < value < np.inf for value in iso):
        iso = [100.0] * len(seconds)
    if abs(len(seconds) - num_frames) > max(1, MAX_MISSING_SHARE * num_frames):
        return None
    return GoProFrames(per_frame(seconds, num_frames), per_frame(iso, num_frames))


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


def entries(data: bytes, depth: int = 0) -> Iterator[tuple[bytes, np.ndarray]]:
    """Keys and values of all entries of numbers in a packet, nested up to `MAX_DEPTH`.

    An entry that is cut short, as in a damaged file, ends its level.
    """
    start = 0
    while start + HEADER_BYTES <= len(data):
        key, kind = data[start : start + 4], data[start + 4 : start + 5]
        size = data[start + 5] * int.from_bytes(data[start + 6 : start + HEADER_BYTES], "big")
        content = data[start + HEADER_BYTES : start + HEADER_BYTES + size]
        if len(content) < size:
            return
        if kind[0] == NESTED:
            if depth < MAX_DEPTH:
                yield from entries(content, depth + 1)
        elif kind in TYPES and size % np.dtype(TYPES[kind]).itemsize == 0:
            yield key, np.frombuffer(content, TYPES[kind]).astype(np.float64)
        start += HEADER_BYTES + -(-size // 4) * 4
