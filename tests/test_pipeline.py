"""`run` passes the options of `prepare` and `train` on, and beside a truth folder it
trains on no frame that it is then scored on.
"""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from test_prepare import H, W, footage, given, stamps

from hdr_nsff import cli, pipeline
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import write_json
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.pipeline import (
    RunConfig,
    held_out_every,
    options_for,
    prepare_settings,
    train_settings,
)
from hdr_nsff.prepare.prepare import PrepareConfig
from hdr_nsff.scene.scene import Scene
from hdr_nsff.scene.truth import Truth, TruthView
from hdr_nsff.synth.reexpose import ReexposeConfig, reexpose
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig, check_config
from hdr_nsff.training.presets import PRESETS

COUNT = 21


def problem(root: Path, hold_out: int) -> Path:
    """A textured wall at z = 2, seen by a camera that slides along x by 0.1 per frame,
    re-exposed; its true views are frames of the clip.
    """
    world = np.exp(np.random.default_rng(0).normal(size=(H, W + 2 * COUNT, 3)) * 0.5 - 1.5)
    for t in range(COUNT):
        write_png(root / f"ordinary/{t:03d}.png", np.clip(world[:, 2 * t : 2 * t + W], 0, 1))
    return reexpose(ReexposeConfig(root / "ordinary", root / "problem", hold_out=hold_out))


def truth_of(folder: Path, *views: tuple[float, int]) -> Path:
    """A truth whose views are of a (time, anchor) each."""
    entries = [
        TruthView(name=f"{t}_{a}", time=t, bracket=0, anchor=a, radiance=f"radiance/{k}.exr")
        for k, (t, a) in enumerate(views)
    ]
    truth = Truth(
        bracket_ev=[0.0],
        reference_bracket=0,
        response_x=[0, 1],
        response_y=[[0, 1]] * 3,
        views=entries,
    )
    write_json(folder / "truth.json", truth.model_dump())
    return folder


@pytest.mark.parametrize("hold_out", [5, 8])
def test_frames_that_the_truth_is_of_are_kept_out_of_training(
    hold_out: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scored on exact radiance of the frames that were kept out, and of none that was
    trained on.
    """
    monkeypatch.setitem(
        PRESETS, "tiny", replace(PRESETS["tiny"], budget=Budget(steps=20, minutes=None))
    )
    monkeypatch.setattr(pipeline, "render_all", lambda run, out: {})
    made, poses = problem(tmp_path, hold_out), given(tmp_path / "given", COUNT)["poses"]
    pipeline.run_all(
        RunConfig(
            made / "clip",
            tmp_path / "out",
            ev="-2,0,2",
            preset="tiny",
            poses=poses,
            truth=made / "truth",
            device="cpu",
        )
    )
    scene = Scene.open(tmp_path / "out/scene")
    views = [v.anchor for v in Truth.open(made / "truth").views]
    assert views == ([2, 7, 12, 17] if hold_out == 5 else [4, 12])
    assert views == [f.index for f in scene.test]
    metrics = json.loads((tmp_path / "out/run/metrics.json").read_text())
    assert metrics["kind"] == "held-out views with exact radiance"
    assert metrics["headline"]["views"] == len(views)
    assert {v["group"] for v in metrics["views"]} == {"view+time"}
    assert {v["protocol"] for v in metrics["views"]} == {"novel-view-time"}
    assert not any("trained on" in note for note in metrics["notes"])


def test_beside_a_truth_of_other_places_or_times_all_frames_are_trained_on(tmp_path: Path) -> None:
    config = RunConfig(tmp_path, tmp_path)
    assert held_out_every(config) is None  # `prepare` knows
    for name, views in {"place": [(3.0, 9), (4.0, 4)], "time": [(2.5, 2)], "none": []}.items():
        assert held_out_every(replace(config, truth=truth_of(tmp_path / name, *views))) == 0


def test_settings_of_the_user_take_precedence_over_the_truth(tmp_path: Path) -> None:
    config = RunConfig(tmp_path, tmp_path, truth=truth_of(tmp_path / "truth", (4.0, 4), (12.0, 12)))
    assert held_out_every(config) == 8
    assert held_out_every(replace(config, hold_out=3)) == 3
    assert held_out_every(replace(config, hold_out=0)) == 0
    other = truth_of(tmp_path / "other", (2.5, 2))
    assert held_out_every(replace(config, truth=other, protocol="novel-view-time")) is None


def test_a_protocol_that_trains_on_frames_of_the_truth_is_refused(tmp_path: Path) -> None:
    config = RunConfig(tmp_path, tmp_path, truth=truth_of(tmp_path / "truth", (4.0, 4), (12.0, 12)))
    for protocol in ("novel-view", "novel-view-time"):
        with pytest.raises(InputError, match="leave --protocol out"):
            held_out_every(replace(config, protocol=protocol))


def test_unevenly_spaced_truth_frames_are_refused_in_a_sentence(tmp_path: Path) -> None:
    config = RunConfig(
        tmp_path, tmp_path, truth=truth_of(tmp_path / "truth", (4.0, 4), (5.0, 5), (9.0, 9))
    )
    with pytest.raises(InputError, match=r"frames 4, 5, 9 of the clip.* --hold-out"):
        held_out_every(config)


def test_a_truth_counts_all_frames_of_the_clip(tmp_path: Path) -> None:
    config = RunConfig(tmp_path, tmp_path, truth=truth_of(tmp_path / "truth", (4.0, 4)))
    pipeline.check_truth(config)
    for other in (replace(config, start=2), replace(config, stride=2)):
        with pytest.raises(InputError, match="leave --start and --stride out"):
            pipeline.check_truth(other)


def test_every_option_of_prepare_reaches_it(tmp_path: Path) -> None:
    config = RunConfig(
        tmp_path / "clip",
        tmp_path,
        ev="-2,0",
        start=3,
        end=9,
        stride=2,
        flow="dis",
        masks="motion",
        depth="geometric",
        matcher="disk",
        redo=("poses",),
        hold_out=4,
    )
    passed = prepare_settings(config)
    assert passed.out == tmp_path / "scene"
    for f in fields(PrepareConfig):
        if f.name != "out":
            assert getattr(passed, f.name) == getattr(config, f.name), f.name


def test_the_options_of_train_reach_it(tmp_path: Path) -> None:
    config = RunConfig(tmp_path, tmp_path, preset="grid", minutes=3, refine_poses=True, seed=7)
    passed = train_settings(config)
    assert (passed.budget.minutes, passed.refine_poses, passed.seed) == (3, True, 7)
    assert passed == replace(
        PRESETS["grid"], budget=Budget(minutes=3), refine_poses=True, seed=7, out=tmp_path / "run"
    )


def test_shared_options_have_the_same_help(capsys: pytest.CaptureFixture[str]) -> None:
    shown = {}
    for verb in ("prepare", "run"):
        with pytest.raises(SystemExit):
            cli.main([verb, "--help"])
        lines = [line.strip("│ ") for line in capsys.readouterr().out.splitlines()]
        shown[verb] = " ".join(" ".join(lines).split())
    for option in ("--flow", "--masks", "--depth", "--matcher", "--start", "--end", "--stride"):
        start = shown["prepare"].index(f"{option} ")
        end = shown["prepare"].index(" --", start)  # of the next option
        assert shown["prepare"][start:end][:100] in shown["run"], option


def test_the_shutter_reaches_the_field_that_has_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = RunConfig(tmp_path / "clip.mp4", tmp_path / "out", readout=20.0, shutter=0.5)
    field = check_config(train_settings(config)).field
    assert isinstance(field, SplatConfig) and (field.readout, field.shutter) == (None, 0.5)
    assert prepare_settings(config).readout == 20.0  # the field takes it from the scene
    with pytest.raises(InputError, match="--preset splat"):
        train_settings(replace(config, preset="grid"))
    train_settings(replace(config, preset="grid", shutter=0.0))
    assert "--readout: corrects the poses" in capsys.readouterr().err
    assert check_config(train_settings(replace(config, shutter="auto"))).field == replace(
        field, shutter="auto"
    )
    with pytest.raises(InputError, match=r"--field\.shutter 3\.0: choose a number up to 1"):
        check_config(train_settings(replace(config, shutter=3.0)))


def test_a_killed_run_of_segments_goes_on_with_the_segment_that_it_was_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each segment has a run, a report and scores of its own; none is trained twice."""
    monkeypatch.setitem(
        PRESETS, "tiny", replace(PRESETS["tiny"], budget=Budget(steps=4, minutes=None))
    )
    monkeypatch.setattr(pipeline, "render_all", lambda run, out: {})
    count = 30
    config = RunConfig(
        footage(tmp_path / "clip", count),
        tmp_path / "out",
        preset="tiny",
        segment=0.8,
        device="cpu",
        **given(tmp_path / "given", count),
    )
    train, begun = pipeline.train, []

    def killed_in_the_second(settings: TrainConfig) -> Path:
        begun.append(settings.scene.name)
        if begun == ["segment_00", "segment_01"]:
            raise KeyboardInterrupt
        return train(settings)

    monkeypatch.setattr(pipeline, "train", killed_in_the_second)
    with pytest.raises(KeyboardInterrupt):
        pipeline.run_all(config)
    first = tmp_path / "out/segment_00/run/checkpoints"
    written = stamps(first)
    pipeline.run_all(config)
    assert written and stamps(first) == written
    for name in ("segment_00", "segment_01"):
        metrics = json.loads((tmp_path / f"out/{name}/run/metrics.json").read_text())
        assert metrics["kind"] == "held-out frames"
        assert (tmp_path / f"out/{name}/report.html").is_file()


def test_a_run_killed_in_training_redoes_no_step_under_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same command, or the one without `--redo`, keeps the scene and goes on."""
    monkeypatch.setitem(
        PRESETS, "tiny", replace(PRESETS["tiny"], budget=Budget(steps=4, minutes=None))
    )
    monkeypatch.setattr(pipeline, "render_all", lambda run, out: {})
    clip, out, maps = footage(tmp_path / "clip", 12), tmp_path / "out", given(tmp_path / "g", 12)
    config = RunConfig(clip, out, preset="tiny", device="cpu", redo=("flow",), **maps)
    train, flow = pipeline.train, out / "scene/raw_flow"

    def killed(settings: TrainConfig) -> Path:
        train(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "train", killed)
    with pytest.raises(KeyboardInterrupt):
        pipeline.run_all(config)
    written = stamps(flow)
    monkeypatch.setattr(pipeline, "train", train)
    for again in (config, replace(config, redo=()), config):
        pipeline.run_all(again)
        assert written and stamps(flow) == written
    assert "--redo flow: done before" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"other options \(--redo\)"):
        pipeline.run_all(replace(config, redo=("depth",)))


def test_a_truth_of_the_whole_clip_is_refused_for_segments(tmp_path: Path) -> None:
    config = RunConfig(tmp_path, tmp_path, segment=2, truth=truth_of(tmp_path / "truth", (4.0, 4)))
    with pytest.raises(InputError, match="leave --segment or --truth out"):
        pipeline.check_truth(config)


def test_other_options_are_refused_before_the_scene_of_a_run_is_replaced(tmp_path: Path) -> None:
    config = RunConfig(tmp_path / "clip.mp4", tmp_path, max_size=160, minutes=2.0)
    write_json(tmp_path / pipeline.OPTIONS, options_for(config))
    options_for(replace(config, max_size=320))  # nothing was trained yet
    (tmp_path / "run/checkpoints").mkdir(parents=True)
    (tmp_path / "run/checkpoints/step_00000010.safetensors").touch()
    same = replace(config, minutes=None, device="cpu")
    assert options_for(same) == options_for(config)
    for changed in (replace(config, end=14), replace(config, max_size=320)):
        with pytest.raises(InputError, match=r"other options \(--(end|max-size)\)"):
            options_for(changed)
    (tmp_path / pipeline.OPTIONS).write_text("[1")
    with pytest.raises(InputError, match="damaged"):
        options_for(config)


@pytest.mark.parametrize("content", ['{"mine": 1}', "[]", "not JSON"])
def test_options_of_another_program_stay_where_they_are(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "prepare_scenes", lambda *_, **__: [])
    (tmp_path / pipeline.OPTIONS).write_text(content)
    with pytest.raises(InputError, match=f"{pipeline.OPTIONS}: .* not made by run;"):
        pipeline.run_all(RunConfig(tmp_path / "clip.mp4", tmp_path))
    assert (tmp_path / pipeline.OPTIONS).read_text() == content
