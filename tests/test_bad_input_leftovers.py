"""Damaged or edited files of earlier verbs.

They are written again with a note about it, or named in one sentence.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from bad_input import (
    Capture,
    call,
    clip,
    commands,
    cut,
    edit,
    reading,
    refused,
    snapshot,
    training,
    truth,
)
from safetensors.torch import save_file

from hdr_nsff.core import notes
from hdr_nsff.core.checkpoints import latest_checkpoint
from hdr_nsff.core.io import write_text
from hdr_nsff.training.run_folder import Run

# Checkpoints


def other_version(path: Path) -> None:
    import torch

    save_file(
        {"a": torch.ones(1)},
        path,
        metadata={"format": "hdr-nsff checkpoint 99", "step": "2", "seconds": "0"},
    )


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def one_bit_flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-100] ^= 64  # of a number: nothing but a checksum notices
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [cut, other_version, one_bit_flipped, pipe])
def test_a_bad_checkpoint_gives_way_to_the_one_before_for_every_verb(
    damage: Callable[[Path], None], run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    checkpoints = sorted((run_folder / "checkpoints").glob("step_*"))
    damage(checkpoints[-1])
    verbs = reading(run_folder, tmp_path / "out")
    for command in [*verbs, training(run_folder.parent / "scene", run_folder, 2)]:
        capsys.readouterr()
        assert call(*command) == 0
        said = " ".join(capsys.readouterr().err.split())
        assert "using the one before, of step 0" in said and checkpoints[-1].name in said
    found = latest_checkpoint(run_folder)
    assert found is not None and found.step == 2  # training made it again
    for path in (run_folder / "checkpoints").iterdir():
        damage(path)
    before = snapshot(run_folder)
    for command in [*verbs, training(run_folder.parent / "scene", run_folder, 2)]:
        assert "no readable checkpoint" in refused(capsys, *command)
    assert snapshot(run_folder) == before


# Notes: what verbs leave for a restart and for the report


@pytest.fixture(scope="module")
def worked(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run, all that verbs make of it, and its Gaussians; tests leave
    it whole.
    """
    folder = tmp_path_factory.mktemp("worked")
    shutil.copytree(trained.parent, folder, dirs_exist_ok=True)
    edit(folder / "run/config.json", lambda d: d.update(scene=str(folder / "scene")))
    for command in making(folder):
        assert call(*command) == 0
    return folder


def making(folder: Path) -> list[list[object]]:
    """The commands whose notes are damaged here."""
    run, cpu = folder / "run", ["--device", "cpu"]
    return [
        ["render", run, *cpu],
        commands(run, run, folder / "ply")["export"],
        ["evaluate", run, *cpu],
        ["report", run],
    ]


Change = Callable[[dict], object]
PLAN, VIEWS, METRICS = "run/render/plan.json", "run/render/views.json", "run/metrics.json"
SEQUENCE, EXPORTED = "run/render/training/sequence.json", "ply.sequence.json"
KINDS: dict[str, type[notes.Note]] = {
    PLAN: notes.RenderPlan,
    VIEWS: notes.PictureRanges,
    SEQUENCE: notes.Sequence,
    EXPORTED: notes.ExportedSequence,
    METRICS: notes.Metrics,
}
NONSENSE: dict[str, tuple[str, Change]] = {
    "views beyond the shot": (PLAN, lambda d: d["shots"]["fixed"].update(views=[999])),
    "views before the shot": (PLAN, lambda d: d["shots"]["fixed"].update(views=[-1])),
    "no views": (PLAN, lambda d: d["shots"]["fixed"].update(views=[])),
    "a word for a scale": (PLAN, lambda d: d["shots"]["fixed"].update(scale="big")),
    "pictures of no size": (PLAN, lambda d: d["shots"]["fixed"].update(scale=0)),
    "a shot nobody knows": (PLAN, lambda d: d["shots"].update(sideways=d["shots"]["fixed"])),
    "a list of shots": (PLAN, lambda d: d.update(shots=[1, 2])),
    "sentences that are numbers": (PLAN, lambda d: d.update(refused=[7])),
    "depths that are words": (VIEWS, lambda d: d.update(depth_range=["near", "far"])),
    "one depth": (VIEWS, lambda d: d.update(depth_range=[1.0])),
    "a motion of nothing": (VIEWS, lambda d: d.update(fastest=0)),
    "no answer about motion": (VIEWS, lambda d: d.pop("moves")),
    "an exposure of nothing": (SEQUENCE, lambda d: d.update(display_exposure=0)),
    "views without time": (SEQUENCE, lambda d: d["views"][0].pop("time")),
    "a sequence without views": (SEQUENCE, lambda d: d.update(views=[])),
    "a word for seconds": (SEQUENCE, lambda d: d.update(seconds="long")),
    "a bright exposure": (EXPORTED, lambda d: d.update(display_exposure="bright")),
    "a group without views": (METRICS, lambda d: d["views"].clear()),
    "a view outside": (METRICS, lambda d: d["views"][0].update(name="../secret")),
    "a word for a score": (METRICS, lambda d: d["headline"].update(psnr="good")),
    "scores nobody counts": (METRICS, lambda d: d["headline"].pop("views")),
    "a curve of two channels": (
        METRICS,
        lambda d: d.update(camera={"true_response": {"x": [0.0], "y": [[0.0]] * 2}}),
    ),
    "a white that is none": (METRICS, lambda d: d.update(pu21={"white": None, "nits": 1000})),
    "radiance without its scale": (
        METRICS,
        lambda d: d.update(hdr_scores={"mu5000": ["mu-law", 2]}),
    ),
}


@pytest.mark.parametrize("what", NONSENSE)
def test_a_note_edited_into_nonsense_is_named_and_made_again(
    what: str, worked: Path, capsys: Capture
) -> None:
    name, change = NONSENSE[what]
    kind = KINDS[name]
    edit(worked / name, change)
    render, export, evaluate, report = making(worked)
    capsys.readouterr()
    if name == METRICS:
        assert call(*report) == 0
    maker = {EXPORTED: export, METRICS: evaluate}.get(name, render)
    assert call(*maker) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert f"{name}: cut short or edited" in said or f"{name}: does not fit these shots" in said
    assert call(*report) == 0 and notes.read(worked / name, kind) is not None
    assert "cut short" not in capsys.readouterr().err


@pytest.mark.parametrize("text", ["{", "[" * 100_000, "\x00", ""])
def test_notes_cut_short_are_made_again(text: str, worked: Path, capsys: Capture) -> None:
    for name in KINDS:
        (worked / name).write_text(text)
    (worked / "run/log.jsonl").write_text(text)
    (worked / "run/evaluation/predictions.json").write_bytes(b"\xff\xfe" + text.encode())
    assert call("report", worked / "run") == 0
    for command in making(worked):
        assert call(*command) == 0
    assert all(notes.read(worked / name, kind) is not None for name, kind in KINDS.items())
    assert Run.open(worked / "run").log() == []


@pytest.mark.parametrize("name", [PLAN, VIEWS, SEQUENCE, EXPORTED])
def test_a_json_file_of_the_user_is_kept(name: str, worked: Path, capsys: Capture) -> None:
    kept = (worked / name).read_bytes()
    for text in ('{"takes": 3}', "[1, 2]", "7"):
        (worked / name).write_text(text)
        before = snapshot(worked)
        render, export, _, _ = making(worked)
        assert f"{name}: already exists and was not made by" in refused(
            capsys, *(export if name == EXPORTED else render)
        )
        assert snapshot(worked) == before
    (worked / name).write_bytes(kept)


LINE = {"step": 25, "seconds": 1.0, "psnr": 10.0, "rays_per_second": 9.0, "losses": {"depth": 1.0}}


@pytest.mark.parametrize(
    "change",
    [
        {"step": "many"},
        {"psnr": None},
        {"seconds": [1]},
        {"losses": {"depth": "deep"}},
        {"step": 1e400},
    ],
)
def test_log_lines_edited_into_nonsense_are_left_out(
    change: dict, run_folder: Path, capsys: Capture
) -> None:
    lines = [LINE, {**LINE, "step": 50, **change}, {**LINE, "step": 75}, 7, {}]
    (run_folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert [line.step for line in Run.open(run_folder).log()] == [25, 75]
    assert call("report", run_folder) == 0


@pytest.mark.parametrize("text", ["{", "[]", "7", "\x00", '{"digest": 3}'])
def test_the_mark_of_footage_that_was_made_is_not_written_over(
    text: str, tmp_path: Path, capsys: Capture
) -> None:
    for verb, mark in (("reexpose", "reexpose.json"), ("synth", "exact/key.json")):
        write_text(tmp_path / verb / mark, text)
        command = commands(tmp_path, clip(tmp_path / "clip"), tmp_path / verb)[verb]
        said = refused(capsys, *command)
        assert "made with other settings" in said or "rendered with other settings" in said
        assert (tmp_path / verb / mark).read_text() == text


# Settings


SETTINGS: dict[str, tuple[Change, str]] = {
    "a word for a number": (lambda d: d["field"].update(bases="many"), "--field.bases"),
    "nothing for a number": (
        lambda d: d["field"].update(opacity_knots=None),
        "--field.opacity-knots",
    ),
    "less than none": (lambda d: d["field"].update(static=-1), "--field.static"),
    "more than there can be": (lambda d: d["field"].update(moving=10**300), "--field.moving"),
    "half a Gaussian": (lambda d: d["field"].update(moving=0.5), "--field.moving"),
    "a number for a switch": (lambda d: d.update(refine_poses=3), "--refine-poses"),
    "a curve nobody knows": (lambda d: d["tonemap"].update(kind="round"), "--tonemap.kind"),
    "a weight below zero": (lambda d: d["loss"].update(depth=-1.0), "--loss.depth"),
    "a weight that is no number": (lambda d: d["loss"].update(depth=float("nan")), "--loss.depth"),
    "a setting nobody knows": (lambda d: d.update(sparkle=1), "sparkle"),
    "no field": (lambda d: d.pop("field"), "field"),
    "a field that is a number": (lambda d: d.update(field=7), "config.json"),
    "grids for a field": (lambda d: d["field"].update(type="grids"), "--field"),
    "a kind of field nobody knows": (lambda d: d["field"].update(type="cloud"), "cloud"),
    "a field of no kind": (lambda d: d["field"].pop("type"), "--field"),
    "a kind that is a number": (lambda d: d["field"].update(type=7), "--field"),
    "a scene that is a number": (lambda d: d.update(scene=7), "config.json"),
}


@pytest.mark.parametrize("what", SETTINGS)
def test_a_config_edited_into_nonsense_is_named_by_every_verb_that_reads_it(
    what: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    change, expected = SETTINGS[what]
    edit(run_folder / "config.json", change)
    before = snapshot(tmp_path)
    for command in [
        *reading(run_folder, tmp_path / "out"),
        training(run_folder.parent / "scene", run_folder, 2),
    ]:
        said = refused(capsys, *command)
        assert expected in said and "config.json" in said
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    "option",
    [
        "--steps=0",
        "--minutes=-1",
        "--minutes=nan",
        "--rays=-5",
        "--rays=1000000",
        "--torch-threads=100000",
        "--field.bases=0",
        "--loss.depth=-1",
        "--seed=-1",
        "--batches=0",
    ],
)
def test_invalid_settings_are_named_before_anything_is_written(
    option: str, toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    assert option.partition("=")[0] in refused(
        capsys, *training(toy_folder, tmp_path / "out", 1), option
    )
    if option in ("--minutes=-1", "--minutes=nan", "--seed=-1"):
        assert option.partition("=")[0] in refused(
            capsys, "run", clip(tmp_path / "clip"), tmp_path / "out", option
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text", ["[" * 100_000, '{"width": ' + "9" * 5000 + "}", "\x00"])
def test_json_that_overwhelms_the_parser_is_refused_like_any_other(
    text: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "path.json").write_text(text)
    assert "path.json: not a JSON file" in refused(
        capsys, "render", run_folder, "--path", tmp_path / "path.json", "--device", "cpu"
    )
    (truth(tmp_path / "truth") / "truth.json").write_text(text)
    assert "not a valid truth file" in refused(
        capsys, "evaluate", run_folder, "--truth", tmp_path / "truth", "--device", "cpu"
    )
    (tmp_path / "transforms.json").write_text(text)
    footage, out = clip(tmp_path / "clip"), tmp_path / "out"
    assert "not readable as poses" in refused(
        capsys, "reexpose", footage, out, "--poses", tmp_path / "transforms.json"
    )
    (run_folder.parent / "scene/scene.json").write_text(text)
    assert "not a valid scene" in refused(capsys, *training(run_folder.parent / "scene", out, 1))
    (run_folder / "config.json").write_text(text)
    assert "config.json" in refused(capsys, "report", run_folder)
