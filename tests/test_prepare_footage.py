"""The steps of `prepare` that need the footage alone: what a scene knows after them."""

from pathlib import Path

import numpy as np
import pytest
from test_exposure_cycle import clip
from test_video import write_interlaced

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.prepare import exposures
from hdr_nsff.prepare.prepare import PrepareConfig
from hdr_nsff.prepare.steps.footage import exposure_step, frames_step
from hdr_nsff.prepare.steps.response import drift_of_frames
from hdr_nsff.prepare.work import Work
from hdr_nsff.scene.manifest import Manifest, StepRecord


def work_on(folder: Path, video: np.ndarray, **settings: object) -> Work:
    """Frames (T, H, W, 3) as footage, with its frames decoded."""
    for t, frame in enumerate(video):
        write_png(folder / f"clip/{t:03d}.png", frame)
    config = PrepareConfig(folder / "clip", folder / "scene", **settings)
    manifest = Manifest(source="clip", width=1, height=1)
    work = Work(config, open_footage(config.clip), manifest)
    frames_step(work)
    return work


def test_a_cycle_that_rises_and_falls_has_three_exposures(tmp_path: Path) -> None:
    work = work_on(tmp_path, clip([-2, 0, 2, 0], frames=20))
    assert exposure_step(work).note.startswith("cycle of 4, 3 exposures (brightness)")
    assert [f.bracket for f in work.manifest.frames] == [0, 1, 2, 1] * 5
    assert work.manifest.bracket_ev == [None] * 3


def test_a_list_and_the_brightness_find_the_same_brackets(tmp_path: Path) -> None:
    work = work_on(tmp_path, clip([0, 2, 0, -2], frames=20), ev="0,2,0,-2")
    assert exposure_step(work).note.startswith("cycle of 4, 3 exposures (flags)")
    assert [f.bracket for f in work.manifest.frames] == [0, 1, 0, 2] * 5
    evs = [f.ev or 0.0 for f in work.manifest.frames[:4]]  # relative to the best exposed one
    assert np.diff(evs).tolist() == [2, -2, -2]


def test_a_listed_cycle_is_known_in_a_clip_that_is_too_short_to_show_it(tmp_path: Path) -> None:
    work = work_on(tmp_path, clip([-2, 0, 2, 0], frames=7), ev="-2,0,2,0")
    exposure_step(work)
    assert work.manifest.cycle == 4


def test_the_frames_of_brackets_are_named_by_their_place_in_the_cycle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exposure_step(work_on(tmp_path, clip([0, 2, 0, -2], frames=20)))
    printed = " ".join(capsys.readouterr().err.split())
    assert "from dark to bright frame [3, 0, 1] of the cycle" in printed


@pytest.mark.parametrize(
    ("evs", "stride", "kept"), [([-2, 0, 2], 3, 2), ([-2, 0], 2, 1), ([-3, 0, 3, 0], 4, 3)]
)
def test_a_stride_that_leaves_one_exposure_of_a_cycle_is_named(
    evs: list[float], stride: int, kept: int, tmp_path: Path
) -> None:
    work = work_on(tmp_path, clip(evs, frames=40), stride=stride)
    (note, *_) = exposure_step(work).details["doubts"]
    assert f"--stride {stride} leaves frames of one exposure" in note
    assert f"a cycle of {len(evs)}: use --stride {kept}, which keeps all" in note
    other = work_on(tmp_path / "other", clip(evs, frames=40), stride=kept)
    assert not any("--stride" in doubt for doubt in exposure_step(other).details["doubts"])


def test_a_stride_through_a_clip_that_does_not_alternate_is_fine(tmp_path: Path) -> None:
    work = work_on(tmp_path, clip([0], frames=40), stride=3)
    assert not any("--stride" in doubt for doubt in exposure_step(work).details["doubts"])


def test_an_interlaced_video_is_named_with_the_way_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "my clip.mpg"
    write_interlaced(path, clip([0], frames=4))
    footage = open_footage(path)
    manifest = Manifest(source="clip", width=1, height=1)
    frames_step(Work(PrepareConfig(path, tmp_path / "scene"), footage, manifest))
    (sentence,) = [line for line in capsys.readouterr().err.splitlines() if "interlaced" in line]
    assert f"`ffmpeg -i '{path}' -vf bwdif=send_frame" in sentence


def test_exposures_beyond_all_light_are_one_sentence(tmp_path: Path) -> None:
    rows = "".join(f"{t:03d}.png,1e-{30 * (t % 3)}\n" for t in range(12))
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip/exposures.csv").write_text(f"file,exposure\n{rows}")
    work = work_on(tmp_path, clip([-2, 0, 2], frames=12))
    with pytest.raises(InputError, match=r"exposures\.csv, line 3: -99.66 EV"):
        exposure_step(work)


def test_a_list_of_drifting_exposures_gives_one_bracket_and_a_drift(tmp_path: Path) -> None:
    ev = np.linspace(-1, 1, 20)
    rows = "".join(f"{t:03d}.png,{e}\n" for t, e in enumerate(ev))
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip/exposures.csv").write_text(f"file,ev\n{rows}")
    work = work_on(tmp_path, clip([0], frames=20))
    result = exposure_step(work)
    frames, manifest = work.manifest.frames, work.manifest
    assert manifest.bracket_ev == [0.0] and manifest.exposure_given
    np.testing.assert_allclose([f.drift for f in frames], ev, atol=1e-9)
    assert result.details["drift_given"] and "drift" in result.details["doubts"][0]


def test_a_listed_alternation_with_drift_on_top_keeps_its_brackets(tmp_path: Path) -> None:
    drift = np.linspace(-0.5, 0.5, 20)
    ev = np.tile([-2.0, 0.0], 10) + drift
    rows = "".join(f"{t:03d}.png,{e}\n" for t, e in enumerate(ev))
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip/exposures.csv").write_text(f"file,ev\n{rows}")
    work = work_on(tmp_path, clip([-2, 0], frames=20))
    exposure_step(work)
    frames = work.manifest.frames
    assert [f.bracket for f in frames] == [0, 1] * 10
    found = [work.manifest.bracket_ev[f.bracket] + f.drift for f in frames]
    np.testing.assert_allclose(np.diff(found), np.diff(ev), atol=1e-9)


@pytest.mark.parametrize(
    ("recorded", "problem"),
    [([0, -2], "go the way the brightness goes"), ([0], "about equally bright")],
)
def test_a_list_with_drift_that_the_brightness_contradicts_is_reported(
    recorded: list[float], problem: str, tmp_path: Path
) -> None:
    ev = np.tile([-2.0, 0.0], 10) + np.linspace(-0.5, 0.5, 20)
    rows = "".join(f"{t:03d}.png,{e}\n" for t, e in enumerate(ev))
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip/exposures.csv").write_text(f"file,ev\n{rows}")
    drift, doubt = exposure_step(work_on(tmp_path, clip(recorded, frames=20))).details["doubts"]
    assert "drift" in drift and problem in doubt


def test_the_exposures_of_synchronized_cameras_drift_from_brackets_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As two GoPros write them, the second two stops darker."""
    for camera in "ab":
        for t, frame in enumerate(clip([0], frames=20)):
            write_png(tmp_path / f"clip/{camera}/{t:03d}.png", frame)
    config = PrepareConfig(tmp_path / "clip", tmp_path / "scene")
    manifest = Manifest(source="clip", width=1, height=1)
    work = Work(config, open_footage(config.clip), manifest)
    frames_step(work)
    drift = np.linspace(-0.5, 0.5, 20)
    ev = [*(-8 + drift).tolist(), *(-10 - drift).tolist()]
    monkeypatch.setattr(exposures, "given_exposures", lambda work: (exposures.GOPRO, ev))
    result = exposure_step(work)
    frames = manifest.frames
    assert [f.bracket for f in frames] == [0] * 20 + [1] * 20
    np.testing.assert_allclose([f.drift for f in frames], [*drift, *-drift], atol=1e-9)
    manifest.steps["exposure"] = StepRecord(details=result.details)
    assert drift_of_frames(work, None) == {f.index: f.drift for f in frames}


def test_a_list_of_drifting_exposures_of_several_cameras_gives_one_bracket_each(
    tmp_path: Path,
) -> None:
    rows = ["file,ev"]
    drift = np.linspace(-0.5, 0.5, 20)
    for camera in "ab":
        for t, frame in enumerate(clip([0], frames=20)):
            write_png(tmp_path / f"clip/{camera}/{t:03d}.png", frame)
            rows.append(f"{camera}/{t:03d}.png,{drift[t] - 2 * (camera == 'b')}")
    (tmp_path / "clip/exposures.csv").write_text("\n".join(rows))
    config = PrepareConfig(tmp_path / "clip", tmp_path / "scene")
    work = Work(config, open_footage(config.clip), Manifest(source="clip", width=1, height=1))
    frames_step(work)
    exposure_step(work)
    assert [f.bracket for f in work.manifest.frames] == [0] * 20 + [1] * 20
    assert np.ptp(work.manifest.bracket_ev) == pytest.approx(2)
    np.testing.assert_allclose([f.drift for f in work.manifest.frames], [*drift, *drift])


def test_a_mask_of_another_size_is_named_with_the_way_out(tmp_path: Path) -> None:
    work = work_on(tmp_path, np.full((6, 24, 32, 3), 0.5, np.float32), ev="0,2")
    exposure_step(work)
    for f in work.manifest.frames:
        f.mask = f"masks/{f.index}.png"
        write_png(work.folder / f.mask, np.zeros((24, 32 + (f.index == 4), 3)))
    with pytest.raises(InputError, match=r"4\.png: the mask is 33x24, the frames are 32x24.*redo"):
        _ = work.masks


def test_frames_that_are_black_or_white_all_over_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video = clip([-2, 0], frames=12)
    work_on(tmp_path / "whole", video)
    assert "all over" not in capsys.readouterr().err
    video[:3], video[11] = 0, 1
    work_on(tmp_path / "faded", video)
    said = capsys.readouterr().err
    assert "of 12 frames, counted from 0, 0-2 black all over and 11 white all over" in said
