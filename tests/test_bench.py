"""`bench` end to end on tiny scenes: the table of runs, kills, failures, lines for job
arrays.
"""

from __future__ import annotations

import contextlib
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
import torch
from bad_input import Capture, call, edit, refused, snapshot, truth
from toy_scene import ToyScene

from hdr_nsff import __version__
from hdr_nsff.bench import bench
from hdr_nsff.core.exr import read_exr, write_exr
from hdr_nsff.scene.movers import write_movers
from hdr_nsff.training.run_folder import Run, last_logged, snapshots
from hdr_nsff.training.train import Trainer

SMALL = (
    "--field.samples 6 --field.render-samples 8 --set field.encoding.max_rows=512 "
    "--rays 32 --moving-rays 8"
)


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


def bench_words(
    out: Path, scenes: object, methods: str, *more: object, steps: int = 4
) -> list[str]:
    """A command."""
    words = ["bench", out, "--scenes", scenes, "--methods", methods, "--steps", steps]
    return [str(word) for word in (*words, "--device", "cpu", *more)]


def on_both(scenes: Path, out: Path, methods: str, *more: object, steps: int = 4) -> list[str]:
    """A command on both scenes."""
    both = f"{scenes / 'two/toy'},{scenes / 'three'}"
    return bench_words(out, both, methods, *more, steps=steps)


def rows(out: Path) -> dict[str, dict[str, str]]:
    """results.csv by run."""
    with open(out / "results.csv", newline="", encoding="utf-8") as file:
        return {f"{r['scene']}/{r['method']}": r for r in csv.DictReader(file)}


METHODS = f"a=tiny {SMALL},none=tiny {SMALL} --tonemap.kind none"


@pytest.fixture(scope="module")
def finished(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on two scenes, two processes at once."""
    out = tmp_path_factory.mktemp("bench") / "out"
    assert call(*on_both(scenes, out, METHODS, "--jobs", 2)) == 0
    return out


def results(out: Path) -> dict:
    """results.json."""
    return json.loads((out / "results.json").read_text())


def test_the_tables_hold_the_numbers_of_evaluate(finished: Path) -> None:
    assert list(rows(finished)) == ["toy/a", "toy/none", "three/a", "three/none"]
    scores = {"toy": ("psnr", "ssim", "mu5000"), "three": ("psnr", "psnr_moving", "ssim")}
    for run in results(finished)["runs"]:
        name = f"{run['scene']}/{run['method']}"
        metrics = json.loads((finished / "runs" / name / "metrics.json").read_text())
        for key in scores[run["scene"]]:
            in_csv = float(rows(finished)[name][key])
            assert run["values"][key] == metrics["headline"][key] == in_csv
        shown = f"{metrics['headline']['psnr']:.2f}"
        for page in ("results.md", "index.html"):
            assert shown in (finished / page).read_text()


def test_the_tables_hold_what_the_runs_cost(finished: Path) -> None:
    found = results(finished)
    for run in found["runs"]:
        trained = Run.open(finished / "runs" / run["scene"] / run["method"])
        values = run["values"]
        assert values["steps"] == 4 and values["train_seconds"] == round(trained.seconds, 3)
        assert values["memory_gb"] > 0.05 and values["frame_seconds"] > 0
    assert "camera.response_rmse" in found["runs"][0]["values"] and "mu5000" in found["columns"]


def test_every_run_names_its_machine_program_and_seed(finished: Path) -> None:
    found = results(finished)
    for run in found["runs"]:
        machine = run["machine"]
        assert machine == found["machine"]
        assert machine["cpu"] and machine["cores"] == os.cpu_count()
        assert machine["torch"] == torch.__version__ and machine["version"] == __version__
        assert (run["device"], run["seed"], found["seed"]) == ("cpu", 0, 0)
        assert int(run["threads"]) >= 1
        for page in ("results.md", "index.html"):
            assert f"torch {torch.__version__}" in (finished / page).read_text()


def test_means_are_over_all_scenes_and_name_the_best_and_the_worst(finished: Path) -> None:
    found = results(finished)
    psnr = {(run["scene"], run["method"]): run["values"]["psnr"] for run in found["runs"]}
    assert [mean["method"] for mean in found["means"]] == ["a", "none"]
    for mean in found["means"]:
        two = {scene: psnr[scene, mean["method"]] for scene in ("toy", "three")}
        assert mean["values"]["psnr"] == pytest.approx(sum(two.values()) / 2)
        assert mean["scenes"] == ["toy", "three"]
        assert mean["best"] == max(two, key=two.__getitem__)
        assert mean["worst"] == min(two, key=two.__getitem__)


def test_curves_end_at_the_run_and_start_before(finished: Path) -> None:
    for run in results(finished)["runs"]:
        points = [(point["share"], point["step"]) for point in run["curve"]]
        assert points == [(0.125, 1), (0.25, 1), (0.5, 2), (0.8, 4), (1.0, 4)]
        if run["values"]["views"] <= 4:  # then the curve is of all views, and ends at the headline
            assert run["curve"][-1]["scores"]["psnr"] == pytest.approx(run["values"]["psnr"])


def test_the_page_opens_offline_and_shows_curves_and_crops(finished: Path) -> None:
    page = (finished / "index.html").read_text()
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!data:|#)|url\((?!#)|@import|<script""", page)
    assert page.count("<svg") >= 4 and "PSNR moving, dB" in page
    # Two scenes; pictures and errors; the truth (or the scale) and two methods.
    assert page.count("data:image/jpeg") >= 2 * 2 * 3
    assert "absolute error" in page and "0 to 0.25" in page


def test_when_all_is_there_the_same_command_only_writes_the_tables(
    scenes: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = snapshot(finished)
    (finished / "results.md").unlink()
    monkeypatch.setattr(bench, "run_jobs", lambda *_: pytest.fail("a run was started"))
    assert call(*on_both(scenes, finished, METHODS, "--jobs", 2)) == 0
    assert snapshot(finished) == before


def test_a_run_that_was_evaluated_otherwise_is_measured_again(scenes: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = bench_words(out, scenes / "two/toy", f"a=tiny {SMALL}", "--views", 0)
    assert call(*command) == 0
    before = rows(out)["toy/a"]["psnr"]
    assert call("evaluate", out / "runs/toy/a", "--device", "cpu") == 0  # on training views
    assert call(*command, "--collect") == 1
    assert call(*command) == 0
    assert rows(out)["toy/a"]["psnr"] == before


def test_a_run_is_measured_again_when_pictures_of_the_truth_change(tmp_path: Path) -> None:
    ToyScene(32, 24).write(tmp_path / "toy")
    truth_of(tmp_path / "truth")
    command = bench_words(tmp_path / "out", tmp_path / "toy", f"a=tiny {SMALL}", "--views", 0)
    assert call(*command) == 0
    before = rows(tmp_path / "out")["toy/a"]["psnr"]
    picture = sorted((tmp_path / "truth").rglob("*.exr"))[0]
    write_exr(picture, {"RGB": read_exr(picture)["RGB"][::-1]})
    assert call(*command, "--collect") == 1
    assert call(*command) == 0
    assert rows(tmp_path / "out")["toy/a"]["psnr"] != before


def test_lines_of_the_list_do_one_run_each(scenes: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "a b"
    assert call(*on_both(scenes, out, METHODS, "--jobs", 2, "--list")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and not out.exists()
    name, *arguments = shlex.split(lines[2])
    assert name == "hdr-nsff" and call(*arguments) == 0
    records = [path.parent.relative_to(out / "runs") for path in out.rglob("run_record.json")]
    assert records == [Path("three/a")]
    assert not (out / "results.csv").exists()
    assert call(*on_both(scenes, out, METHODS, "--collect")) == 1
    waiting = "not finished"
    assert statuses(out) == [waiting, waiting, "done", waiting]


def statuses(out: Path) -> list[str]:
    """The statuses of all runs."""
    return [row["status"] for row in rows(out).values()]


def test_a_failed_run_is_shown_and_the_others_continue(
    scenes: Path, tmp_path: Path, capsys: Capture
) -> None:
    out, methods = tmp_path / "out", f"bad=tiny {SMALL},a=tiny {SMALL}"
    command = bench_words(out, scenes / "three", methods, "--views", 0)
    assert call(*command, "--collect") == 1  # nothing is there yet
    checkpoint = out / "runs/three/bad/checkpoints/step_00000001.safetensors"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes(b"cut short")
    capsys.readouterr()
    assert call(*command) == 1
    assert statuses(out) == ["failed", "done"]
    reason = rows(out)["three/bad"]["reason"]
    assert "no readable checkpoint" in reason and str(out / "logs/three/bad.log") in reason
    pages = [(out / name).read_text() for name in ("results.md", "index.html")]
    for text in (*pages, capsys.readouterr().err):
        assert "no readable checkpoint" in text and "bad.log" in text
    assert [mean["method"] for mean in results(out)["means"]] == ["a"]
    checkpoint.unlink()
    assert call(*command) == 0  # it is tried again
    assert statuses(out) == ["done", "done"]


def test_an_error_of_ours_is_kept_with_its_kind(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nan(self: Trainer) -> None:
        raise FloatingPointError("step 3: not finite")

    monkeypatch.setattr(Trainer, "step", nan)
    command = on_both(scenes, tmp_path / "out", METHODS, "--only", "three/a")
    with pytest.raises(FloatingPointError):
        call(*command)
    note = json.loads((tmp_path / "out/runs/three/a/failure.json").read_text())
    assert note == {"reason": "FloatingPointError: step 3: not finite", "log": None}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_bench_continues_with_the_same_command(
    number: signal.Signals, scenes: Path, tmp_path: Path
) -> None:
    """And the training ends with the process that waits for it, however that ended."""
    methods, run = f"a=tiny {SMALL} --checkpoint-seconds 0.2", tmp_path / "out/runs/toy/a"
    scene = scenes / "two/toy"
    command = bench_words(tmp_path / "out", scene, methods, "--views", 1, steps=300)
    interruptible = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{interruptible}; from hdr_nsff.cli import main; main()"
    process = subprocess.Popen([sys.executable, "-c", code, *command], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 180
    while last_logged(run) is None or not list(run.glob("checkpoints/step_*[1-9].safetensors")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(number)
    assert process.wait(timeout=60) == (130 if number == signal.SIGINT else -number)
    while any(str(run.parents[2]).encode() in line for line in command_lines()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    reached = Run.open(run).step
    assert 0 < reached < 300 and not (run / "metrics.json").exists()
    assert call(*command) == 0
    assert f"continuing at step {reached}," in (tmp_path / "out/logs/toy/a.log").read_text()
    assert Run.open(run).step == 300 and list(snapshots(run)) == [0.125, 0.25, 0.5, 0.8]


def command_lines() -> list[bytes]:
    """The command lines of all processes."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it has ended
            found.append(path.read_bytes())
    return found


def test_a_run_at_work_is_not_done_twice(scenes: Path, tmp_path: Path, capsys: Capture) -> None:
    import fcntl

    command = on_both(scenes, tmp_path / "out", METHODS, "--only", "toy/a")
    (tmp_path / "out/runs/toy").mkdir(parents=True)
    note = {"settings": settings(command), "scenes": {}}
    (tmp_path / "out/bench.json").write_text(json.dumps(note))
    with open(tmp_path / "out/runs/toy/.a.lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert "another hdr-nsff works in" in refused(capsys, *command)
    assert not (tmp_path / "out/runs/toy/a/config.json").exists()


def settings(command: list[str]) -> dict[str, object]:
    """The settings of a command in bench.json."""
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
    longer = on_both(scenes, finished, METHODS, steps=5)
    assert "--steps 4, not 5" in refused(capsys, *longer)
    weighted = on_both(scenes, finished, f"a=tiny {SMALL} --loss.flow 0.123")
    assert "other settings" in refused(capsys, *weighted)
    moved = bench_words(finished, f"toy={scenes / 'three'}", METHODS)
    assert "another name" in refused(capsys, *moved)
    assert snapshot(finished) == before


def test_a_scene_that_changed_under_its_runs_is_refused(tmp_path: Path, capsys: Capture) -> None:
    scene = ToyScene(32, 24).write(tmp_path / "toy")
    command = bench_words(tmp_path / "out", scene, f"a=tiny {SMALL}", "--views", 0, steps=2)
    assert call(*command, "--only", "toy/a") == 0
    edit(scene / "scene.json", lambda m: m.update(fps=25.0))
    assert "changed" in refused(capsys, *command, "--collect")
