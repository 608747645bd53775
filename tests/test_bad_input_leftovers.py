"""What earlier verbs have left, damaged or edited by hand: it is made again with a word about it, or named in one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from bad_input import Capture, call, clip, commands, cut, reading, refused, snapshot, training, truth
from safetensors.torch import save_file

from hdr_nsff.run import Run, latest_checkpoint

# Checkpoints


def other_version(path: Path) -> None:
    import torch

    save_file({"a": torch.ones(1)}, path, metadata={"format": "hdr-nsff checkpoint 99", "step": "2", "seconds": "0"})


@pytest.mark.parametrize("damage", [cut, other_version])
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
        assert "going on from the one before, step 0" in said and checkpoints[-1].name in said
    found = latest_checkpoint(run_folder)
    assert found is not None and found.step == 2  # training made it again
    for path in (run_folder / "checkpoints").iterdir():
        damage(path)
    before = snapshot(run_folder)
    for command in [*verbs, training(run_folder.parent / "scene", run_folder, 2)]:
        assert "no readable checkpoint" in refused(capsys, *command)
    assert snapshot(run_folder) == before


# Notes and settings


def test_notes_that_cannot_be_read_are_made_again(run_folder: Path, tmp_path: Path) -> None:
    assert (
        call(*commands(run_folder, tmp_path, tmp_path / "out")["render"]) == 0
        and call("evaluate", run_folder, "--device", "cpu") == 0
    )
    for text in ("{", "[" * 100_000, "\x00", "7", '{"headline": 3}'):
        for note in (tmp_path / "out/fixed/sequence.json", run_folder / "metrics.json", run_folder / "log.jsonl"):
            note.write_text(text)
        assert call("report", run_folder) == 0
        assert call(*commands(run_folder, tmp_path, tmp_path / "out")["render"]) == 0
        assert "views" in json.loads((tmp_path / "out/fixed/sequence.json").read_text())
    assert Run.open(run_folder).log() == []


@pytest.mark.parametrize("text", ["[" * 100_000, '{"width": ' + "9" * 5000 + "}", "\x00"])
def test_json_that_overwhelms_the_parser_is_refused_like_any_other(
    text: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "path.json").write_text(text)
    assert "path.json: not a JSON file" in refused(
        capsys, "render", run_folder, "--path", tmp_path / "path.json", "--device", "cpu"
    )
    (truth(tmp_path / "truth") / "truth.json").write_text(text)
    assert "not a valid truth file" in refused(capsys, "evaluate", run_folder, "--truth", tmp_path / "truth", "--device", "cpu")
    (tmp_path / "transforms.json").write_text(text)
    footage, out = clip(tmp_path / "clip"), tmp_path / "out"
    assert "not readable as poses" in refused(capsys, "reexpose", footage, out, "--poses", tmp_path / "transforms.json")
    (run_folder.parent / "scene/scene.json").write_text(text)
    assert "not a valid scene" in refused(capsys, *training(run_folder.parent / "scene", out, 1))
    (run_folder / "config.json").write_text(text)
    assert "config.json" in refused(capsys, "report", run_folder)
