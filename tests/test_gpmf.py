"""Exposures in a GoPro's metadata track."""

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdr_nsff.footage import gpmf


def entry(key: bytes, kind: bytes, size: int, content: bytes) -> bytes:
    """One entry of the format; `size` bytes a value."""
    count = len(content) // size
    head = key + kind + bytes([size]) + count.to_bytes(2, "big")
    return head + content + bytes(-len(content) % 4)


def packet(
    seconds: list[float], iso: list[int], gains: list[tuple[float, float, float]] | None = None
) -> bytes:
    """A packet as a camera writes it: a device with streams, one of a text."""
    shutter = entry(b"SHUT", b"f", 4, struct.pack(f">{len(seconds)}f", *seconds))
    sensor = entry(b"ISOE", b"S", 2, struct.pack(f">{len(iso)}H", *iso))
    streams = [entry(b"STNM", b"c", 1, b"Exposure time") + shutter, sensor]
    if gains is not None:
        content = b"".join(struct.pack(">3f", *rgb) for rgb in gains)
        streams.append(entry(b"WRGB", b"f", 12, content))
    return entry(b"DEVC", b"\0", 1, b"".join(entry(b"STRM", b"\0", 1, s) for s in streams))


@pytest.fixture
def track(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The packets of a video."""
    packets = [packet([1 / 100, 1 / 200, 1 / 400], [100, 100, 200]), packet([1 / 50], [100])]
    monkeypatch.setattr(gpmf, "metadata_packets", lambda path: iter(packets))
    return packets


def test_exposures_are_time_times_sensitivity(track: list[bytes]) -> None:
    found = gpmf.read_gopro(Path("clip.mp4"), 4)
    assert found is not None
    np.testing.assert_allclose(found.ev - found.ev[0], [0, -1, -1, 1], atol=1e-6)
    np.testing.assert_allclose(1 / found.seconds, [100, 200, 400, 50], rtol=1e-6)


def test_a_last_frame_without_exposure_takes_the_one_before(track: list[bytes]) -> None:
    found = gpmf.read_gopro(Path("clip.mp4"), 5)
    assert found is not None
    assert found.ev.shape == (5,) and found.ev[4] == found.ev[3]


def test_exposures_of_other_frames_are_not_taken(track: list[bytes]) -> None:
    assert gpmf.read_gopro(Path("clip.mp4"), 8) is None
    track[:] = [packet([], [])]
    assert gpmf.read_gopro(Path("clip.mp4"), 4) is None


def test_white_balance_lies_between_the_gains_that_are_written(track: list[bytes]) -> None:
    """Two gains in a packet of four frames, one in the next."""
    red = [(2.0, 1.0, 1.0), (4.0, 1.0, 1.0)]
    track[:] = [packet([0.01] * 4, [100] * 4, red), packet([0.01] * 2, [100] * 2, [(8.0, 1, 0.5)])]
    found = gpmf.read_gopro(Path("clip.mp4"), 6)
    assert found is not None and found.colors is not None
    np.testing.assert_allclose(found.colors[:, 0], [1, 1.5, 2, 2.5, 3, 3], atol=1e-6)
    np.testing.assert_allclose(found.colors[:, 2], [0, 0, 0, -0.5, -1, -1], atol=1e-6)


@pytest.mark.parametrize("gains", [None, [], [(0.0, 1.0, 1.0)], [(np.nan, 1.0, 1.0)]])
def test_impossible_gains_are_not_taken(track: list[bytes], gains: Any) -> None:
    track[:] = [packet([0.01] * 4, [100] * 4, gains)]
    found = gpmf.read_gopro(Path("clip.mp4"), 4)
    assert found is not None and found.colors is None


@pytest.mark.parametrize("seconds", [np.nan, np.inf, 0.0])
def test_impossible_exposures_are_not_taken(track: list[bytes], seconds: float) -> None:
    track[:] = [packet([0.01, seconds, 0.01, 0.01], [100] * 4)]
    assert gpmf.read_gopro(Path("clip.mp4"), 4) is None


def test_entries_are_read_to_a_depth_that_cameras_write() -> None:
    content = packet([0.01], [100])
    for _ in range(2000):
        content = entry(b"DEVC", b"\0", 1, content) if len(content) < 60_000 else content
    assert list(gpmf.entries(content)) == []


@given(st.binary(max_size=200), st.integers(0, 80))
def test_damaged_tracks_end_and_do_not_raise(noise: bytes, cut: int) -> None:
    whole = packet([0.01] * 3, [100] * 3)
    for data in (noise, whole[:cut] + noise, whole[cut:]):
        assert all(len(key) == 4 for key, _ in gpmf.entries(data))


def test_a_video_without_the_track_has_none(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"no video")
    assert gpmf.read_gopro(tmp_path / "clip.mp4", 3) is None


def mp4_box(name: bytes, content: bytes, wide: bool = False) -> bytes:
    """A box of an MP4 file, with a size of 32 or 64 bits."""
    if wide:
        return (1).to_bytes(4, "big") + name + (len(content) + 16).to_bytes(8, "big") + content
    return (len(content) + 8).to_bytes(4, "big") + name + content


def mp4_file(settings: bytes, wide: bool = False) -> bytes:
    """The boxes of a file that a GoPro writes around its settings."""
    user = mp4_box(b"udta", mp4_box(b"FIRM", b"H19") + mp4_box(b"GPMF", settings))
    header = mp4_box(b"mvhd", bytes(100)) + user
    return mp4_box(b"ftyp", b"mp41") + mp4_box(b"mdat", bytes(50), wide) + mp4_box(b"moov", header)


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize(("written", "expected"), [(b"Y", True), (b"N", False), (None, None)])
def test_stabilization_is_what_the_header_says(
    tmp_path: Path, written: bytes | None, expected: bool | None, wide: bool
) -> None:
    found = entry(b"DVNM", b"c", 1, b"Camera")
    if written is not None:
        found += entry(b"EISE", b"c", 1, written)
    (tmp_path / "clip.mp4").write_bytes(mp4_file(entry(b"DEVC", b"\0", 1, found), wide))
    assert gpmf.stabilized(tmp_path / "clip.mp4") is expected


@given(st.binary(max_size=60), st.integers(0, 260), st.booleans())
def test_damaged_headers_are_read_to_their_end(noise: bytes, cut: int, wide: bool) -> None:
    whole = mp4_file(entry(b"DEVC", b"\0", 1, entry(b"EISE", b"c", 1, b"Y")), wide)
    for data in (whole[:cut] + noise, whole[:cut] + noise + whole[cut:], whole[:cut]):
        found = gpmf.box(io.BytesIO(data), len(data), b"moov", b"udta", b"GPMF")
        assert len(found) <= len(data)


def test_a_video_without_settings_says_nothing_of_stabilization(tmp_path: Path) -> None:
    assert gpmf.stabilized(tmp_path / "absent.mp4") is None
    (tmp_path / "clip.mp4").write_bytes(b"no video")
    assert gpmf.stabilized(tmp_path / "clip.mp4") is None
