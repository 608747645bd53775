"""`check` on clips whose truth is known, and its sentences on facts made by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from toy_scene import EV, ToyScene

from hdr_nsff.check import given, lens, measure
from hdr_nsff.check.check import CheckConfig, check, default_picture
from hdr_nsff.check.facts import CameraFacts, ClipFacts, ExposureFacts, FileFacts, LensFacts
from hdr_nsff.check.findings import Finding, judge, outlook
from hdr_nsff.check.measure import measure_clip
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.video import write_video
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.footage.frame_files import CHECK_PICTURE, frame_files
from hdr_nsff.footage.gpmf import GoProFrames
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.priors.poses.sfm import LENS_FILE, LensFit
from hdr_nsff.priors.poses.view_matches import EarlierRounds

WIDTH, HEIGHT, FRAMES = 240, 136, 12


def clip_of(folder: Path, radiance: Callable[[int], np.ndarray], evs: list[float]) -> Path:
    """PNG frames of radiance (H, W, 3) at exposures, recorded by a gamma of 2.2."""
    for t, ev in enumerate(evs):
        picture = np.clip(radiance(t) * 2.0**ev, 0, 1) ** (1 / 2.2)
        write_png(folder / f"{t:03d}.png", picture)
    return folder


def measured(clip: Path) -> tuple[ClipFacts, np.ndarray, list[int]]:
    """The facts of footage, its small frames, and their brackets."""
    return measure_clip(open_footage(clip))


def still_scene(t: int) -> np.ndarray:
    """Radiance that the toy scene has at time 0, without its moving card."""
    del t
    scene = ToyScene(WIDTH, HEIGHT)
    return scene.see(0.0)[0] * 0.6


def test_an_alternating_clip_with_parallax_is_fit_for_everything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = ToyScene(WIDTH, HEIGHT)
    evs = [EV[t % 3] - 1 for t in range(FRAMES)]
    clip = clip_of(tmp_path / "clip", lambda t: scene.see(float(t))[0], evs)
    check(CheckConfig(clip, picture=tmp_path / "seen.png", json=True))
    document = json.loads(capsys.readouterr().out)
    assert document["works"]["HDR"] == "yes"
    assert document["works"]["new viewpoints"].startswith("yes")
    facts = document["facts"]
    assert facts["exposure"]["cycle"] == 3 and facts["camera"]["motion"] == "parallax"
    assert sorted(facts["exposure"]["ev"]) == pytest.approx([0, 2, 4], abs=0.3)
    assert facts["exposure"]["drift_ev"] < 0.3 and facts["camera"]["cuts"] == []
    assert read_image(tmp_path / "seen.png").shape[1] == 1200


def test_a_tripod_with_one_exposure_has_neither_hdr_nor_viewpoints(tmp_path: Path) -> None:
    facts, _, _ = measured(clip_of(tmp_path, still_scene, [0.0] * FRAMES))
    assert facts.camera.motion == "tripod" and facts.exposure.cycle == 1
    works = outlook(facts)
    assert works["HDR"].startswith("no") and works["new viewpoints"].startswith("no")
    problems = [finding.subject for finding in judge(facts) if finding.level == "problem"]
    assert problems == ["exposure"]
    (camera,) = [finding for finding in judge(facts) if finding.subject == "camera"]
    assert camera.level == "note" and camera.text.startswith("the camera stands still")


@pytest.mark.parametrize("share", [0.6, 0.75])
def test_no_lens_is_looked_for_where_turns_alone_explain_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    looked_for = []
    monkeypatch.setattr(measure, "find_motion", lambda *_: ("parallax", share))
    monkeypatch.setattr(measure, "measure_lens", lambda *_: looked_for.append(share))
    facts, _, _ = measured(clip_of(tmp_path, still_scene, [0.0] * 4))
    assert facts.camera.lens is None and facts.camera.rotation_share == share
    assert looked_for == ([share] if share < 0.7 else [])


@pytest.mark.parametrize(("error_px", "straight"), [(0.5, True), (0.4, False)])
def test_lines_are_straight_only_where_no_lens_explains_the_frames_better(
    monkeypatch: pytest.MonkeyPatch, error_px: float, straight: bool
) -> None:
    def pinhole(*_: object, earlier: EarlierRounds, **__: object) -> Poses:
        fit = LensFit({1: (100.0, 2.0, -1.4)}, model_error_px=0.5, error_px=error_px)
        earlier.model[LENS_FILE] = json.dumps(asdict(fit)).encode()
        c2w = np.tile(np.eye(4)[:3], (6, 1, 1))
        return Poses(np.tile(np.eye(3), (6, 1, 1)), c2w, np.ones(6, bool), "full")

    monkeypatch.setattr(lens, "estimate_poses", pinhole)
    found = lens.measure_lens(np.zeros((6, 8, 8, 3)), np.zeros((6, 8, 8), bool), 1.0)
    assert found == (LensFacts(0.0, 0.0, 0.0) if straight else None)


def test_auto_exposure_is_told_from_a_locked_one(tmp_path: Path) -> None:
    drifting = [0.1 * t - 0.6 for t in range(FRAMES)]
    facts, _, _ = measured(clip_of(tmp_path, still_scene, drifting))
    assert facts.exposure.cycle == 1
    assert facts.exposure.drift_ev == pytest.approx(1.1, abs=0.15)
    assert any("auto exposure" in finding.text for finding in judge(facts))


def test_bands_of_mains_flicker_are_found(tmp_path: Path) -> None:
    rows = np.arange(HEIGHT)[:, None, None] / HEIGHT

    def flickering(t: int) -> np.ndarray:
        return still_scene(t) * (1 + 0.1 * np.sin(2 * np.pi * (4 * rows + 0.3 * t)))

    facts, _, _ = measured(clip_of(tmp_path, flickering, [0.0] * FRAMES))
    assert facts.exposure.banding_ev == pytest.approx(0.24, abs=0.1)  # of a difference of two
    assert any(finding.subject == "flicker" for finding in judge(facts))


def test_a_blurred_long_exposure_is_found(tmp_path: Path) -> None:
    def blurred(t: int) -> np.ndarray:
        picture = still_scene(t)
        if t % 2:
            return picture
        return np.mean([np.roll(picture, k, 1) for k in range(-6, 7)], 0)

    evs = [0.0, -2.0] * (FRAMES // 2)
    facts, _, _ = measured(clip_of(tmp_path / "a", blurred, evs))
    assert facts.camera.long_sharpness is not None and facts.camera.long_sharpness < 0.8
    facts, _, _ = measured(clip_of(tmp_path / "b", still_scene, evs))
    assert facts.camera.long_sharpness is not None and facts.camera.long_sharpness > 0.9


def test_given_exposures_are_taken_as_they_are(tmp_path: Path) -> None:
    evs = [0.0, -1.0, -2.0, -3.0, -4.0, -5.0, -6.0, -7.0]  # no cycle: a bracket of stills
    clip = clip_of(tmp_path, still_scene, evs)
    rows = [f"{t},{ev}" for t, ev in enumerate(evs)]
    (clip / "exposures.csv").write_text("\n".join(["frame,ev", *rows]))
    facts, _, brackets = measured(clip)
    assert facts.exposure.given == "exposures.csv" and brackets == [0] * 8  # as `prepare`
    assert facts.exposure.given_drift_ev == 7 and not facts.exposure.contradictions
    assert outlook(facts)["HDR"] == "yes"
    (exposure, *_) = (finding for finding in judge(facts) if finding.subject == "exposure")
    assert exposure.level == "good" and "range over 7.0 EV, in no cycle" in exposure.text
    # rows in any order, but all of them
    (clip / "exposures.csv").write_text("\n".join(["frame,ev", *rows[::-1]]))
    assert measured(clip)[0].exposure == facts.exposure
    (clip / "exposures.csv").write_text("\n".join(["frame,ev", *rows[:-1]]))
    with pytest.raises(InputError, match="no row for frame"):
        measured(clip)


def test_given_exposures_that_do_not_change_are_no_alternation() -> None:
    good = good_facts()
    constant = replace(good.exposure, cycle=1, ev=(0.0,), given="exposures.csv", change_ev=0.0)
    found = judge(replace(good, exposure=replace(constant, white_share=(0.0,), black_share=(0.0,))))
    (exposure,) = (finding for finding in found if finding.subject == "exposure")
    assert exposure.level == "problem" and exposure.advice


def listed(clip: Path, evs: list[float]) -> list[Finding]:
    """The findings on the exposure of a clip whose list says `evs`."""
    rows = [f"{t},{ev}" for t, ev in enumerate(evs)]
    (clip / "exposures.csv").write_text("\n".join(["frame,ev", *rows]))
    facts, _, _ = measured(clip)
    works = Finding("note", "HDR", outlook(facts)["HDR"])
    return [works, *(f for f in judge(facts) if f.subject == "exposure")]


def test_a_list_of_auto_exposure_is_no_list_of_brackets(tmp_path: Path) -> None:
    drift = [0.1 * t - 0.6 for t in range(FRAMES)]
    works, found, *_ = listed(clip_of(tmp_path / "a", still_scene, drift), drift)
    assert works.text.startswith("partly: the exposure drifts by about 1.1 EV")
    assert found.level == "warning" and "gives drift by 1.10 EV: auto exposure" in found.text
    both = [ev + 2.0 * (t % 2) for t, ev in enumerate(drift)]
    works, found, *_ = listed(clip_of(tmp_path / "b", still_scene, both), both)
    assert works.text == "yes" and found.level == "good"
    assert "2 exposures are given by exposures.csv, 2.0 EV in all, which drift" in found.text


@pytest.mark.parametrize(
    ("recorded", "written", "problem"),
    [
        ([0.0, -2.0], [0.0, 0.0], "do not alternate, but the brightness repeats every 2"),
        ([0.0, -2.0], [-2.0, 0.0], "go the way the brightness goes"),
        ([0.0, 0.0], [0.0, -2.0], "all frames are about equally bright"),
    ],
)
def test_a_list_that_the_pixels_contradict_is_reported(
    tmp_path: Path, recorded: list[float], written: list[float], problem: str
) -> None:
    clip = clip_of(tmp_path, still_scene, recorded * (FRAMES // 2))
    works, exposure, contradiction, *_ = listed(clip, written * (FRAMES // 2))
    assert works.text == "unknown: exposures.csv and the pixels disagree"
    assert exposure.level == "note"
    assert problem in contradiction.text and "--exposures auto" in contradiction.advice


def test_a_list_that_drifts_the_wrong_way_is_reported(tmp_path: Path) -> None:
    drift = [0.1 * t - 0.6 for t in range(FRAMES)]
    works, _, contradiction, *_ = listed(clip_of(tmp_path, still_scene, drift), drift[::-1])
    assert works.text.startswith("unknown")
    assert "a given drift of 1.1 EV changes points of the scene like -1.1" in contradiction.text


def test_exposures_that_a_gopro_wrote_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drift = np.array([0.1 * t - 0.6 for t in range(FRAMES)])
    folder = clip_of(tmp_path / "frames", still_scene, drift.tolist())
    frames = [read_image(path)[..., :3] for path in frame_files(folder)]
    write_video(tmp_path / "gopro.mp4", frames)
    written = GoProFrames(0.01 * 2**drift, np.full(FRAMES, 100.0))
    monkeypatch.setattr(given, "read_gopro", lambda path, count: written)
    facts, _, brackets = measured(tmp_path / "gopro.mp4")
    assert facts.exposure.given == "GoPro's metadata" and brackets == [0] * FRAMES
    assert facts.exposure.given_drift_ev == pytest.approx(1.1) and facts.exposure.ev == (0.0,)
    assert not facts.exposure.contradictions


def test_the_picture_of_check_is_no_frame(tmp_path: Path) -> None:
    clip = clip_of(tmp_path, still_scene, [0.0, -2.0] * 4)
    before = frame_files(clip)
    (clip / f"frames{CHECK_PICTURE}").write_bytes(before[0].read_bytes())
    assert frame_files(clip) == before


def good_facts() -> ClipFacts:
    """A clip as it should be."""
    return ClipFacts(
        FileFacts("a.mp4", 60, 1, 640, 360, 24.0, 8, "recorded", (41.7, 41.7)),
        60,
        (0, 60),
        ExposureFacts(2, (0.0, 2.0), 0.97, None, 2.0, 0.1, (0.0, 0.2), (0.1, 0.0), 0.0),
        CameraFacts("parallax", 0.2, 3.0, 0.98, ()),
    )


def test_folders_whose_names_have_dots_get_a_picture_each(tmp_path: Path) -> None:
    for day in ("2024.11.29", "2024.11.30"):
        (tmp_path / day).mkdir()
        assert default_picture(tmp_path / day) == Path(f"{day}_check.png")
    (tmp_path / "walk.mp4").touch()
    assert default_picture(tmp_path / "walk.mp4") == Path("walk_check.png")


def test_a_frame_that_is_missing_from_the_cycle_is_found(tmp_path: Path) -> None:
    evs = [EV[t % 3] - 1 for t in range(16) if t != 7]
    facts, _, brackets = measured(clip_of(tmp_path, still_scene, evs))
    assert facts.exposure.missing_before == (7,)
    assert brackets == [t % 3 for t in range(16) if t != 7]


def test_a_good_clip_has_nothing_to_warn_of() -> None:
    assert {finding.level for finding in judge(good_facts())} <= {"good", "note"}


def test_black_frames_that_hide_the_cycle_are_named_and_are_no_auto_exposure(
    tmp_path: Path,
) -> None:
    evs = [-20.0] * 3 + [0.0, -3.0] * 3
    facts, _, _ = measured(clip_of(tmp_path, still_scene, evs))
    found = judge(replace(facts, exposure=replace(facts.exposure, drift_ev=3.0)))
    assert any("of 9 frames, counted from 0, 0-2 black all over" in f.text for f in found)
    assert facts.exposure.cycle == 1 and not any("auto exposure" in f.text for f in found)


def test_an_interlaced_clip_is_told_how_to_be_made_progressive() -> None:
    good = good_facts()
    interlaced = replace(good, file=replace(good.file, interlaced=True))
    (finding,) = [f for f in judge(interlaced) if f.subject == "interlaced"]
    assert finding.level == "warning" and "ffmpeg -i a.mp4 -vf bwdif" in finding.advice


def test_every_warning_comes_with_advice() -> None:
    good = good_facts()
    exposure = replace(
        good.exposure, ev=(0.0, 4.0), drift_ev=1.0, banding_ev=0.1, white_share=(0.1, 0.5)
    )
    bad = ClipFacts(
        replace(good.file, frames=5, interval_ms=(20.0, 60.0)),
        5,
        (0, 3),
        replace(exposure, black_share=(0.5, 0.1)),
        CameraFacts("tripod", 0.9, 40.0, 0.5, (3,)),
    )
    found = judge(bad)
    warned = [finding for finding in found if finding.level in ("warning", "problem")]
    assert all(finding.advice for finding in warned)
    subjects = {finding.subject for finding in warned}
    assert subjects >= {"exposure", "flicker", "highlights", "shadows", "blur", "cuts", "timing"}


def test_the_readout_is_given_in_milliseconds_where_it_is_seen() -> None:
    good = good_facts()

    def sentence(readout: tuple[float, float] | None) -> str:
        camera = replace(good.camera, readout=readout)
        found = judge(replace(good, camera=camera))
        return next(f.text + f.advice for f in found if f.subject == "shutter")

    assert "50% of the time between frames" in sentence((0.5, 0.02))
    assert ", 21 ms" in sentence((0.5, 0.02)) and "--readout 21" in sentence((0.5, 0.02))
    assert sentence((0.05, 0.04)).startswith("no rolling shutter is seen (less than 13%")
    assert "is not measured" in sentence(None)


def test_still_cameras_of_a_rig_give_viewpoints_between_them() -> None:
    good = good_facts()
    still = replace(good.camera, motion="tripod")
    alone = outlook(replace(good, camera=still))
    rig = outlook(replace(good, camera=still, file=replace(good.file, cameras=4)))
    assert alone["new viewpoints"].startswith("no")
    assert rig["new viewpoints"].startswith("yes, between cameras")


def test_a_clip_that_is_long_for_one_scene_is_offered_segments() -> None:
    long = replace(good_facts(), file=replace(good_facts().file, frames=400))
    (found,) = [f for f in judge(long) if f.subject == "length"]
    assert "beyond 265 of this size" in found.text
    assert "`hdr-nsff run CLIP OUT --segment 5`" in found.advice
    assert not [f for f in judge(good_facts()) if f.subject == "length"]


def test_frames_that_timestamps_miss_are_counted() -> None:
    good = good_facts()
    found = judge(replace(good, file=replace(good.file, missing=2, interval_ms=(41.0, 42.0))))
    timing = [f.text for f in found if f.subject == "timing"]
    assert timing == ["2 frames are missing by the timestamps"]


def test_timestamps_of_a_list_are_read(tmp_path: Path) -> None:
    clip = clip_of(tmp_path, still_scene, [0.0] * FRAMES)

    def timing(ms: list[object]) -> tuple[FileFacts, list[str]]:
        rows = [f"{t},0,{time}000000" for t, time in enumerate(ms)]
        (clip / "exposures.csv").write_text("\n".join(["frame,ev,timestamp_ns", *rows]))
        facts, _, _ = measured(clip)
        return facts.file, [f.text for f in judge(facts) if f.subject == "timing"]

    even = [40 * t for t in range(FRAMES + 1)]
    file, found = timing(even[:4] + even[5:])
    assert file.missing == 1 and found == ["1 frame is missing by the timestamps"]
    assert file.frame_ms == 40 and file.interval_ms == (40, 40)
    uneven = np.cumsum([40, 68] * 7).tolist()
    file, found = timing(uneven[:4] + uneven[6:])  # two frames are missing
    assert file.missing == 2 and found[0].startswith("2 frames are missing")
    assert found[1] == "variable frame rate: 40 to 68 ms between frames"
    file, found = timing([*even[:4], even[3], *even[5:FRAMES]])
    sentence = "the timestamp_ns of frame 004.png is not above that of frame 003.png"
    assert file.interval_ms is None and found == [f"{sentence}; frames are taken as evenly spaced"]
    with pytest.raises(InputError, match="'x000000' is not a number"):
        timing(["x"] * FRAMES)


def test_bad_input_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        check(CheckConfig(tmp_path / "missing.mp4", picture=tmp_path / "a.png"))
    with pytest.raises(InputError, match=r"ends in \.png"):
        check(CheckConfig(tmp_path, picture=tmp_path / "a.jpg"))
    (tmp_path / "notes.png").write_text("mine")
    with pytest.raises(InputError, match="exists and is no picture"):
        check(CheckConfig(tmp_path, picture=tmp_path / "notes.png"))
    black = clip_of(tmp_path / "black", lambda t: np.zeros((HEIGHT, WIDTH, 3)), [0.0] * 4)
    with pytest.raises(InputError, match="all frames are black"):
        check(CheckConfig(black, picture=tmp_path / "b.png"))


def rig_of(folder: Path, evs: dict[str, float], count: int = 6) -> Path:
    """Cameras beside each other before the toy scene, each with its exposure."""
    scene = ToyScene(WIDTH, HEIGHT)
    for k, (name, ev) in enumerate(evs.items()):

        def see(t: float, place: int = k) -> np.ndarray:
            return scene.see(t + 0.2 * place)[0]

        clip_of(folder / name, see, [ev] * count)
    return folder


def test_all_cameras_of_a_rig_are_looked_at_for_their_exposure(tmp_path: Path) -> None:
    facts, _, _ = measured(rig_of(tmp_path / "a", {"a": -3.0, "b": -1.0, "c": -3.0}))
    assert [camera.name for camera in facts.each_camera] == ["a", "b", "c"]
    levels = [camera.level_ev for camera in facts.each_camera]
    assert levels == pytest.approx([0, 2, 0], abs=0.4)
    found = {f.text: f.level for f in judge(facts) if f.subject in ("cameras", "exposure")}
    assert found.popitem()[0].startswith("movement, lens and shutter are measured of the first of")
    ((text, level),) = found.items()
    assert text.startswith("the 3 cameras are exposed differently") and level == "good"
    assert outlook(facts)["HDR"] == "yes"
    alike, _, _ = measured(rig_of(tmp_path / "b", {"a": -1.0, "b": -1.0}))
    assert outlook(alike)["HDR"].startswith("no")
    texts = [f.text for f in judge(alike) if f.subject == "cameras"]
    assert texts[0] == "the 2 cameras are exposed alike (by brightness)"


def test_cycles_of_cameras_that_differ_ask_for_a_list_unless_one_is_given(tmp_path: Path) -> None:
    folder = rig_of(tmp_path, {"a": -1.0, "b": -1.0}, FRAMES)
    rows = [f"a/{t:03d}.png,0" for t in range(FRAMES)]
    rows += [f"b/{t:03d}.png,{-2 * (t % 2)}" for t in range(FRAMES)]
    (folder / "exposures.csv").write_text("\n".join(["file,ev", *rows]))
    facts, _, _ = measured(folder)
    texts = [f.text + f.advice for f in judge(facts) if f.subject == "cameras"]
    assert texts[0] == "the exposures of the cameras repeat after [1, 2] frames (by exposures.csv)"
    unlisted = replace(facts, exposure=replace(facts.exposure, given=None))
    texts = [f.text + f.advice for f in judge(unlisted) if f.subject == "cameras"]
    assert "disagree" in texts[0] and texts[0].endswith("list the exposures in exposures.csv")


def test_a_list_that_one_camera_contradicts_is_reported(tmp_path: Path) -> None:
    folder = rig_of(tmp_path, {"a": -1.0, "b": -1.0}, FRAMES)
    rows = [f"a/{t:03d}.png,0" for t in range(FRAMES)]
    rows += [f"b/{t:03d}.png,{-2 * (t % 2)}" for t in range(FRAMES)]
    (folder / "exposures.csv").write_text("\n".join(["file,ev", *rows]))
    facts, _, _ = measured(folder)
    assert outlook(facts)["HDR"].startswith("unknown: exposures.csv")
    (finding,) = [f for f in judge(facts) if "disagree: " in f.text]
    assert finding.text.startswith("b: exposures.csv and the pixels disagree: exposure steps of")


def test_tracks_of_one_camera_are_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, ev in (("bright", -1.0), ("dark", -3.0)):
        clip_of(tmp_path / "clip" / name, still_scene, [ev] * 8)
    tracks = ("bright", "dark")
    check(CheckConfig(tmp_path / "clip", tmp_path / "seen.png", True, tracks))
    document = json.loads(capsys.readouterr().out)
    assert document["works"]["HDR"] == "yes"
    assert document["works"]["new viewpoints"].startswith("no: the camera stands still")
    texts = [f["text"] for f in document["findings"] if f["subject"] == "tracks"]
    assert texts[0].startswith("the 2 tracks are exposed differently, by up to ")
    dark = document["facts"]["each_camera"][1]
    assert dark["level_ev"] == pytest.approx(-2, abs=0.2)
