"""HDR videos are decoded again: tags, light levels, codes of a patch and of a ramp."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import (
    ENCODERS,
    Codec,
    LightLevels,
    Planes,
    can_encode,
    check_encoder,
    timed,
    write_hdr_video,
)
from hdr_nsff.maths.hdr_signal import Transfer, encode, ycbcr_planes

W, H = 704, 64
kinds = pytest.mark.parametrize(
    ("codec", "transfer"), [("hevc", "pq"), ("hevc", "hlg"), ("av1", "pq"), ("av1", "hlg")]
)
transfers = pytest.mark.parametrize("transfer", ["pq", "hlg"])


def ramp(transfer: Transfer, full_chroma: bool = False) -> Planes:
    """Diffuse white on the left, beside it a gray ramp from 0 to 1000 nits."""
    signal = np.zeros((H, W, 3))
    signal[:, :64] = encode(np.full(3, 203.0), transfer)
    top = encode(np.full(3, 1000.0), transfer)[0]
    signal[:, 64:] = np.linspace(0, top, W - 64)[:, None]
    return ycbcr_planes(signal, full_chroma)


def luma(frame: Any) -> np.ndarray:
    """Y codes (H, W) of a decoded frame."""
    return plane_codes(frame, 0)


def plane_codes(frame: Any, index: int) -> np.ndarray:
    """Codes (H, W) of a plane of a decoded frame."""
    plane = frame.planes[index]
    rows = np.frombuffer(plane, "<u2").reshape(-1, plane.line_size // 2)
    return rows[:, : plane.width].astype(int)


def decoded(path: Path) -> tuple[Any, list[Any]]:
    """Stream and frames of a video."""
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
        return container.streams.video[0], frames


@kinds
def test_tags_and_codes_are_read_back(tmp_path: Path, codec: Codec, transfer: Transfer) -> None:
    path = tmp_path / "a.mp4"
    planes = ramp(transfer)
    assert write_hdr_video(path, [planes] * 3, 24, transfer, codec) == 3
    stream, frames = decoded(path)
    context = stream.codec_context
    code = {"pq": 16, "hlg": 18}[transfer]
    assert context.codec_tag == {"hevc": "hvc1", "av1": "av01"}[codec]
    assert len(frames) == 3 and frames[0].format.name == "yuv420p10le"
    for tagged in (context, *frames):
        assert (tagged.color_primaries, tagged.color_trc) == (9, code)
        assert (tagged.colorspace, tagged.color_range) == (9, 1)
    seen = luma(frames[1])
    assert np.abs(seen[:, 8:56] - {"pq": 573, "hlg": 721}[transfer]).max() <= 2
    given = planes[0].astype(int)
    assert np.abs(seen[:, 72:] - given[:, 72:]).max() <= 8
    assert len(np.unique(seen[:, 64:])) >= 0.9 * len(np.unique(given[:, 64:]))  # no bands


@transfers
def test_prores_4444_keeps_tags_codes_and_sharp_chroma(tmp_path: Path, transfer: Transfer) -> None:
    path = tmp_path / "a.mov"
    planes = ramp(transfer, full_chroma=True)
    planes[1][:, 71::2] = 560  # columns of one pixel, which 4:2:0 would blur
    assert write_hdr_video(path, [planes] * 3, 24, transfer, "prores") == 3
    stream, frames = decoded(path)
    context = stream.codec_context
    assert (context.name, context.profile, context.codec_tag) == ("prores", "4444", "ap4h")
    assert len(frames) == 3 and frames[0].format.name == "yuv444p12le"  # as FFmpeg decodes it
    code = {"pq": 16, "hlg": 18}[transfer]
    for tagged in (context, *frames):
        assert (tagged.color_primaries, tagged.color_trc, tagged.colorspace) == (9, code, 9)
    seen = luma(frames[1]) / 4
    assert np.abs(seen[:, 8:56] - {"pq": 573, "hlg": 721}[transfer]).max() <= 2
    given = planes[0].astype(int)
    assert np.abs(seen[:, 72:] - given[:, 72:]).max() <= 4
    assert len(np.unique(np.rint(seen[:, 64:]))) >= 0.9 * len(np.unique(given[:, 64:]))
    blue = plane_codes(frames[1], 1) / 4
    assert np.abs(blue[:, 72:] - planes[1][:, 72:]).mean() < 2


@pytest.mark.parametrize("codec", ["hevc", "av1"])
def test_light_levels_of_hdr10_are_read_back(tmp_path: Path, codec: Codec) -> None:
    path = tmp_path / "a.mp4"
    write_hdr_video(path, [ramp("pq")] * 2, 24, "pq", codec, LightLevels(812.4, 97.6))
    side_data = {data.type.name: bytes(data) for data in decoded(path)[1][0].side_data}
    assert struct.unpack("<II", side_data["CONTENT_LIGHT_LEVEL"]) == (812, 98)
    assert "MASTERING_DISPLAY_METADATA" in side_data


def test_av1_above_240_frames_a_second_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    for fps in (240.5, 480.0, 960.0, 1000.0):
        with pytest.raises(InputError, match=f"{fps:g} frames a second; AV1 has at most 240"):
            write_hdr_video(path, [ramp("hlg")], fps, "hlg", "av1")
        assert not can_encode("av1", W, H, fps) and can_encode("hevc", W, H, fps)
    write_hdr_video(path, [ramp("hlg")] * 2, 240_000 / 1001, "hlg", "av1")
    assert decoded(path)[0].average_rate == Fraction(240_000, 1001)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_frames_of_short_and_fast_hevc_keep_their_times(tmp_path: Path, count: int) -> None:
    path = tmp_path / "a.mp4"
    write_hdr_video(path, [ramp("hlg")] * count, 960, "hlg", "hevc")
    stream, frames = decoded(path)
    assert [round(f.time * 960) for f in frames] == list(range(count))
    assert stream.duration * stream.time_base == Fraction(count, 960)


def test_times_of_decoding_that_x265_leaves_unset_are_filled_in() -> None:
    unset, early = av.Packet(b""), av.Packet(b"")
    unset.pts, unset.dts = 1, -144117387132666367  # as it was seen
    early.pts, early.dts = 5, -2  # a frame that is decoded before it is shown
    assert [packet.dts for packet in timed([unset, early])] == [1, -2]


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    with pytest.raises(InputError, match="no frames to write"):
        write_hdr_video(tmp_path / "a.mp4", [], 24, "pq")
    small = ycbcr_planes(np.zeros((8, 8, 3)))
    with pytest.raises(InputError, match="8 x 8 pixels; an HDR encoder takes at least 64"):
        write_hdr_video(tmp_path / "a.mp4", [small], 24, "pq")
    monkeypatch.setitem(ENCODERS, "hevc", "libnone")
    with pytest.raises(InputError, match="this PyAV has no encoder libnone"):
        check_encoder("hevc")
    assert not list(tmp_path.iterdir())
