"""Videos: the frames and times that were written are read back."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.video import (
    frame_spans,
    frame_times,
    is_interlaced,
    is_mirrored,
    read_video,
    turn,
    video_info,
    write_video,
)
from hdr_nsff.footage.gpmf import read_gopro

FRAMES = [np.full((17, 33, 3), level) for level in (0.1, 0.5, 0.9)]


def write_interlaced(path: Path, frames: Sequence[np.ndarray]) -> None:
    """MPEG-2 whose frames are marked as interlaced."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg2video", rate=25, options={"flags": "+ildct+ilme"})
        stream.pix_fmt = "yuv420p"
        stream.height, stream.width = frames[0].shape[:2]
        for frame in frames:
            rgb = av.VideoFrame.from_ndarray(np.rint(frame * 255).astype(np.uint8), format="rgb24")
            container.mux(stream.encode(rgb.reformat(format="yuv420p")))
        container.mux(stream.encode())


def test_interlaced_video_is_known_by_its_marks(tmp_path: Path) -> None:
    write_interlaced(tmp_path / "a.mpg", [np.full((32, 48, 3), 0.5)] * 5)
    write_video(tmp_path / "b.mp4", FRAMES)
    (tmp_path / "c.mp4").write_bytes(b"no video")
    assert is_interlaced(tmp_path / "a.mpg")
    assert not is_interlaced(tmp_path / "b.mp4") and not is_interlaced(tmp_path / "c.mp4")


def test_frames_and_times_are_read_back_at_even_size(tmp_path: Path) -> None:
    assert write_video(tmp_path / "a.mp4", FRAMES, fps=12) == 3
    seen = list(read_video(tmp_path / "a.mp4"))
    assert [round(time * 12) for _, time in seen] == [0, 1, 2]
    for (frame, _), given in zip(seen, FRAMES, strict=True):
        assert frame.shape == (16, 32, 3) and np.abs(frame - given[:16, :32]).max() < 0.02


def test_the_header_names_frames_rate_and_length(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", FRAMES, fps=12)
    info = video_info(tmp_path / "a.mp4")
    assert (info.frames, info.fps) == (3, 12) and info.seconds == pytest.approx(0.25)


def test_frames_are_shown_until_the_next_ones(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", FRAMES, fps=12)
    spans = frame_spans(tmp_path / "a.mp4")
    assert 12 * spans == pytest.approx(np.array([[0, 1], [1, 2], [2, 3]]))
    assert np.array_equal(frame_times(tmp_path / "a.mp4"), spans[:, 0])


def test_no_frames_are_no_video(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no frames to write"):
        write_video(tmp_path / "a.mp4", [])
    assert not list(tmp_path.iterdir())


def test_videos_that_are_cut_short_or_none_are_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", FRAMES)
    (tmp_path / "a.mp4").write_bytes((tmp_path / "a.mp4").read_bytes()[:-100])
    with pytest.raises(InputError, match="the video is cut short"):
        video_info(tmp_path / "a.mp4")
    (tmp_path / "b.mp4").write_text("<html>")
    with pytest.raises(InputError, match="not a readable video"):
        list(read_video(tmp_path / "b.mp4"))


def test_a_title_in_another_encoding_is_no_damage(tmp_path: Path) -> None:
    """Old cameras and editors write titles in Latin-1."""
    with av.open(str(tmp_path / "a.avi"), "w") as container:
        container.metadata["title"] = "Pippi och Michel"
        stream = container.add_stream("mjpeg", rate=12)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuvj420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame(32, 16, "yuvj420p")))
        container.mux(stream.encode(None))
    data = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(data.replace(b"Pippi och", b"Pippi \xd3ch"))
    assert video_info(tmp_path / "a.avi").frames == 3
    assert len(list(read_video(tmp_path / "a.avi"))) == 3
    assert len(frame_times(tmp_path / "a.avi")) == 3
    assert read_gopro(tmp_path / "a.avi", 3) is None


def shown(path: Path, frame: np.ndarray, aspect: Fraction) -> np.ndarray:
    """A frame (H, W, 3) uint8, its pixels of this aspect, as a video of it is read."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24)
        stream.height, stream.width, stream.pix_fmt = *frame.shape[:2], "yuv444p"
        stream.codec_context.sample_aspect_ratio = aspect
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))
    return next(read_video(path))[0]


def test_pixels_that_are_not_square_are_widened_as_players_show_them(tmp_path):
    squeezed = np.zeros((48, 60, 3), np.uint8)
    squeezed[12:36, 15:45] = 255  # a square of 40 by 24 shown pixels
    picture = shown(tmp_path / "a.mp4", squeezed, Fraction(4, 3))
    assert picture.shape == (48, 80, 3)
    assert picture[24, :, 1].sum() == pytest.approx(40, abs=1)
    assert picture[:, 40, 1].sum() == pytest.approx(24, abs=1)


def test_pixels_that_are_square_but_for_rounding_are_not_resampled(tmp_path):
    stripes = np.zeros((48, 256, 3), np.uint8)
    stripes[:, ::2] = 255
    picture = shown(tmp_path / "a.mp4", stripes, Fraction(408, 407))
    assert picture.shape == (48, 256, 3)
    assert picture[:, ::2].min() > 0.9 and picture[:, 1::2].max() < 0.1


def test_deep_colors_stay_where_the_width_is_odd(tmp_path):
    """FFmpeg's packed 16-bit rgb of an odd width has wrong colors."""
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=24)
        stream.height, stream.width, stream.pix_fmt = 48, 61, "yuv420p10le"
        red = np.full((48, 61, 3), [200, 30, 30], np.uint8)
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(red, format="rgb24")))
        container.mux(stream.encode(None))
    picture = next(read_video(tmp_path / "a.mkv"))[0]
    assert picture.shape == (48, 61, 3)
    assert np.allclose(picture, np.array([200, 30, 30]) / 255, atol=0.02)


def test_mirrored_display_matrices_are_taken_apart_as_ffmpeg_does() -> None:
    """The matrix (0 1, 1 0) swaps x and y; FFmpeg calls that a turn by -90 degrees."""

    class DisplayMatrix(bytes):
        type = SimpleNamespace(name="DISPLAYMATRIX")

    picture = np.arange(2 * 3 * 3).reshape(2, 3, 3)
    for matrix, mirrored in (((0, 1, 0, 1, 0), True), ((0, 1, 0, -1, 0), False)):
        data = DisplayMatrix(struct.pack("<5i", *(65536 * x for x in matrix)))
        assert is_mirrored(SimpleNamespace(side_data=[data])) == mirrored
    assert np.array_equal(turn(picture, -90, True), picture.transpose(1, 0, 2))
    assert np.array_equal(turn(picture, -90, False), picture.transpose(1, 0, 2)[:, ::-1])
