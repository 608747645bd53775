"""Benchmarks start, explain themselves, and record what their numbers depend on."""

from __future__ import annotations

import argparse
import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
HELPERS = ("record", "results", "step_errors")
NAMES = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem not in HELPERS)


@pytest.fixture
def record(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module("record")


@pytest.mark.parametrize("name", NAMES)
def test_the_help_of_a_benchmark_shows_its_command_and_its_file(
    name: str,
    record: ModuleType,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as stop:
        benchmark.main()
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert f"python benchmarks/{name}.py" in text
    assert f"benchmarks/results/{name}.json" in " ".join(text.split())


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
