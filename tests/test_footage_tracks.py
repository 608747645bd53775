"""Tracks of one camera: which files are some."""

from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.check.given import frame_names
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.core.video import write_video
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.footage.tracks import open_tracks
from hdr_nsff.prepare.check_lists import check_lists
from hdr_nsff.prepare.prepare import PrepareConfig


def write_track(folder: Path, count: int) -> None:
    for t in range(count):
        write_png(folder / f"{t:03d}.png", np.full((16, 16, 3), 0.1 * t))


def test_frames_of_two_tracks_are_those_of_one_camera(tmp_path: Path) -> None:
    write_track(tmp_path / "bright", 3)
    write_track(tmp_path / "dark", 3)
    footage = open_tracks(tmp_path, ("bright", "dark"))
    frames = list(read_frames(footage, 0, None, 1, 640))
    assert [(f.camera_id, f.track, f.number) for f in frames] == [
        *((0, 0, t) for t in range(3)),
        *((0, 1, t) for t in range(3)),
    ]
    assert frames[3].source == "dark/000.png" and "bright/002.png" in footage.files


def test_frames_of_videos_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    tracks = ("A/clip.mp4", "X/clip.mp4")
    for name in tracks:
        (tmp_path / name).parent.mkdir()
        write_video(tmp_path / name, [np.full((48, 64, 3), 0.5)] * 8, 24)
    rows = [f"{name}#{t},{-2 * k}" for k, name in enumerate(tracks) for t in range(8)]
    (tmp_path / "exposures.csv").write_text("\n".join(["file,ev", *rows]))
    footage = open_tracks(tmp_path, tracks)
    names = [f"{name}#{t}" for name in tracks for t in range(8)]
    assert [f.source for f in read_frames(footage, 0, None, 1, 640)] == names
    assert [name for c in (0, 1) for name in frame_names(footage, c, 8)] == names
    check_lists(PrepareConfig(tmp_path, tmp_path / "scene", same_camera=tracks), footage, None)


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        (("bright", "dim"), "no dim in"),
        (("bright", ".."), "no .. in"),
        (("bright", "bright"), "the same track twice"),
        (("bright", "short"), "bright has 3 frames and short has 2"),
    ],
)
def test_what_cannot_be_two_tracks_is_refused(
    tmp_path: Path, names: tuple[str, str], problem: str
) -> None:
    write_track(tmp_path / "bright", 3)
    write_track(tmp_path / "short", 2)
    with pytest.raises(InputError, match=problem):
        open_tracks(tmp_path, names)


def test_tracks_of_a_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"0")
    with pytest.raises(InputError, match="is no folder"):
        open_tracks(tmp_path / "clip.mp4", ("a", "b"))
