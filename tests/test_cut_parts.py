"""A clip in which the picture cuts becomes a scene folder for each part."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from posed_clips import panning

from hdr_nsff import pipeline
from hdr_nsff.core.errors import InputError, NoSceneError
from hdr_nsff.core.images import write_png
from hdr_nsff.footage.cuts import find_cuts
from hdr_nsff.pipeline import RunConfig
from hdr_nsff.prepare import cut_parts, prepare
from hdr_nsff.prepare.engine import Step
from hdr_nsff.prepare.prepare import STEPS, PrepareConfig, prepare_scenes
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.steps import footage as on_footage
from hdr_nsff.prepare.steps.footage import ClipCutsError
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry.response import Response, Source
from hdr_nsff.scene.manifest import Manifest, StepRecord
from hdr_nsff.scene.response import write_response
from hdr_nsff.training.config import TrainConfig

PAN = panning(np.linspace(0, 8, 40))
GAINS = (0.25, 0.5, 1.0)  # of a cycle


@pytest.fixture(autouse=True)
def only_frames_and_exposures(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = {name: STEPS[name] for name in ("frames", "exposure")}
    monkeypatch.setattr(prepare, "STEPS", steps)


def clip_of(folder: Path, *lengths: int) -> Path:
    """Footage with a cut after each of these numbers of frames, but for the last."""
    turned = (PAN, PAN[:, ::-1, ::-1], PAN[:, :, ::-1])
    video = np.concatenate([pan[:count] for pan, count in zip(turned, lengths, strict=False)])
    for t, frame in enumerate(video):
        write_png(folder / f"{t:03d}.png", GAINS[t % 3] * frame)
    return folder


def sources(scene: Path) -> list[str]:
    """The files of a scene's frames."""
    return [f.source for f in Manifest.load(scene).frames]


def test_each_part_between_two_cuts_becomes_a_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = PrepareConfig(clip_of(tmp_path / "clip", 20, 14), tmp_path / "out", ev="-2,-1,0")
    scenes = prepare_scenes(config)
    assert scenes == [tmp_path / "out/part_00", tmp_path / "out/part_01"]
    assert sources(scenes[0]) == [f"{t:03d}.png" for t in range(20)]
    assert sources(scenes[1]) == [f"{t:03d}.png" for t in range(20, 34)]
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert left == {"part_00", "part_01", "parts.json"}
    for scene in scenes:  # an exposure stays that of its frame
        m = Manifest.load(scene)
        brightness = [GAINS[int(f.source[:3]) % 3] for f in m.frames]
        known = [f.ev for f in m.frames if f.ev is not None]
        assert len(known) == len(m.frames)
        assert np.ptp(np.log2(brightness) - known) < 1e-9
    said = " ".join(capsys.readouterr().err.split())
    assert "part_01: frames 20 to 33 of the clip" in said

    def detect_again(*_: Any) -> None:
        raise AssertionError("cuts are looked for again")

    monkeypatch.setattr(on_footage, "find_cuts", detect_again)
    assert prepare_scenes(config) == scenes


def response_step(ev: list[float], source: Source) -> Step:
    """A step that finds the exposures `ev` of brackets."""
    x = np.linspace(0, 1, 256) ** 2.2
    y = np.tile(x ** (1 / 2.2), (1, 3, 1))
    response = Response(
        x, y, np.array(ev), np.zeros((1, 3)), source, 0.01, 4000, guessed=True, own_curves=()
    )

    def find(work: Work) -> StepResult:
        return StepResult(
            note="",
            manifest={"response": "response.json"},
            files={"response.json": lambda path: write_response(path, response)},
        )

    return Step(find, needs=("exposure",))


@pytest.mark.parametrize("source", ["static points", "brightness"])
def test_shorter_parts_take_the_exposures_that_points_of_the_longest_showed(
    source: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = {"response": response_step([0.0, 1.3, 2.0], source)}
    monkeypatch.setattr(prepare, "STEPS", {**prepare.STEPS, **steps})
    config = PrepareConfig(clip_of(tmp_path / "clip", 14, 20), tmp_path / "out")
    short, long = map(Manifest.load, prepare_scenes(config))
    assert {f.ev for f in long.frames} == {None}
    if source == "brightness":
        assert {f.ev for f in short.frames} == {None}
        return
    ev = [f.ev for f in short.frames if f.ev is not None]
    assert np.array(ev) - ev[0] == pytest.approx([(0, 1.3, 2)[t % 3] for t in range(14)])
    redone = [f.source for scene in prepare_scenes(config) for f in Manifest.load(scene).frames]
    assert len(redone) == 34


def test_parts_that_alternate_otherwise_find_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = {"response": response_step([0.0, 1.3, 2.0], "static points")}
    monkeypatch.setattr(prepare, "STEPS", {**prepare.STEPS, **steps})
    clip = clip_of(tmp_path / "clip", 14, 20)
    for t in range(14):  # in the opposite order
        write_png(clip / f"{t:03d}.png", GAINS[::-1][t % 3] * PAN[t])
    short, _ = map(Manifest.load, prepare_scenes(PrepareConfig(clip, tmp_path / "out")))
    assert {f.ev for f in short.frames} == {None}


def test_parts_of_other_frames_are_refused(tmp_path: Path) -> None:
    config = PrepareConfig(clip_of(tmp_path / "clip", 20, 14), tmp_path / "out", end=33)
    prepare_scenes(config)
    before = sources(tmp_path / "out/part_01")
    with pytest.raises(InputError, match=r"of other frames of the clip \(--start 0 --end 33 "):
        prepare_scenes(replace(config, end=None))
    assert sources(tmp_path / "out/part_01") == before


def test_parts_are_named_where_segments_or_one_scene_are_asked_for(tmp_path: Path) -> None:
    config = PrepareConfig(clip_of(tmp_path / "clip", 20, 14), tmp_path / "out")
    prepare_scenes(config)
    with pytest.raises(InputError, match=r"holds the parts of a clip in which the picture cuts"):
        prepare_scenes(replace(config, segment=1.0))
    with pytest.raises(InputError, match=r"parts of a clip with cuts; .* such as .*part_00"):
        Manifest.load(config.out)


def test_a_part_that_is_too_short_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = PrepareConfig(clip_of(tmp_path / "clip", 18, 8, 18), tmp_path / "out")
    scenes = prepare_scenes(config)
    assert [len(sources(scene)) for scene in scenes] == [18, 18]
    said = " ".join(capsys.readouterr().err.split())
    assert "frames 18 to 25 are left out, too few for a scene" in said


def fails_for(*names: str) -> Step:
    """A step that finds no poses in the scene folders `names`."""

    def find(work: Work) -> StepResult:
        if work.folder.name in names:
            raise NoSceneError(f"no poses in {work.folder.name}")
        return StepResult(note="")

    return Step(find, needs=("exposure",))


@pytest.mark.parametrize("failed", ["part_00", "part_01"])
def test_a_part_that_makes_no_scene_is_left_out(
    failed: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(prepare, "STEPS", {**prepare.STEPS, "poses": fails_for(failed)})
    config = PrepareConfig(clip_of(tmp_path / "clip", 20, 14), tmp_path / "out")
    (scene,) = prepare_scenes(config)
    assert scene.name == ("part_01" if failed == "part_00" else "part_00")
    assert Manifest.load(scene).steps["poses"].done
    said = " ".join(capsys.readouterr().err.split())
    assert f"{failed} of 2 is left out: no poses in {failed}" in said
    monkeypatch.setattr(prepare, "STEPS", {**prepare.STEPS, "poses": fails_for()})
    assert len(prepare_scenes(config)) == 2


def test_where_no_part_makes_a_scene_the_longest_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = fails_for("part_00", "part_01")
    monkeypatch.setattr(prepare, "STEPS", {**prepare.STEPS, "poses": both})
    config = PrepareConfig(clip_of(tmp_path / "clip", 14, 20), tmp_path / "out")
    with pytest.raises(NoSceneError, match="no poses in part_01"):
        prepare_scenes(config)


def test_other_errors_of_a_part_end_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_disk(work: Work) -> StepResult:
        raise OSError(errno.ENOSPC, "No space left on device")

    full = Step(fill_disk, needs=("exposure",))
    monkeypatch.setattr(prepare, "STEPS", {**prepare.STEPS, "poses": full})
    config = PrepareConfig(clip_of(tmp_path / "clip", 20, 14), tmp_path / "out")
    with pytest.raises(InputError, match="No space left"):
        prepare_scenes(config)
    assert not (tmp_path / "out/part_01").exists()


def test_where_no_part_is_long_enough_the_clip_is_refused(tmp_path: Path) -> None:
    config = PrepareConfig(clip_of(tmp_path / "clip", 9, 10), tmp_path / "out")
    with pytest.raises(InputError, match="cuts between frames 8 and 9"):
        prepare_scenes(config)


@pytest.mark.parametrize("name", ["poses", "flow", "masks", "mask_points", "depth"])
def test_files_of_the_whole_clip_keep_it_whole(name: str, tmp_path: Path) -> None:
    config = PrepareConfig(clip_of(tmp_path / "clip", 20, 14), tmp_path / "out")
    work = prepare.begin(config)
    with pytest.raises(ClipCutsError, match="cuts between frames 19 and 20") as cuts:
        prepare.run_steps(work, prepare.STEPS)
    work.config = replace(config, **{name: tmp_path / "given"})
    with pytest.raises(ClipCutsError):
        cut_parts.part_at_cuts(work, cuts.value)
    assert len(sources(config.out)) == 34
    work.config = config
    assert len(cut_parts.part_at_cuts(work, cuts.value)) == 2


def test_a_scene_that_was_there_before_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = PrepareConfig(clip_of(tmp_path / "clip", 20, 14), tmp_path / "out")
    monkeypatch.setattr(on_footage, "find_cuts", lambda video: [])
    prepare_scenes(config)
    m = Manifest.load(config.out)
    m.steps["poses"] = StepRecord(done=True, key="")
    m.save(config.out)
    monkeypatch.setattr(on_footage, "find_cuts", find_cuts)
    with pytest.raises(InputError, match="cuts between frames 19 and 20"):
        prepare_scenes(replace(config, redo=("exposure",)))
    assert len(sources(config.out)) == 34 and (config.out / "images/00033.png").is_file()


def test_parts_can_be_declined(tmp_path: Path) -> None:
    config = PrepareConfig(clip_of(tmp_path / "clip", 20, 14), tmp_path / "out")
    with pytest.raises(InputError, match="cuts between frames 19 and 20"):
        prepare_scenes(config, part_cuts=False)


def test_run_trains_each_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = []

    def note(settings: TrainConfig, truth: Path | None) -> dict[str, Path]:
        trained.append((settings.scene, settings.out))
        return {"report": tmp_path}

    monkeypatch.setattr(pipeline, "finish_scene", note)
    out = tmp_path / "out"
    config = RunConfig(clip_of(tmp_path / "clip", 20, 14), out, preset="tiny", device="cpu")
    pipeline.run_all(config)
    parts = ("part_00", "part_01")
    assert trained == [(out / "scene" / name, out / name / "run") for name in parts]


def test_a_truth_of_the_whole_clip_keeps_it_whole(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    clip, out = clip_of(tmp_path / "clip", 20, 14), tmp_path / "out"
    config = RunConfig(clip, out, truth=tmp_path / "truth", hold_out=8, device="cpu")
    with pytest.raises(InputError):
        pipeline.run_all(config)
    assert not (out / "scene/parts.json").exists()
