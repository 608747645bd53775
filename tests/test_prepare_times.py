"""Clips from which frames are missing: brackets and times after the gap."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from test_exposure_cycle import clip
from test_ingest import write_held_video
from test_prepare_footage import work_on

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.prepare.prepare import PrepareConfig
from hdr_nsff.prepare.steps.footage import exposure_step, frames_step
from hdr_nsff.prepare.work import Work
from hdr_nsff.scene.manifest import Manifest, StepRecord

EVS = [-2, 0, 2]
KEPT = np.delete(np.arange(27), [10])
WITH_GAP = KEPT.astype(float).tolist()


def times(work: Work) -> list[float]:
    return [f.time for f in work.manifest.frames]


def brackets(work: Work) -> list[int]:
    return [f.bracket for f in work.manifest.frames]


def test_a_frame_that_is_missing_leaves_a_gap_and_the_cycle_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = work_on(tmp_path, clip(EVS, frames=27)[KEPT])
    exposure_step(work)
    assert brackets(work) == (KEPT % 3).tolist() and times(work) == WITH_GAP
    assert work.manifest.cycle == 3
    printed = " ".join(capsys.readouterr().err.split())
    assert "frames are missing before frame 10: the exposures skip a part" in printed
    exposure_step(work)  # once more, it is the same
    assert times(work) == WITH_GAP


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({5: "160000000"}, "the timestamp_ns of frame 005.png is not above that of frame 004.png"),
        ({5: "0"}, "the timestamp_ns of frame 005.png is not above that of frame 004.png"),
        ({5: None}, "frame 005.png has no timestamp_ns"),
    ],
)
def test_timestamps_that_show_no_times_are_named(
    change: dict[int, str | None],
    problem: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = {t: str(40_000_000 * t) for t in range(12)} | change
    lines = [f"{t:03d}.png,0,{ns}" for t, ns in rows.items() if ns is not None]
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip/exposures.csv").write_text("\n".join(["file,ev,timestamp_ns", *lines]))
    work = work_on(tmp_path, clip([0], frames=12))
    printed = " ".join(capsys.readouterr().err.split())
    assert f"frames: {problem}; all count as evenly spaced" in printed
    assert times(work) == list(range(12))


def test_a_rate_that_varies_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ms = np.cumsum([20, 50, 30, 90] * 3)
    lines = [f"{t:03d}.png,0,{time}000000" for t, time in enumerate(ms)]
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip/exposures.csv").write_text("\n".join(["file,ev,timestamp_ns", *lines]))
    work = work_on(tmp_path, clip([0], frames=12))
    printed = " ".join(capsys.readouterr().err.split())
    sentence = "frames: variable frame rate: 20 to 90 ms from frame to frame"
    assert f"{sentence}; all count as evenly spaced" in printed
    assert times(work) == list(range(12))


def test_without_a_gap_frames_are_evenly_spaced(tmp_path: Path) -> None:
    work = work_on(tmp_path, clip(EVS, frames=27))
    exposure_step(work)
    assert times(work) == list(range(27)) and brackets(work) == [0, 1, 2] * 9


def test_a_listed_cycle_goes_on_after_a_gap(tmp_path: Path) -> None:
    work = work_on(tmp_path, clip(EVS, frames=27)[KEPT], ev="-2,0,2")
    exposure_step(work)
    assert brackets(work) == (KEPT % 3).tolist() and times(work) == WITH_GAP
    steps = [f.ev for f in work.manifest.frames[9:12]]
    assert np.diff(np.array(steps, float)).tolist() == [4, -4]  # frames 9, 11, 12


def test_exposures_of_a_csv_show_a_gap_too(tmp_path: Path) -> None:
    rows = "".join(f"{i:03d}.png,{EVS[t % 3]}\n" for i, t in enumerate(KEPT))
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip/exposures.csv").write_text(f"file,ev\n{rows}")
    work = work_on(tmp_path, clip(EVS, frames=27)[KEPT])
    exposure_step(work)
    assert times(work) == WITH_GAP and work.manifest.exposure_given


def test_timestamps_of_a_csv_decide_where_the_cycle_shows_less(tmp_path: Path) -> None:
    kept = np.delete(np.arange(27), [10, 11, 12])  # a whole cycle, which no exposure shows
    rows = "".join(f"{i:03d}.png,{EVS[t % 3]},{t * 4e7:.0f}\n" for i, t in enumerate(kept))
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip/exposures.csv").write_text(f"file,ev,timestamp_ns\n{rows}")
    work = work_on(tmp_path, clip(EVS, frames=27)[kept])
    result = frames_step(work)
    assert "3 are missing by the timestamps" in result.note
    work.manifest.steps["frames"] = StepRecord(done=True, details=result.details)
    exposure_step(work)
    assert times(work) == kept.astype(float).tolist()
    assert brackets(work) == (kept % 3).tolist()


def stamped(folder: Path, kept: dict[str, np.ndarray], **settings: object) -> Work:
    """The footage of cameras, by the names of their folders ("": of one), that `kept`
    these frames, with timestamps and no true exposures; decoded.
    """
    lines = ["file,ev,timestamp_ns"]
    for name, numbers in kept.items():
        for k, t in enumerate(numbers.tolist()):
            write_png(folder / "clip" / name / f"{k:03d}.png", clip(EVS, frames=t + 1)[t])
            lines.append(f"{(Path(name) / f'{k:03d}.png').as_posix()},0,{t * 4e7:.0f}")
    (folder / "clip/exposures.csv").write_text("\n".join(lines))
    config = PrepareConfig(folder / "clip", folder / "scene", **settings)
    work = Work(config, open_footage(config.clip), Manifest(source="clip", width=1, height=1))
    work.manifest.steps["frames"] = StepRecord(done=True, details=frames_step(work).details)
    return work


@pytest.mark.parametrize(
    ("cameras", "settings"),
    [
        ([""], {"ev": "-2,0,2", "stride": 2}),
        ([""], {"ev": "-2,0,2", "stride": 2, "start": 1}),
        (["a", "b"], {"ev": "-2,0,2"}),
        (["a", "b"], {"exposures": "auto"}),
    ],
)
def test_the_cycle_goes_on_after_a_gap_that_timestamps_show(
    cameras: list[str], settings: dict[str, object], tmp_path: Path
) -> None:
    work = stamped(tmp_path, dict.fromkeys(cameras, KEPT), **settings)
    exposure_step(work)
    used = KEPT[work.config.start :: work.config.stride]
    phase = (used - used[0]) % 3
    shown = [phase.tolist().index(p) for p in phase]  # the first frame of that exposure
    found = brackets(work)
    assert [found.index(b) for b in found[: len(used)]] == shown
    assert found == found[: len(used)] * len(cameras) and work.manifest.cycle == 3


def test_cameras_of_a_rig_take_turns_across_a_gap(tmp_path: Path) -> None:
    work = stamped(tmp_path, {"": KEPT}, rig=5)
    exposure_step(work)
    assert work.manifest.places == (KEPT % 5).tolist()


@pytest.mark.parametrize(("hold_out", "cameras"), [(None, 3), (8, 1), (0, 0)])
def test_the_default_holds_out_frames_of_all_cameras_of_a_rig_in_turn(
    hold_out: int | None, cameras: int, tmp_path: Path
) -> None:
    work = stamped(tmp_path, {"": np.arange(27)}, rig=8, hold_out=hold_out)
    exposure_step(work)
    places = work.manifest.places
    split = zip(places, work.manifest.frames, strict=True)
    assert len({place for place, f in split if f.split == "test"}) == cameras


def test_a_camera_of_a_rig_whose_frames_are_all_missing_is_named(tmp_path: Path) -> None:
    work = stamped(tmp_path, {"": np.delete(np.arange(27), [3, 12, 21])}, rig=9)
    with pytest.raises(InputError, match=r"--rig 9: of camera 3, .* all frames are missing"):
        exposure_step(work)


def test_cameras_that_miss_different_frames_have_times_of_their_own(tmp_path: Path) -> None:
    other = np.delete(np.arange(27), [20])
    work = stamped(tmp_path, {"a": KEPT, "b": other}, exposures="auto")
    assert times(work) == [*KEPT, *other] and work.manifest.synchronized
    exposure_step(work)
    assert times(work) == [*KEPT, *other]
    assert brackets(work) == [*(KEPT % 3), *(other % 3)]


def test_different_gaps_that_share_no_times_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = np.delete(np.arange(27), [20])
    work = stamped(tmp_path, {"a": KEPT, "b": other}, stride=2)
    printed = " ".join(capsys.readouterr().err.split())
    assert "frames: the cameras miss different frames by their timestamps" in printed
    assert times(work) == [*range(13), *range(13)]


def test_a_gap_in_the_clock_of_a_video_is_a_gap(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width = stream.height = 64
        stream.time_base = stream.codec_context.time_base = Fraction(1, 25)
        for t in KEPT.tolist():
            codes = np.full((64, 64, 3), 40 + 60 * (t % 3), np.uint8)
            frame = av.VideoFrame.from_ndarray(codes, format="rgb24")
            frame.pts, frame.time_base = t, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    manifest = Manifest(source="clip", width=1, height=1)
    config = PrepareConfig(path, tmp_path / "scene")
    work = Work(config, open_footage(path), manifest)
    assert frames_step(work).details == {"missing": 1}
    assert times(work) == WITH_GAP
    assert manifest.fps == pytest.approx(25) and manifest.frame_seconds == pytest.approx(0.04)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_frame_that_is_held_long_does_not_change_the_rate(tmp_path: Path, stride: int) -> None:
    path = write_held_video(tmp_path / "clip.mp4")
    manifest = Manifest(source="clip", width=1, height=1)
    config = PrepareConfig(path, tmp_path / "scene", stride=stride)
    frames_step(Work(config, open_footage(path), manifest))
    assert manifest.fps == pytest.approx(30 / stride)
    assert manifest.frame_seconds == pytest.approx(1 / 30)
