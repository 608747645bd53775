"""Places that are missing, taken, or cannot be written: every verb names them, and
replaces nothing but what it made itself.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from bad_input import (
    FOOTAGE_VERBS,
    RUN_VERBS,
    WORKING_VERBS,
    Capture,
    call,
    clip,
    commands,
    recorded,
    refused,
    snapshot,
    training,
)
from toy_scene import ToyScene

from hdr_nsff.core.io import write_text
from hdr_nsff.core.lock import absolute, acquire, release
from hdr_nsff.prepare.prepare import truth_place
from hdr_nsff.prepare.work import PrepareConfig


def test_there_is_a_command_of_every_verb_to_try() -> None:
    assert set(commands(Path("run"), Path("clip"), Path("out"))) == set(WORKING_VERBS)
    assert {"run", "check", "prepare", "reexpose"} == set(FOOTAGE_VERBS)
    assert {"render", "export", "evaluate", "report"} == set(RUN_VERBS)


# Missing and empty


@pytest.mark.parametrize("verb", RUN_VERBS)
def test_a_missing_and_an_empty_run(verb: str, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("nowhere", "empty"):
        command = commands(tmp_path / name, tmp_path, tmp_path / "out")[verb]
        assert "not a run folder" in refused(capsys, *command)
    assert [p.name for p in tmp_path.rglob("*")] == ["empty"]


def test_what_an_option_names_must_be_there(
    run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    footage, nowhere = clip(tmp_path / "clip"), tmp_path / "nowhere"
    for option in ("--poses", "--flow", "--mask", "--masks", "--depth"):
        assert option.removesuffix("ks") in refused(
            capsys, "prepare", footage, tmp_path / "out", option, nowhere
        )
    for verb, option in (
        ("run", "--poses"),
        ("run", "--truth"),
        ("reexpose", "--poses"),
        ("reexpose", "--masks"),
    ):
        assert str(nowhere) in refused(capsys, verb, footage, tmp_path / "out", option, nowhere)
    assert "truth.json" in refused(capsys, "run", footage, tmp_path / "out", "--truth", footage)
    assert "truth.json" in refused(capsys, "evaluate", run_folder, "--truth", nowhere)
    layout = ("--layout", "nerfstudio", "--truth", nowhere)
    sentence = refused(capsys, "export", run_folder, tmp_path / "out", *layout)
    assert f"--truth {nowhere}: no truth.json here; give a folder" in sentence
    for more in ([], ["--truth", nowhere]):
        sentence = refused(capsys, "evaluate", run_folder, "--lpips", nowhere, *more)
        assert f"--lpips {nowhere}: no such weights file; give a file" in sentence
    assert "--renders" in refused(capsys, "report", run_folder, "--renders", nowhere)
    assert str(nowhere) in refused(capsys, "render", run_folder, "--path", f"{nowhere}.json")
    assert not (tmp_path / "out").exists()


# Paths


def test_a_name_that_is_no_text_is_refused_and_shown(tmp_path: Path, capsys: Capture) -> None:
    assert "UTF-8" in refused(capsys, "prepare", clip(tmp_path / "clip"), f"{tmp_path}/sc\udcffne")
    footage = clip(tmp_path / "other")
    (footage / "004.png").rename(footage / "004\udcff.png")
    assert "UTF-8" in refused(capsys, "prepare", footage, tmp_path / "scene")


@pytest.mark.usefixtures("flow_data")
@pytest.mark.parametrize("place", ["file", "file/below", "y" * 300])
@pytest.mark.parametrize("verb", [v for v in WORKING_VERBS if v != "evaluate"])
def test_a_place_that_cannot_be_written_is_named(
    verb: str, place: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "file").write_text("mine")
    footage, out = clip(tmp_path / "clip", recorded(3)), tmp_path / place
    sentence = refused(capsys, *commands(run_folder, footage, out)[verb])
    assert place.partition("/")[0][:40] in sentence
    assert (tmp_path / "file").read_text() == "mine"


def test_a_file_in_the_place_of_a_folder_is_said_to_be_one(
    run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "file"
    out.write_text("mine")
    for verb in ("run", "render", "train"):
        sentence = refused(capsys, *commands(run_folder, clip(tmp_path / "clip"), out)[verb])
        assert f"{out}: is a file, where a folder is needed; choose another place" in sentence


@pytest.mark.usefixtures("flow_data")
@pytest.mark.parametrize("verb", [v for v in WORKING_VERBS if v not in ("evaluate", "report")])
def test_a_place_that_is_a_link_to_itself_is_named(
    verb: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "loop"
    out.symlink_to(out)
    footage = clip(tmp_path / "clip", recorded(3))
    assert "loop" in refused(capsys, *commands(run_folder, footage, out)[verb])


def test_the_folder_at_hand_may_hold_a_scene(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for place in (".", "", "../here", ".."):
        assert truth_place(PrepareConfig(tmp_path, Path(place))).name.endswith("_truth")
    assert "name a folder" in refused(capsys, "prepare", clip(tmp_path / "clip"), "/")


def test_a_run_does_not_go_into_its_scene(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    folder = shutil.copytree(toy_folder, tmp_path / "scene")
    before = snapshot(folder)
    assert "holds a scene" in refused(capsys, *training(folder, folder, 2))
    assert snapshot(folder) == before


def test_a_picture_of_check_replaces_no_frame(tmp_path: Path, capsys: Capture) -> None:
    footage = clip(tmp_path / "clip")
    before = snapshot(footage)
    sentence = refused(capsys, "check", footage, "--picture", footage / "000.png")
    assert "is a frame of the clip" in sentence
    assert snapshot(footage) == before


# Two at once: `report` and `check` write one file in one go and need no lock


@pytest.mark.usefixtures("flow_data")
@pytest.mark.parametrize("verb", [v for v in WORKING_VERBS if v not in ("report", "check")])
def test_a_place_in_which_another_one_works_is_left_alone(
    verb: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    footage, out = clip(tmp_path / "clip"), tmp_path / "out"
    busy = run_folder / "evaluation" if verb == "evaluate" else out
    file = acquire(absolute(busy), wait=False)  # as another process would
    assert file is not None
    before = snapshot(tmp_path)
    command = commands(run_folder, footage, out)[verb]
    assert "another hdr-nsff works in" in refused(capsys, *command)
    assert snapshot(tmp_path) == before
    release(file)


# Output that is there already


def test_a_report_replaces_reports_only(run_folder: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "thesis.html").write_text("<p>mine</p>")
    assert "not a report" in refused(
        capsys, "report", run_folder, "--out", tmp_path / "thesis.html"
    )
    assert (tmp_path / "thesis.html").read_text() == "<p>mine</p>"
    assert "is a folder" in refused(capsys, "report", run_folder, "--out", tmp_path)
    for _ in range(2):
        assert call("report", run_folder, "--out", tmp_path / "report.html") == 0


@pytest.mark.parametrize("name", ["fixed.mp4", "fixed/00001.png", "fixed/7.exr", "fixed_sheet.png"])
def test_pictures_of_the_user_are_not_replaced(
    name: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    write_text(tmp_path / "mine" / name, "mine")
    assert name in refused(capsys, *commands(run_folder, tmp_path, tmp_path / "mine")["render"])
    assert snapshot(tmp_path / "mine") == {tmp_path / "mine" / name: b"mine"}


def test_the_standard_set_replaces_no_depth_maps_of_the_user(
    run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    write_text(tmp_path / "mine/depth/00000.png", "mine")
    assert "depth" in refused(
        capsys, "render", run_folder, "--out", tmp_path / "mine", "--device", "cpu"
    )
    assert snapshot(tmp_path / "mine") == {tmp_path / "mine/depth/00000.png": b"mine"}


@pytest.mark.parametrize("name", ["00001.ply", "7.ply", "sequence.json"])
def test_files_of_the_user_are_not_replaced_by_gaussians(
    name: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    write_text(tmp_path / "mine" / name, '{"takes": 3}')
    assert name in refused(capsys, *commands(run_folder, tmp_path, tmp_path / "mine")["export"])
    assert name in refused(capsys, "export", run_folder, tmp_path / "mine" / name, "--ply")
    assert snapshot(tmp_path / "mine") == {tmp_path / "mine" / name: b'{"takes": 3}'}


def test_gaussians_of_another_run_are_exported_again_and_that_is_reported(
    run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    command = commands(run_folder, tmp_path, tmp_path / "out")["export"]
    assert call(*command) == 0
    first = snapshot(tmp_path / "out")
    assert call(*training(run_folder.parent / "scene", run_folder.parent / "other", 3)) == 0
    capsys.readouterr()
    assert call(*commands(run_folder.parent / "other", tmp_path, tmp_path / "out")["export"]) == 0
    assert "settings or checkpoint changed, exporting again" in capsys.readouterr().err
    second = snapshot(tmp_path / "out")
    assert second.keys() == first.keys() and all(second[p] != first[p] for p in first)


def test_footage_is_not_prepared_over_another_scene(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    scene = shutil.copytree(toy_folder, tmp_path / "out/scene")  # no step of it is done
    before = snapshot(tmp_path / "out")
    footage = clip(tmp_path / "clip")
    assert "other footage" in refused(capsys, "prepare", footage, scene)
    assert "other footage" in refused(capsys, "run", footage, tmp_path / "out")
    assert snapshot(tmp_path / "out") == before


def test_a_run_with_other_settings_stays_as_it_is(run_folder: Path, capsys: Capture) -> None:
    before = snapshot(run_folder)
    assert "other settings" in refused(
        capsys, *training(run_folder.parent / "scene", run_folder, 3)
    )
    assert snapshot(run_folder) == before


def test_a_run_learns_where_its_scene_has_moved_to(
    run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    moved = (run_folder.parent / "scene").rename(tmp_path / "elsewhere")
    assert "its scene is not at" in refused(capsys, "report", run_folder)
    assert call(*training(moved, run_folder, 2)) == 0
    assert call("report", run_folder) == 0


def test_a_run_is_not_continued_on_another_scene(
    run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    other = ToyScene(frames=5).write(tmp_path / "other")
    before = snapshot(run_folder)
    assert "on another scene" in refused(capsys, *training(other, run_folder, 2))
    assert snapshot(run_folder) == before


def test_checkpoints_without_their_config_are_not_taken_over(
    run_folder: Path, capsys: Capture, tmp_path: Path
) -> None:
    lone = tmp_path / "run"
    shutil.copytree(run_folder, lone)
    (lone / "config.json").unlink()
    before = snapshot(lone)
    assert "no config.json" in refused(capsys, *training(run_folder.parent / "scene", lone, 3))
    assert snapshot(lone) == before


def test_synth_refuses_a_folder_of_other_files(capsys: Capture, tmp_path: Path) -> None:
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip" / "00000.png").write_bytes(b"mine")
    assert "holds other files" in refused(
        capsys, "synth", "interior", str(tmp_path), "--size", "16x16", "--frames", "12"
    )
    assert (tmp_path / "clip" / "00000.png").read_bytes() == b"mine"
