"""The step `response`: which footage shows the noise of the sensor, and the white
balance that a camera wrote down.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_frame_colors import CYCLE, slow_balance
from test_frame_exposures import NUM, drifting_views
from wall import EV, S_CURVE

from hdr_nsff.core.images import write_png
from hdr_nsff.core.video import write_video
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.footage.gpmf import GoProFrames
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.steps.response import find_response, shows_noise
from hdr_nsff.prepare.work import PrepareConfig, Work
from hdr_nsff.scene.manifest import FrameEntry, LensEntry, Manifest


@pytest.fixture
def work(tmp_path: Path) -> Work:
    """Footage of one PNG of 40 x 20 pixels, used in that size."""
    write_png(tmp_path / "clip" / "0.png", np.full((20, 40, 3), 0.5, np.float32))
    config = PrepareConfig(tmp_path / "clip", tmp_path / "scene")
    manifest = Manifest(source="clip", inputs={}, width=40, height=20)
    return Work(config, open_footage(tmp_path / "clip"), manifest)


def test_frames_that_are_kept_as_recorded_show_noise(work: Work) -> None:
    assert shows_noise(work)


def test_frames_that_were_shrunk_do_not(work: Work) -> None:
    work.manifest.width, work.manifest.height = 32, 16
    assert not shows_noise(work)


def test_frames_that_were_undistorted_do_not(work: Work) -> None:
    work.manifest.lens = {
        0: LensEntry(K=np.eye(3).tolist(), distortion=[-0.1, 0, 0, 0], width=40, height=20)
    }
    assert not shows_noise(work)


def test_frames_of_a_lossy_format_do_not(work: Work) -> None:
    name = work.footage.path / "0.jpg"
    assert not shows_noise(replace(work, footage=replace(work.footage, cameras=[[name]])))


def response_of(
    folder: Path, seen: np.ndarray, written: np.ndarray, monkeypatch: pytest.MonkeyPatch, **c: str
) -> StepResult:
    """The step on the wall, whose white balance is `seen` (NUM, 3) in the pixels and
    `written` by a GoPro, in stops.
    """
    write_video(folder / "clip.mp4", [np.zeros((16, 16, 3))] * NUM)
    ones = np.ones(NUM)
    monkeypatch.setattr(
        "hdr_nsff.prepare.exposures.read_gopro", lambda *_: GoProFrames(ones, ones, written)
    )
    frames = [
        FrameEntry(index=t, image=f"{t}.png", source=f"clip.mp4#{t}", time=t, bracket=t % 3)
        for t in range(NUM)
    ]
    m = Manifest(source="clip", width=64, height=48, frames=frames, bracket_ev=[*EV])
    m.reference_bracket = 2
    config = PrepareConfig(folder / "clip.mp4", folder / "scene", **c)  # type: ignore[arg-type]
    work = Work(config, open_footage(config.clip), m)
    return find_response(work, drifting_views(S_CURVE, seen, CYCLE))


def test_a_white_balance_that_is_written_down_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drift = slow_balance(0.3)
    gains = drift + np.array([0.9, 0.1, 0.8])  # the clip's own, and a gain of all channels
    result = response_of(tmp_path, drift, gains, monkeypatch)
    found = [result.frames["white_balance"][t] for t in range(NUM)]
    np.testing.assert_allclose(found, drift, atol=1e-4)
    assert "red by 0.60, blue by 0.60 stops by GoPro's metadata" in result.note
    assert "disagree" not in result.note and "do not show" not in result.note


def test_a_white_balance_that_the_pixels_contradict_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drift = slow_balance(0.3)
    still = response_of(tmp_path, 0 * drift, drift, monkeypatch)
    assert "which static points do not show" in still.note
    result = response_of(tmp_path, -drift, drift, monkeypatch)
    assert "with which the pixels disagree by up to 0." in result.note
    np.testing.assert_allclose(result.frames["white_balance"][3], drift[3], atol=1e-4)
    asked = response_of(tmp_path, -drift, drift, monkeypatch, exposures="auto")
    np.testing.assert_allclose(asked.frames["white_balance"][6], -drift[6], atol=0.1)


def test_a_white_balance_that_hardly_changes_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drift = slow_balance(0.04)
    result = response_of(tmp_path, drift, drift, monkeypatch)
    assert result.frames["white_balance"] == {} and "white balance" not in result.note
