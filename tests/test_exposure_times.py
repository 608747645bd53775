"""Exposure times of frames in seconds, and the time from frame to frame."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from test_exposure_cycle import clip

from hdr_nsff.core.video import write_video
from hdr_nsff.footage import gpmf
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.prepare.prepare import PrepareConfig
from hdr_nsff.prepare.steps.footage import exposure_step, frames_step
from hdr_nsff.prepare.work import Work
from hdr_nsff.scene.manifest import Manifest

EVS = [-2.0, 0.0]
FRAMES = 12


def prepared(folder: Path, footage: Path, **settings: object) -> Manifest:
    """The manifest of some footage after its exposures."""
    config = PrepareConfig(footage, folder / "scene", **settings)  # type: ignore[arg-type]
    work = Work(config, open_footage(footage), Manifest(source="clip", width=1, height=1))
    frames_step(work)
    exposure_step(work)
    return work.manifest


def stills(folder: Path, seconds: list[float] | None = None) -> Path:
    """JPEG frames at `EVS` in turn, with these exposure times in their EXIF."""
    folder.mkdir(parents=True, exist_ok=True)
    for t, frame in enumerate(clip(EVS, frames=FRAMES)):
        exif = Image.Exif()
        if seconds is not None:
            time = IFDRational(round(1e6 * seconds[t]), 10**6)
            exif.get_ifd(0x8769).update({0x829A: time, 0x8827: 400})
        picture = Image.fromarray(np.rint(255 * frame).astype(np.uint8))
        picture.save(folder / f"{t:03d}.jpg", exif=exif, quality=95)
    return folder


def listed(folder: Path, columns: str, rows: list[str]) -> Path:
    """Frames with a list beside them."""
    lines = [f"{t},{row}" for t, row in enumerate(rows)]
    stills(folder)
    (folder / "exposures.csv").write_text("\n".join([f"frame,{columns}", *lines]))
    return folder


def times(m: Manifest) -> list[float | None]:
    return [f.exposure_time for f in m.frames]


def test_a_list_of_times_and_gains_keeps_the_times_alone(tmp_path: Path) -> None:
    rows = ["4000,100", "4000,400"] * (FRAMES // 2)
    m = prepared(tmp_path, listed(tmp_path / "clip", "exposure_us,iso", rows))
    assert m.bracket_ev in ([-2.0, 0.0], [0.0, 2.0])  # ISO counts as exposure
    assert times(m) == pytest.approx([0.004] * FRAMES)  # and not as time


def test_a_list_of_ev_has_no_times(tmp_path: Path) -> None:
    m = prepared(tmp_path, listed(tmp_path / "clip", "ev", ["-2", "0"] * (FRAMES // 2)))
    assert times(m) == [None] * FRAMES


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"exposures": "1/400,1/100"}, [0.0025, 0.01]),
        ({"ev": "-2,0"}, [None, None]),
        ({"exposures": "auto"}, [None, None]),
        ({}, [0.001, 0.004]),
    ],
)
def test_times_come_from_where_exposures_come_from(
    tmp_path: Path, settings: dict[str, str], expected: list[float | None]
) -> None:
    footage = stills(tmp_path / "clip", [0.001, 0.004] * (FRAMES // 2))
    found = times(prepared(tmp_path, footage, **settings))
    assert found[:2] == pytest.approx(expected)
    assert found == pytest.approx(found[:2] * (FRAMES // 2))


def test_many_listed_times_are_kept(tmp_path: Path) -> None:
    seconds = [0.03, 0.015, 0.008, 0.004, 0.002, 0.001, 0.0005]  # too many for brackets
    write_video(tmp_path / "clip.mp4", list(clip([0.0], frames=FRAMES)), fps=50)
    m = prepared(tmp_path, tmp_path / "clip.mp4", exposures=",".join(map(str, seconds)))
    assert times(m)[:7] == pytest.approx(seconds)


def test_metadata_of_one_exposure_are_said_to_leave_it_to_the_brightness(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    m = prepared(tmp_path, stills(tmp_path / "clip", [0.01] * FRAMES))
    printed = " ".join(capsys.readouterr().err.split())
    assert "EXIF gives all frames one exposure; brightness decides instead" in printed
    assert m.cycle == 2 and not m.exposure_given


def test_a_small_drift_in_exif_is_a_drift(tmp_path: Path) -> None:
    seconds = np.linspace(0.01, 0.011, FRAMES)  # 0.14 EV
    m = prepared(tmp_path, stills(tmp_path / "clip", seconds.tolist()))
    assert m.exposure_given and m.bracket_ev == [0.0]
    expected = np.log2(seconds) - np.log2(seconds).mean()
    np.testing.assert_allclose([f.drift for f in m.frames], expected, atol=1e-3)


def test_metadata_that_the_brightness_refutes_have_no_times(tmp_path: Path) -> None:
    """As in stills of a video that all have the EXIF of the camera."""
    footage = stills(tmp_path / "clip", [0.01] * FRAMES)
    assert times(prepared(tmp_path, footage)) == [None] * FRAMES


def test_a_gopros_times_are_read_with_a_stride(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = np.linspace(0.001, 0.012, FRAMES)
    written = gpmf.GoProFrames(seconds, 1 / seconds)
    monkeypatch.setattr("hdr_nsff.prepare.exposures.read_gopro", lambda path, n: written)
    write_video(tmp_path / "clip.mp4", list(clip([0.0], frames=FRAMES)), fps=50)
    m = prepared(tmp_path, tmp_path / "clip.mp4", stride=2)
    assert times(m) == pytest.approx(seconds[::2].tolist())
    assert m.frame_seconds == pytest.approx(0.02) and m.stride == 2 and m.fps == 25


def test_timestamps_show_the_time_from_frame_to_frame_of_a_folder(tmp_path: Path) -> None:
    kept = [t for t in range(FRAMES + 1) if t != 5]  # one frame is missing
    rows = [f"0,{40_000_000 * t}" for t in kept]
    folder = listed(tmp_path / "clip", "ev,timestamp_ns", rows)
    assert prepared(tmp_path, folder).frame_seconds == pytest.approx(0.04)
    assert prepared(tmp_path / "b", folder, stride=2).frame_seconds == pytest.approx(0.04)
    (folder / "exposures.csv").unlink()
    assert prepared(tmp_path / "c", folder).frame_seconds is None
