"""`bench` end to end on tiny scenes: the grid of runs, its tables, kills, failures,
lines for job arrays.
"""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bad_input import Capture, call, edit, refused, snapshot, truth
from toy_scene import ToyScene

from hdr_nsff.bench import bench
from hdr_nsff.scene.movers import write_movers
from hdr_nsff.training.run_folder import Run, last_logged, snapshots
from hdr_nsff.training.train import Trainer

COMMAND = [sys.executable, "-c", "from hdr_nsff.cli import main; main()"]
SMALL = "--field.encoding.max-rows 512 --field.samples 6 --field.render-samples 8 --rays 32 --moving-rays 8"


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """two/toy with its truth beside it, and three, whose frame 3 is held out."""
    root = tmp_path_factory.mktemp("scenes")
    ToyScene(32, 24).write(root / "two/toy")
    truth_of(root / "two/truth")
    ToyScene(32, 24).write(root / "three")
    edit(root / "three/scene.json", lambda m: m["frames"][3].update(split="test"))
    write_movers(root / "three/movers.npz", [])
    return root


def truth_of(folder: Path) -> None:
    """The truth of two frames of the toy scene, seen from the pose of another one."""
    truth(folder)
    edit(folder / "truth.json", lambda t: [v.update(anchor=v["anchor"] + 1) for v in t["views"]])


def words(scenes: Path, out: Path, methods: str, *more: object, steps: int = 4) -> list[str]:
    """A command on both scenes."""
    both = f"{scenes / 'two/toy'},{scenes / 'three'}"
    return [
        str(w)
        for w in (
            "bench",
            out,
            "--scenes",
            both,
            "--methods",
            methods,
            "--steps",
            steps,
            "--device",
            "cpu",
            *more,
        )
    ]


def rows(out: Path) -> dict[str, dict[str, str]]:
    """results.csv by run."""
    with open(out / "results.csv", newline="", encoding="utf-8") as file:
        return {f"{r['scene']}/{r['method']}": r for r in csv.DictReader(file)}


METHODS = f"a=tiny {SMALL},none=tiny {SMALL} --tonemap.kind none"


@pytest.fixture(scope="module")
def finished(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on two scenes, two processes at once."""
    out = tmp_path_factory.mktemp("bench") / "out"
    assert call(*words(scenes, out, METHODS, "--jobs", 2)) == 0
    return out


def test_the_tables_hold_the_numbers_of_evaluate(finished: Path) -> None:
    told = json.loads((finished / "results.json").read_text())
    assert list(rows(finished)) == ["toy/a", "toy/none", "three/a", "three/none"]
    for run in told["runs"]:
        name = f"{run['scene']}/{run['method']}"
        metrics = json.loads((finished / "runs" / name / "metrics.json").read_text())
        keys = (
            ("psnr", "ssim", "mu5000") if run["scene"] == "toy" else ("psnr", "psnr_moving", "ssim")
        )  # exact radiance, or a mask
        for key in keys:
            assert (
                run["values"][key] == metrics["headline"][key] == float(rows(finished)[name][key])
            )
        page, shown = (finished / "results.md").read_text(), f"{metrics['headline']['psnr']:.2f}"
        assert shown in page and shown in (finished / "index.html").read_text()
        trained = Run.open(finished / "runs" / name)
        assert (run["values"]["steps"], run["values"]["train_seconds"]) == (
            4,
            round(trained.seconds, 3),
        )
        assert run["values"]["memory_gb"] > 0.05 and run["values"]["frame_seconds"] > 0
    assert "camera.response_rmse" in told["runs"][0]["values"] and "mu5000" in told["columns"]


def test_means_are_over_all_scenes_and_name_the_best_and_the_worst(finished: Path) -> None:
    told = json.loads((finished / "results.json").read_text())
    value = {(r["scene"], r["method"]): r["values"]["psnr"] for r in told["runs"]}
    assert [m["method"] for m in told["means"]] == ["a", "none"]
    for mean in told["means"]:
        two = {s: value[s, mean["method"]] for s in ("toy", "three")}
        assert mean["values"]["psnr"] == pytest.approx(sum(two.values()) / 2) and mean[
            "scenes"
        ] == ["toy", "three"]
        assert (mean["best"], mean["worst"]) == (
            max(two, key=two.__getitem__),
            min(two, key=two.__getitem__),
        )


def test_curves_end_at_the_run_and_start_before(finished: Path) -> None:
    told = json.loads((finished / "results.json").read_text())
    for run in told["runs"]:
        assert [(p["share"], p["step"]) for p in run["curve"]] == [
            (0.125, 1),
            (0.25, 1),
            (0.5, 2),
            (1.0, 4),
        ]
        if run["values"]["views"] <= 4:  # then the curve is of all views, and ends at the headline
            assert run["curve"][-1]["scores"]["psnr"] == pytest.approx(run["values"]["psnr"])


def test_the_page_opens_offline_and_shows_curves_and_crops(finished: Path) -> None:
    page = (finished / "index.html").read_text()
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!data:|#)|url\((?!#)|@import|<script""", page)
    assert page.count("<svg") >= 4 and "PSNR moving, dB" in page
    assert (
        page.count("data:image/jpeg") >= 2 * 2 * 3
    )  # two scenes; pictures and errors; the truth (or the scale) and two methods
    assert "absolute error" in page and "0 to 0.25" in page


def test_when_all_is_there_the_same_command_only_writes_the_tables(
    scenes: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = snapshot(finished)
    (finished / "results.md").unlink()
    monkeypatch.setattr(bench, "run_jobs", lambda *_: pytest.fail("a run was started"))
    assert call(*words(scenes, finished, METHODS, "--jobs", 2)) == 0
    after = snapshot(finished)
    assert after.keys() == before.keys()
    assert {p.name for p in after if after[p] != before[p]} == set()


def test_lines_of_the_list_do_one_run_each(scenes: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "a b"
    assert call(*words(scenes, out, METHODS, "--jobs", 2, "--list")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and not out.exists()
    name, *arguments = shlex.split(lines[2])
    assert name == "hdr-nsff" and call(*arguments) == 0
    assert [p.parent.relative_to(out / "runs").as_posix() for p in out.rglob("trial.json")] == [
        "three/a"
    ]
    assert not (out / "results.csv").exists()
    assert call(*words(scenes, out, METHODS, "--collect")) == 1
    assert [r["status"] for r in rows(out).values()] == [
        "not finished",
        "not finished",
        "done",
        "not finished",
    ]


def test_a_run_that_fails_is_shown_and_the_others_go_on(
    scenes: Path, tmp_path: Path, capsys: Capture
) -> None:
    out, methods = tmp_path / "out", f"bad=tiny {SMALL},a=tiny {SMALL}"
    command = [
        "bench",
        out,
        "--scenes",
        scenes / "three",
        "--methods",
        methods,
        "--steps",
        4,
        "--views",
        0,
        "--device",
        "cpu",
    ]
    assert call(*command, "--collect") == 1  # nothing is there yet
    checkpoint = out / "runs/three/bad/checkpoints/step_00000001.safetensors"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes(b"cut short")
    capsys.readouterr()
    assert call(*command) == 1
    assert [r["status"] for r in rows(out).values()] == ["failed", "done"]
    reason = rows(out)["three/bad"]["reason"]
    assert "no readable checkpoint" in reason and str(out / "logs/three/bad.log") in reason
    for text in (
        (out / "results.md").read_text(),
        (out / "index.html").read_text(),
        capsys.readouterr().err,
    ):
        assert "no readable checkpoint" in text and "bad.log" in text
    assert [m["method"] for m in json.loads((out / "results.json").read_text())["means"]] == ["a"]
    checkpoint.unlink()
    assert call(*command) == 0 and [r["status"] for r in rows(out).values()] == [
        "done",
        "done",
    ]  # it is tried again


def test_an_error_of_ours_is_kept_with_its_kind(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nan(self: Trainer) -> None:
        raise FloatingPointError("step 3: not finite")

    monkeypatch.setattr(Trainer, "step", nan)
    command = words(scenes, tmp_path / "out", METHODS, "--only", "three/a")
    with pytest.raises(FloatingPointError):
        call(*command)
    told = json.loads((tmp_path / "out/runs/three/a/failure.json").read_text())
    assert told == {"reason": "FloatingPointError: step 3: not finite", "log": None}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_killed_in_the_middle_the_same_command_goes_on(
    number: signal.Signals, scenes: Path, tmp_path: Path
) -> None:
    """And the training ends with the process that waits for it, however that ended."""
    methods, run = f"a=tiny {SMALL} --checkpoint-seconds 0.2", tmp_path / "out/runs/toy/a"
    command = [
        "bench",
        tmp_path / "out",
        "--scenes",
        scenes / "two/toy",
        "--methods",
        methods,
        "--steps",
        300,
        "--views",
        1,
    ]
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from hdr_nsff.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, command), "--device", "cpu"],
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 180
    while last_logged(run) is None or not list(run.glob("checkpoints/step_*[1-9].safetensors")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(number)
    assert process.wait(timeout=60) == (130 if number == signal.SIGINT else -number)
    while any(
        str(run.parents[2]).encode() in read(p) for p in Path("/proc").glob("[0-9]*/cmdline")
    ):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    reached = Run.open(run).step
    assert 0 < reached < 300 and not (run / "metrics.json").exists()
    assert call(*command, "--device", "cpu") == 0
    assert f"going on at step {reached}," in (tmp_path / "out/logs/toy/a.log").read_text()
    assert Run.open(run).step == 300 and list(snapshots(run)) == [0.125, 0.25, 0.5]


def read(path: Path) -> bytes:
    """A process's command line; nothing once it has ended."""
    try:
        return path.read_bytes()
    except OSError:
        return b""


def test_a_run_at_work_is_not_done_twice(scenes: Path, tmp_path: Path, capsys: Capture) -> None:
    import fcntl

    command = words(scenes, tmp_path / "out", METHODS, "--only", "toy/a")
    (tmp_path / "out/runs/toy").mkdir(parents=True)
    (tmp_path / "out/bench.json").write_text(
        json.dumps({"settings": settings(command), "scenes": {}})
    )
    with open(tmp_path / "out/runs/toy/.a.lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert "another hdr-nsff works in" in refused(capsys, *command)
    assert not (tmp_path / "out/runs/toy/a/config.json").exists()


def settings(command: list[str]) -> dict[str, object]:
    """What bench.json holds of a command."""
    steps = int(command[command.index("--steps") + 1])
    return {
        "budget": None,
        "steps": steps,
        "protocol": None,
        "oracle": False,
        "views": 4,
        "max_size": 640,
        "seed": 0,
    }


def test_other_settings_in_the_same_folder_are_refused(
    scenes: Path, finished: Path, capsys: Capture
) -> None:
    before = snapshot(finished)
    assert "--steps 4, not 5" in refused(capsys, *words(scenes, finished, METHODS, steps=5))
    assert "other settings" in refused(
        capsys, *words(scenes, finished, f"a=tiny {SMALL} --loss.cycle 0.123")
    )
    moved = [
        w.replace(str(scenes / "two/toy"), f"toy={scenes / 'three'}").replace(
            f",{scenes / 'three'}", ""
        )
        for w in words(scenes, finished, METHODS)
    ]
    assert "another name" in refused(capsys, *moved)
    assert snapshot(finished) == before


def test_a_scene_that_changed_under_its_runs_is_refused(tmp_path: Path, capsys: Capture) -> None:
    scene = ToyScene(32, 24).write(tmp_path / "toy")
    command = [
        "bench",
        tmp_path / "out",
        "--scenes",
        scene,
        "--methods",
        f"a=tiny {SMALL}",
        "--steps",
        2,
        "--views",
        0,
        "--device",
        "cpu",
    ]
    assert call(*command, "--only", "toy/a") == 0
    edit(scene / "scene.json", lambda m: m.update(fps=25.0))
    assert "changed" in refused(capsys, *command, "--collect")


def test_environment_of_a_process_is_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    from hdr_nsff.bench.pool import THREADS, slots

    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    assert [s["OMP_NUM_THREADS"] for s in slots(3, None)] == ["2", "2", "2"] and slots(16, None)[0][
        "NUMBA_NUM_THREADS"
    ] == "1"
    assert [s["CUDA_VISIBLE_DEVICES"] for s in slots(1, "0, 3")] == [
        "0",
        "3",
    ] and "CUDA_VISIBLE_DEVICES" not in slots(1, None)[0]
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    assert slots(4, None)[0]["OMP_NUM_THREADS"] == slots(4, None)[0]["NUMBA_NUM_THREADS"] == "5"
