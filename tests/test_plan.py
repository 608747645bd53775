"""The plan of a benchmark: its runs and their folders, and the sentences that refuse
settings and folders.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from bad_input import Capture, call, refused
from test_bench_scenes import made

from hdr_nsff.bench.bench import MEASURING_SHARE, share_done
from hdr_nsff.bench.config import BenchConfig, BenchRun
from hdr_nsff.bench.plan import check_run, claim, make_plan
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_text
from hdr_nsff.scene.scene import Manifest
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import open_folder, stored_config


def runs_of(
    tmp_path: Path, scenes: object, methods: str = "tiny", **more: Any
) -> tuple[BenchRun, ...]:
    """The runs of a benchmark."""
    return make_plan(BenchConfig(tmp_path / "out", str(scenes), methods, **more)).runs


def bench_words(out: Path, scenes: object, methods: str = "tiny") -> list[object]:
    """A command."""
    return ["bench", out, "--scenes", scenes, "--methods", methods, "--device", "cpu"]


def test_every_method_runs_on_every_scene(toy_folder: Path, tmp_path: Path) -> None:
    scenes = f"one={toy_folder},two={toy_folder}"
    runs = runs_of(tmp_path, scenes, "tiny,grid")
    assert [run.name for run in runs] == ["one/tiny", "one/grid", "two/tiny", "two/grid"]
    assert [run.folder for run in runs][:2] == [
        tmp_path / "out/runs/one/tiny",
        tmp_path / "out/runs/one/grid",
    ]
    assert {run.config.scene for run in runs} == {toy_folder}


def test_names_of_the_command_line_never_leave_the_folder(toy_folder: Path, tmp_path: Path) -> None:
    (run,) = runs_of(tmp_path, f"../../up={toy_folder}", "../../../x=tiny --rays 32")
    assert run.folder.resolve().is_relative_to(tmp_path / "out/runs")
    assert run.log.resolve().is_relative_to(tmp_path / "out/logs")
    assert run.name == "up/x"


def test_a_preset_is_trained_as_train_does(toy_folder: Path, tmp_path: Path) -> None:
    (run,) = runs_of(tmp_path, toy_folder, "splat")
    for name in ("loss", "field", "tonemap", "budget", "seed"):
        assert getattr(run.config, name) == getattr(PRESETS["splat"], name)


def test_a_clip_is_prepared_once_for_all_methods(tmp_path: Path) -> None:
    folder = made(tmp_path / "room")
    small = "--set field.encoding.max_rows=512 --field.samples 6 --rays 32 --moving-rays 8"
    methods = f"a=tiny {small},b=tiny {small}"
    command = [*bench_words(tmp_path / "out", folder, methods), "--steps", 2, "--views", 0]
    assert call(*command, "--only", "room") == 0
    scene = tmp_path / "out/scenes/room"
    before = (scene / "scene.json").read_bytes()
    assert all(step.done for step in Manifest.load(scene).steps.values())
    for name in ("room/a", "room/b"):
        assert call(*command, "--only", name) == 0
    assert call(*command, "--collect") == 0
    assert (scene / "scene.json").read_bytes() == before


# What is refused


def bad(
    capsys: Capture, tmp_path: Path, *more: object, scenes: object, methods: str = "tiny"
) -> str:
    """The sentence that refuses a command, which writes nothing."""
    sentence = refused(capsys, *bench_words(tmp_path / "out", scenes, methods), *more)
    assert not (tmp_path / "out").exists()
    return sentence


def test_two_scenes_or_methods_of_one_name(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    twice = f"{toy_folder},{toy_folder}"
    assert "two are called 'scene'" in bad(capsys, tmp_path, scenes=twice)
    assert "two are called 'tiny'" in bad(capsys, tmp_path, scenes=toy_folder, methods="tiny,tiny")


def test_settings_that_make_no_sense(toy_folder: Path, tmp_path: Path, capsys: Capture) -> None:
    for option, value in (
        ("--jobs", 0),
        ("--max-size", -4),
        ("--views", -1),
        ("--steps", 0),
        ("--budget", "soon"),
        ("--devices", "0,,1"),
        ("--device", "gpu7"),
        ("--lpips", "nowhere.pth"),
    ):
        sentence = bad(capsys, tmp_path, option, value, scenes=toy_folder)
        assert option in sentence or str(value) in sentence


def test_settings_that_exclude_each_other(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    both = ("--budget", "5min", "--steps", 3)
    assert "both given" in bad(capsys, tmp_path, *both, scenes=toy_folder)
    both = ("--devices", "0,1", "--jobs", 2)
    assert "leave --jobs out" in bad(capsys, tmp_path, *both, scenes=toy_folder)


def test_a_run_outside_the_plan_is_refused(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    assert "scene/tiny" in bad(capsys, tmp_path, "--only", "../tiny", scenes=toy_folder)


@pytest.mark.parametrize(
    ("before", "now", "difference"),
    [
        ({"steps": 5}, {}, "with --steps 5, not without it;"),
        ({}, {"steps": 5}, "without --steps, not with --steps 5;"),
        ({"steps": 5}, {"steps": 7}, "with --steps 5, not 7;"),
        ({}, {"oracle": True}, "without --oracle, not with it;"),
    ],
)
def test_a_setting_that_is_not_given_is_said_to_be_left_out(
    before: dict[str, Any], now: dict[str, Any], difference: str, toy_folder: Path, tmp_path: Path
) -> None:
    config = BenchConfig(tmp_path, str(toy_folder), "tiny", device="cpu")
    plan = make_plan(replace(config, **before))
    claim(plan)
    write_text(tmp_path / "runs/scene/tiny/config.json", "{}")
    with pytest.raises(InputError, match=difference):
        claim(replace(plan, config=replace(config, **now)))


def test_settings_with_which_nothing_was_made_may_change(toy_folder: Path, tmp_path: Path) -> None:
    config = BenchConfig(tmp_path, str(toy_folder), "tiny", device="cpu", steps=5)
    for steps in (5, None, 7):
        claim(make_plan(replace(config, steps=steps)))
    assert json.loads((tmp_path / "bench.json").read_text())["settings"]["steps"] == 7


def test_a_folder_of_other_files_is_left_alone(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/results.csv").write_text("mine")
    command = bench_words(tmp_path / "mine", toy_folder)
    assert "holds other files" in refused(capsys, *command)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["results.csv"]


def test_an_open_budget_is_that_of_the_run(toy_folder: Path, tmp_path: Path) -> None:
    (run,) = runs_of(tmp_path, toy_folder, "splat")
    assert run.config.budget == Budget()
    assert share_done(run) == 0  # nothing is there yet
    started = replace(run.config, budget=Budget(minutes=2.0))  # as `train` completes it
    open_folder(started)
    line = {"step": 5, "seconds": 60.0, "psnr": 20.0, "rays_per_second": 1.0, "losses": {}}
    (run.folder / "log.jsonl").write_text(json.dumps(line) + "\n", encoding="utf-8")
    assert share_done(run) == pytest.approx((1 - MEASURING_SHARE) / 2)
    check_run(run)  # the same command continues
    assert stored_config(run.folder)[0] == started
    other = replace(run, config=replace(run.config, budget=Budget(minutes=3.0)))
    with pytest.raises(InputError, match="other settings"):
        check_run(other)
