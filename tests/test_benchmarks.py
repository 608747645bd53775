"""Benchmarks start, explain themselves, and record what their numbers depend on."""

from __future__ import annotations

import argparse
import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest
import torch
from bad_input import poses

from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.presets import PRESETS

FOLDER = Path(__file__).parents[1] / "benchmarks"
HELPERS = ("markdown_tables", "record", "result_tables", "results", "step_errors")
NAMES = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem not in HELPERS)


@pytest.fixture
def record(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module("record")


def load(name: str) -> ModuleType:
    """A benchmark as a module; the fixture `record` makes its imports possible."""
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NAMES)
def test_the_help_of_a_benchmark_shows_its_command_and_its_file(
    name: str,
    record: ModuleType,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    benchmark = load(name)
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as stop:
        benchmark.main()
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert f"python benchmarks/{name}.py" in text
    assert "benchmarks/results/" in text


def test_a_record_names_machine_commit_seed_and_date(record: ModuleType, tmp_path: Path) -> None:
    args = argparse.Namespace(out=tmp_path / "speed.json", steps=3)
    speed = record.Record("speed", args, seed=5)
    speed.add({"steps_per_second": 7.5})
    document = json.loads(speed.save().read_text())
    keys = ["benchmark", "machine", "commit", "dirty", "seed", "date", "settings", "results"]
    assert list(document) == keys
    assert document["benchmark"] == "speed" and document["seed"] == 5
    assert document["machine"]["cores"] >= 1 and document["date"].endswith("+00:00")
    assert document["settings"] == {"steps": 3}
    assert document["results"] == [{"steps_per_second": 7.5}]


def test_a_record_holds_names_instead_of_paths(record: ModuleType, tmp_path: Path) -> None:
    args = argparse.Namespace(out=tmp_path / "poses.json", scene=tmp_path / "lamp" / "scene")
    poses = record.Record("poses", args)
    poses.add({"scene": tmp_path / "lamp", "error": float("nan")})
    text = poses.save().read_text()
    assert str(tmp_path) not in text
    document = json.loads(text)
    assert document["settings"] == {"scene": "lamp/scene"}
    assert document["results"] == [{"scene": "lamp", "error": None}]


def run_benchmark(name: str, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> list[dict]:
    """The results of a benchmark that runs in this process."""
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")  # set, so that it does not restart
    monkeypatch.setattr("sys.argv", [f"{name}.py", *map(str, arguments)])
    load(name).main()
    out = Path(str(arguments[arguments.index("--out") + 1]))
    results: list[dict] = json.loads(out.read_text())["results"]
    return results


def test_speed_is_measured_for_every_preset(
    record: ModuleType, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--preset", "tiny", "grid", "--steps", 1, "--warm-up", 0, "--device", "cpu"]
    out = tmp_path / "speed.json"
    rows = run_benchmark("speed", monkeypatch, toy_folder, *options, "--out", out)
    assert [row["preset"] for row in rows] == ["tiny", "grid"]
    assert all(row["steps_per_second"] > 0 for row in rows)


def test_the_poses_of_a_scene_have_no_error_against_themselves(
    record: ModuleType, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = poses(tmp_path / "poses_bounds.npy", count=6)  # of the toy scene
    out = tmp_path / "poses.json"
    (row,) = run_benchmark("poses", monkeypatch, toy_folder, given, "--out", out)
    assert row["registered"] == 1
    assert row["ate"] == pytest.approx(0, abs=1e-9)
    assert row["focal_error"] == pytest.approx(0, abs=1e-9)


def test_every_loss_weight_can_be_left_out(record: ModuleType) -> None:
    benchmark, full = load("loss_weights"), PRESETS["splat"]
    runs = benchmark.runs_without(full, None)
    assert {"no depth", "no trajectory", "no gain_residual"} <= set(runs)
    for name, config in runs.items():
        if name.startswith("no "):
            assert benchmark.weights_by_name(config)[name.removeprefix("no ")] == 0


def test_the_clip_of_the_cost_benchmark_continues_backwards(record: ModuleType, toy: Scene) -> None:
    frames = load("cost").repeat_frames(toy.train, 9)
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4, 5, 5, 4, 3]
    assert [frame.time for frame in frames] == list(range(9))
    assert frames[6].flow == {}


def test_times_of_runs_with_other_threads_are_not_compared(record: ModuleType) -> None:
    tables = importlib.import_module("result_tables")
    keys = ("commit", "threads", "scene", "values")
    found = [("a", 1, "plain", 30.0), ("a", 1, "plain-readout", 27.0), ("b", 2, "plain", 15.0)]
    runs = [{"method": "splat", **dict(zip(keys, run, strict=True))} for run in found]
    places = [("plain", "splat"), ("plain-readout", "splat")]
    assert tables.of_one_program(runs, places) == [30.0, 27.0]
    assert tables.of_one_program(runs, places[:1]) == [15.0]


def test_a_run_of_changed_files_is_named_so_below_its_table(record: ModuleType) -> None:
    tables = importlib.import_module("result_tables")
    machine = {"cores": 2, "cpu": "EPYC", "torch": "2"}
    runs = [{"commit": f"{'0' * 40}-dirty"}, {"commit": "1" * 40}]
    document = {"machine": machine, "dirty": False, "seed": 0, "date": "2026", "results": runs}
    line = tables.origin(document)
    assert "commit 000000000 with changes, 111111111, seed 0" in line


def test_where_nothing_draws_on_the_gpu_no_twins_are_compared(
    record: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    gpu = load("gpu")
    nothing = gpu.cuda_backends.Backend(None, "no compiler", "no compiler")
    monkeypatch.setattr(gpu.cuda_backends, "find_backend", lambda device: nothing)
    found = gpu.compare_twins(torch.device("cuda"))
    assert found == {"error": "nothing draws Gaussians on the GPU: no compiler"}


def test_a_difference_that_is_not_a_number_is_an_error(record: ModuleType) -> None:
    gpu = load("gpu")
    error = gpu.relative_error(torch.tensor([1.0, torch.nan]), torch.ones(2))
    assert not gpu.within(0.1, {"means": error, "maps": 0.0})
    assert gpu.within(0.1, {"means": gpu.relative_error(torch.zeros(2), torch.zeros(2))})
