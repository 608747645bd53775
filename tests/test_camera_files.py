"""Tiny files of the kinds that phones and cameras write, and that naive readers break:
turned and mirrored pictures, deep color, HDR, a rate that varies, an edit list, rows of
two moments, a track of metadata.
"""

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from test_gpmf import packet
from test_video import write_interlaced

from hdr_nsff.check.file import describe_file
from hdr_nsff.core.hdr_video import write_hdr_video
from hdr_nsff.core.video import frame_times, read_video, write_video
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.footage.gpmf import read_gopro
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.maths.hdr_signal import hlg_oetf, pq_encode, ycbcr_planes

FLAT = np.full((32, 48, 3), 0.5)
TICK = Fraction(1, 1000)
# bytes from the letters "tkhd" of a track in MP4 to its display matrix
MATRIX_OFFSET = 44


def corner() -> np.ndarray:
    """A dark picture (32, 48, 3) whose corner at the top left is bright."""
    picture = np.full((32, 48, 3), 0.1)
    picture[:8, :8] = 0.9
    return picture


def with_matrix(path: Path, matrix: tuple[int, int, int, int]) -> Path:
    """A video whose pixels (x, y) are shown at (a x + c y, b x + d y) by its header."""
    write_video(path, [corner()] * 3)
    data = bytearray(path.read_bytes())
    a, b, c, d = (value << 16 for value in matrix)
    start = data.index(b"tkhd") + MATRIX_OFFSET
    data[start : start + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize(
    ("matrix", "size", "bright"),
    [
        ((1, 0, 0, 1), (32, 48), (0, 0)),
        ((0, 1, -1, 0), (48, 32), (0, -1)),  # a quarter clockwise: a phone held upright
        ((-1, 0, 0, -1), (32, 48), (-1, -1)),  # upside down
        ((0, -1, 1, 0), (48, 32), (-1, 0)),
        ((-1, 0, 0, 1), (32, 48), (0, -1)),  # mirrored: a front camera
        ((0, 1, 1, 0), (48, 32), (0, 0)),  # mirrored and turned
    ],
)
def test_turned_and_mirrored_video_is_read_as_it_is_shown(
    tmp_path: Path,
    matrix: tuple[int, int, int, int],
    size: tuple[int, int],
    bright: tuple[int, int],
) -> None:
    path = with_matrix(tmp_path / "a.mp4", matrix)
    frame = next(read_frames(open_footage(path), 0, None, 1, 4096)).rgb
    assert frame.shape[:2] == size
    corners = {(y, x): frame[y, x, 1] for y in (0, -1) for x in (0, -1)}
    assert max(corners, key=lambda place: corners[place]) == bright
    facts = describe_file(open_footage(path))
    assert (facts.height, facts.width) == size


@pytest.mark.parametrize(("transfer", "kind"), [("hlg", "HLG"), ("pq", "PQ")])
def test_deep_color_keeps_its_steps(tmp_path: Path, transfer: str, kind: str) -> None:
    """A ramp that has 20 to 40 codes in 10 bits, and 5 to 10 in 8."""
    light = np.tile(np.linspace(0.2, 0.25, 64)[None, :, None], (64, 1, 3))
    signal = pq_encode(1000 * light) if transfer == "pq" else hlg_oetf(light)
    path = tmp_path / "a.mp4"
    write_hdr_video(path, [ycbcr_planes(signal)] * 3, 24, transfer)  # type: ignore[arg-type]
    facts = describe_file(open_footage(path))
    assert facts.bits == 10 and facts.kind == kind
    row = next(read_frames(open_footage(path), 0, None, 1, 4096)).rgb[32, :, 1] ** 2.2
    assert np.abs(row - light[32, :, 1]).max() < 0.01
    assert len(set(np.round(row, 5))) > 14


def write_at(path: Path, ticks: list[int], **options: str) -> None:
    """Frames that are shown from these milliseconds on, brighter and brighter."""
    with av.open(str(path), "w", container_options=options) as container:
        stream = container.add_stream("libx264", rate=25, options={"bf": "0"})
        stream.height, stream.width, stream.pix_fmt = 32, 48, "yuv420p"
        stream.time_base = stream.codec_context.time_base = TICK
        for k, tick in enumerate(ticks):
            gray = np.full((32, 48, 3), 20 + 10 * k, np.uint8)
            frame = av.VideoFrame.from_ndarray(gray, format="rgb24")
            frame.pts, frame.time_base = tick, TICK
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_the_rate_of_a_video_may_vary(tmp_path: Path) -> None:
    ticks = np.cumsum([0, 20, 60, 20, 80, 20, 60, 20, 70]).tolist()
    write_at(tmp_path / "a.mp4", ticks)
    footage = open_footage(tmp_path / "a.mp4")
    seconds = [frame.seconds for frame in read_frames(footage, 0, None, 1, 4096)]
    assert seconds == pytest.approx(np.array(ticks) / 1000, abs=1e-3)
    facts = describe_file(footage)
    assert facts.interval_ms == (20, 80) and facts.missing == 0


def test_frames_that_an_edit_list_hides_are_not_read(tmp_path: Path) -> None:
    write_at(tmp_path / "a.mp4", [40 * k - 80 for k in range(8)], avoid_negative_ts="disabled")
    assert b"elst" in (tmp_path / "a.mp4").read_bytes()
    gray = [float(frame[16, 24, 1]) for frame, _ in read_video(tmp_path / "a.mp4")]
    assert len(gray) == 6 and gray[0] == pytest.approx(40 / 255, abs=0.02)
    assert describe_file(open_footage(tmp_path / "a.mp4")).frames == 6
    assert 25 * frame_times(tmp_path / "a.mp4") == pytest.approx(np.arange(6))


def test_rows_of_two_moments_are_known(tmp_path: Path) -> None:
    write_interlaced(tmp_path / "a.mpg", [FLAT] * 5)
    facts = describe_file(open_footage(tmp_path / "a.mpg"))
    assert facts.interlaced


def test_a_track_of_metadata_is_found_in_its_file(tmp_path: Path) -> None:
    seconds = [0.01, 0.02, 0.01, 0.02]
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.height, stream.width, stream.pix_fmt = 32, 48, "yuv420p"
        metadata = container.add_data_stream("bin_data")
        metadata.metadata["handler_name"], metadata.time_base = "GoPro MET", TICK
        for _ in seconds:
            gray = np.full((32, 48, 3), 90, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(gray, format="rgb24")))
        container.mux(stream.encode())
        written = av.Packet(packet(seconds, [100] * 4, [(1.0, 1.0, 2.0)]))
        written.stream, written.time_base = metadata, TICK
        written.pts, written.dts, written.duration = 0, 0, 160
        container.mux(written)
    found = read_gopro(tmp_path / "a.mp4", 4)
    assert found is not None and found.seconds == pytest.approx(seconds)
    assert found.colors is not None and found.colors[0, 2] == 1.0
    assert len(list(read_video(tmp_path / "a.mp4"))) == 4
