"""What `bench` is asked for: scenes, methods and budgets in words, what they come to,
and the sentences that refuse the rest.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_input import FRAMES, Capture, call, edit, poses, refused, truth
from bad_input import clip as frames_of
from toy_scene import ToyScene, camera_center

from hdr_nsff.bench import tables
from hdr_nsff.bench.curve import spread
from hdr_nsff.bench.plan import (
    BenchConfig,
    BenchRun,
    BenchScene,
    arguments,
    make_plan,
    minutes_of,
    safe_name,
)
from hdr_nsff.bench.pool import last_words
from hdr_nsff.bench.tables import Row, best_cells, means
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.notes import RunRecord, Trained
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.synth.oracle import NOTE
from hdr_nsff.training.presets import PRESETS


@pytest.mark.parametrize(
    ("text", "minutes"),
    [("5min", 5), ("90s", 1.5), ("0.5h", 30), ("2 m", 2), (".5min", 0.5), ("30SEC", 0.5)],
)
def test_a_budget_in_words(text: str, minutes: float) -> None:
    assert minutes_of(text) == pytest.approx(minutes)


@pytest.mark.parametrize(
    "text", ["5", "min", "", "-5min", "5 days", "0s", "nan s", "1e9h", "5min3s"]
)
def test_a_budget_that_is_none(text: str) -> None:
    with pytest.raises(InputError, match=r"5min, 90s or 0\.5h"):
        minutes_of(text)


@pytest.mark.parametrize(
    "text", ["../../etc", "/abs", "a/b", "..", "a\0b", "-x", "é b", "x" * 300, ".hidden"]
)
def test_names_stay_inside_the_folder(text: str, tmp_path: Path) -> None:
    try:
        name = safe_name(text, "--scenes")
    except InputError:
        return
    place = (tmp_path / "runs" / name).resolve()
    assert place.parent == tmp_path / "runs" and len(name) <= 60 and name == place.name
    place.mkdir(parents=True)


def plan(tmp_path: Path, scenes: str, methods: str = "tiny", **more: Any) -> tuple[BenchRun, ...]:
    """The runs that are asked for."""
    return make_plan(BenchConfig(tmp_path / "out", scenes, methods, **more)).cells


def test_names_of_the_command_line_never_leave_the_folder(toy_folder: Path, tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, f"../../up={toy_folder}", "../../../x=tiny --rays 32")
    assert cell.folder.resolve().is_relative_to(
        tmp_path / "out/runs"
    ) and cell.log.resolve().is_relative_to(tmp_path / "out/logs")
    assert cell.name == "up/x"


def test_methods_are_presets_with_the_same_budget_for_all(toy_folder: Path, tmp_path: Path) -> None:
    methods = ",".join([*PRESETS, "mine=splat --loss.depth 0 --field.bases 3"])
    cells = plan(tmp_path, str(toy_folder), methods, budget="90s", seed=5)
    assert [c.method for c in cells] == [*PRESETS, "mine"]
    assert {(c.config.minutes, c.config.steps, c.config.seed) for c in cells} == {(1.5, None, 5)}
    mine = cells[-1].config
    assert (mine.loss.depth, mine.field.bases) == (0.0, 3) and mine.loss.flow == PRESETS[
        "splat"
    ].loss.flow
    assert (
        replace(cells[0].config, scene=Path("scene"), out=Path("run"), minutes=5.0, seed=0)
        == PRESETS["splat"]
    )
    assert [c.config.steps for c in plan(tmp_path, str(toy_folder), "paper,tiny")] == [
        PRESETS["paper"].steps,
        PRESETS["tiny"].steps,
    ]


def test_a_line_asks_for_what_the_whole_asks_for(toy_folder: Path, tmp_path: Path) -> None:
    config = BenchConfig(
        tmp_path / "out",
        str(toy_folder),
        "x=tiny --rays 32",
        steps=7,
        oracle=False,
        jobs=3,
        lpips="w",
        views=2,
    )
    verb, out, *rest = arguments(config, "scene/x")
    assert (verb, out) == ("bench", str(tmp_path / "out"))
    assert rest == [
        f"--scenes={toy_folder}",
        "--methods=x=tiny --rays 32",
        "--steps=7",
        "--lpips=w",
        "--views=2",
        "--only",
        "scene/x",
    ]


def test_where_the_truth_of_a_scene_is_found(toy_folder: Path, tmp_path: Path) -> None:
    scene = shutil.copytree(toy_folder, tmp_path / "a/scene")
    assert plan(tmp_path, str(scene))[0].scene.truth is None
    for place in ("a/scene_truth", "a/truth", "a/scene/truth", "b"):
        truth(tmp_path / place)
        given = f"{scene}:{tmp_path / place}" if place == "b" else str(scene)
        assert plan(tmp_path, given)[0].scene.truth == tmp_path / place


def made(folder: Path) -> Path:
    """A folder as `synth --oracle` leaves it, of the toy scene; with the poses that
    `reexpose` would add.
    """
    frames_of(folder / "clip")
    truth(folder / "truth")
    centers = [np.c_[np.eye(3), camera_center(t)].tolist() for t in range(FRAMES)]
    edit(folder / "truth/truth.json", lambda t: t.update(clip_c2w=centers))
    poses(folder / "poses_bounds.npy")
    ToyScene().write(folder / "oracle")
    edit(
        folder / "oracle/scene.json",
        lambda m: m["steps"].update(poses={"done": True, "note": NOTE}),
    )
    return folder


def test_a_folder_of_synth_is_prepared_or_taken_for_an_oracle(tmp_path: Path) -> None:
    folder = made(tmp_path / "room")
    scene = plan(tmp_path, str(folder))[0].scene
    assert (
        scene.name == "room" and scene.footage is not None and not scene.oracle and not scene.ready
    )
    assert (scene.footage.clip, scene.footage.poses) == (
        folder / "clip",
        folder / "poses_bounds.npy",
    )
    assert scene.folder == tmp_path / "out/scenes/room" and scene.truth == folder / "truth"
    assert scene.footage.hold_out == 2  # the toy's truth is of frames 1 and 3
    oracle = plan(tmp_path, str(folder), oracle=True)[0].scene
    assert (oracle.name, oracle.folder, oracle.oracle) == (
        "room-oracle",
        folder / "oracle",
        True,
    ) and oracle.ready
    assert plan(tmp_path, f"room={folder / 'oracle'}")[0].scene == replace(
        oracle
    )  # recognized by what its manifest says
    assert (
        plan(tmp_path, str(folder), protocol="novel-view")[0].scene.footage.protocol == "novel-view"
    )  # type: ignore[union-attr]


def test_a_clip_is_prepared_once_for_all_methods(tmp_path: Path) -> None:
    folder, small = (
        made(tmp_path / "room"),
        "--field.encoding.max-rows 512 --field.samples 6 --rays 32 --moving-rays 8",
    )
    methods = f"a=tiny {small},b=tiny {small}"
    command = [
        "bench",
        tmp_path / "out",
        "--scenes",
        folder,
        "--methods",
        methods,
        "--steps",
        2,
        "--views",
        0,
        "--device",
        "cpu",
    ]
    assert call(*command, "--only", "room") == 0
    before = (tmp_path / "out/scenes/room/scene.json").read_bytes()
    assert all(step.done for step in Manifest.load(tmp_path / "out/scenes/room").steps.values())
    for name in ("room/a", "room/b"):
        assert call(*command, "--only", name) == 0
    assert call(*command, "--collect") == 0
    assert (tmp_path / "out/scenes/room/scene.json").read_bytes() == before


# What is refused


def bad(
    capsys: Capture, tmp_path: Path, *more: object, scenes: object, methods: str = "tiny"
) -> str:
    said = refused(
        capsys,
        "bench",
        tmp_path / "out",
        "--scenes",
        scenes,
        "--methods",
        methods,
        "--device",
        "cpu",
        *more,
    )
    assert not (tmp_path / "out").exists()
    return said


def test_methods_that_are_none(toy_folder: Path, tmp_path: Path, capsys: Capture) -> None:
    said = bad(capsys, tmp_path, scenes=toy_folder, methods="splat,sparkle")
    assert "'sparkle'" in said and all(p in said for p in PRESETS)
    assert "no preset" in bad(capsys, tmp_path, scenes=toy_folder, methods="")
    assert "two are called 'tiny'" in bad(capsys, tmp_path, scenes=toy_folder, methods="tiny,tiny")
    assert "name of its own" in bad(capsys, tmp_path, scenes=toy_folder, methods="tiny --rays 3")
    assert "same for all" in bad(capsys, tmp_path, scenes=toy_folder, methods="x=tiny --steps 3")
    assert "mend the quotes" in bad(capsys, tmp_path, scenes=toy_folder, methods="x=tiny 'a")
    assert "--rays" in bad(capsys, tmp_path, scenes=toy_folder, methods="x=tiny --rays -1")


def test_scenes_that_are_none(toy_folder: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "empty").mkdir()
    assert "no such folder" in bad(capsys, tmp_path, scenes=tmp_path / "nowhere")
    assert "no such folder" in bad(capsys, tmp_path, scenes="")
    assert "no scene.json" in bad(capsys, tmp_path, scenes=tmp_path / "empty")
    assert "no truth.json" in bad(capsys, tmp_path, scenes=f"{toy_folder}:{tmp_path / 'empty'}")
    assert "two are called 'scene'" in bad(capsys, tmp_path, scenes=f"{toy_folder},{toy_folder}")
    assert "no oracle/" in bad(
        capsys, tmp_path, "--oracle", scenes=without_oracle(tmp_path / "room")
    )
    assert "made from footage" in bad(capsys, tmp_path, "--oracle", scenes=toy_folder)
    assert "is prepared already, for none" in bad(
        capsys, tmp_path, "--protocol", "novel-view-time", scenes=toy_folder
    )


def without_oracle(folder: Path) -> Path:
    shutil.rmtree(made(folder) / "oracle")
    return folder


def test_settings_that_make_no_sense(toy_folder: Path, tmp_path: Path, capsys: Capture) -> None:
    for option, value in (
        ("--jobs", 0),
        ("--views", -1),
        ("--steps", 0),
        ("--budget", "soon"),
        ("--devices", "0,,1"),
    ):
        assert option in bad(capsys, tmp_path, option, value, scenes=toy_folder)
    assert "both given" in bad(
        capsys, tmp_path, "--budget", "5min", "--steps", 3, scenes=toy_folder
    )
    assert "leave --jobs out" in bad(
        capsys, tmp_path, "--devices", "0,1", "--jobs", 2, scenes=toy_folder
    )
    assert "--device gpu7" in bad(capsys, tmp_path, "--device", "gpu7", scenes=toy_folder)
    assert "nowhere.pth" in bad(capsys, tmp_path, "--lpips", "nowhere.pth", scenes=toy_folder)


def test_a_run_that_was_not_asked_for(toy_folder: Path, tmp_path: Path, capsys: Capture) -> None:
    said = refused(
        capsys,
        "bench",
        tmp_path,
        "--scenes",
        toy_folder,
        "--methods",
        "tiny",
        "--only",
        "../tiny",
        "--device",
        "cpu",
    )
    assert "scene/tiny" in said and not (tmp_path / "runs").exists()


def test_a_folder_of_something_else_is_left_alone(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    command = [
        "bench",
        tmp_path / "mine",
        "--scenes",
        toy_folder,
        "--methods",
        "tiny",
        "--device",
        "cpu",
    ]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/results.csv").write_text("mine")
    assert "holds other files" in refused(capsys, *command)
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["results.csv"]


# Tables


def row(scene: str, method: str, psnr: float | None, oracle: bool = False) -> Row:
    """A made-up run; None: it failed."""
    folder = Path("out/runs") / scene / method
    where = BenchScene(scene, Path(scene), None, None, oracle)
    cell = BenchRun(where, method, replace(PRESETS["tiny"], out=folder), Path("out"))
    if psnr is None:
        return Row(cell, "failed", "no | luck", None, None)
    took = Trained(
        steps=1234,
        seconds=10.0,
        start_seconds=1.0,
        memory=10**9,
        device="cpu",
        threads=1,
        frame_seconds=0.5,
    )
    metrics = {"headline": {"views": 3, "psnr": psnr}, "kind": "views", "notes": []}
    return Row(cell, "done", "", metrics, RunRecord(scene_key="k", trained=took))


def test_means_are_over_the_scenes_that_all_methods_have_finished() -> None:
    rows = [
        row("a", "x", 30.0),
        row("a", "y", 20.0),
        row("b", "x", 10.0),
        row("b", "y", None),
        row("c", "x", 20.0),
        row("c", "y", 30.0),
    ]
    x, y = means([*rows, row("a", "z", None), row("o", "x", 99.0, oracle=True)], oracle=False)
    assert x.scenes == y.scenes == ("a", "c") and (x.values["psnr"], y.values["psnr"]) == (
        25.0,
        25.0,
    )
    assert (x.best, x.worst) == ("a", "b") and (y.best, y.worst) == ("c", "a")
    (oracle,) = means([*rows, row("o", "x", 99.0, oracle=True)], oracle=True)
    assert (oracle.scenes, oracle.values["psnr"]) == (("o",), 99.0)


def test_the_best_of_each_scene_is_marked_and_a_tie_is_two() -> None:
    rows = [
        row("a", "x", 30.001),
        row("a", "y", 30.002),
        row("b", "x", 10.0),
        row("b", "y", 10.1),
        row("c", "x", 5.0),
    ]
    assert best_cells(rows, tables.SCORES[:1]) == {(0, 0), (1, 0), (3, 0)}


def test_a_failed_run_stays_in_the_markdown_and_breaks_no_column(tmp_path: Path) -> None:
    rows = [row("a", "x", 30.0), row("a", "y", None)]
    lines = tables.markdown_table(rows, tables.SCORES).splitlines()
    assert lines[2:] == ["| a | x | 30.00 |", "| a | y | failed |"]
    assert (
        tables.markdown_table(rows, tables.COSTS).splitlines()[2]
        == "| a | x | 10.0 | 1,234 | 1.0 | 0.0 | 1.00 | 0.500 |"
    )
    assert tables.grid(["a"], [["no | luck\nat all"]]).splitlines()[-1] == "| no \\| luck at all |"


def test_views_are_spread_from_first_to_last() -> None:
    assert spread(list("abcdefghijklmnop"), 4) == list("afkp") and spread(list("ab"), 4) == list(
        "ab"
    )  # type: ignore[arg-type]


def test_the_last_words_of_a_process(tmp_path: Path) -> None:
    (tmp_path / "log").write_text("$ hdr-nsff bench\nTraceback\n\nFloatingPointError: step 3\n\n")
    assert last_words(tmp_path / "log", 1) == "FloatingPointError: step 3"
    (tmp_path / "log").write_text("hdr-nsff: x.png: cut short\n")
    assert last_words(tmp_path / "log", 2) == "x.png: cut short" and "memory" in last_words(
        tmp_path / "log", -9
    )
