"""Tracks of one camera: which files are some."""

from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.footage.tracks import open_tracks


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
