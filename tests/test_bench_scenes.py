"""Scenes of a benchmark: scene folders and their truth, footage, oracle scenes, and the
sentences that refuse the rest.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_input import FRAMES, edit, poses, truth
from bad_input import clip as frames_of
from toy_scene import ToyScene, camera_center

from hdr_nsff.bench.config import BenchConfig, BenchScene
from hdr_nsff.bench.scenes import parse_scene
from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.layouts import nerfstudio
from hdr_nsff.footage.layouts.writer import Source
from hdr_nsff.prepare.prepare import STEPS
from hdr_nsff.synth.oracle import ORACLE_NOTE


def parse(text: object, out: Path = Path("out"), **settings: Any) -> BenchScene:
    """The scene of a text."""
    return parse_scene(str(text), BenchConfig(out, str(text), "tiny", **settings))


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
    step = {"poses": {"done": True, "note": ORACLE_NOTE}}
    edit(folder / "oracle/scene.json", lambda m: m["steps"].update(step))
    return folder


@pytest.mark.parametrize("place", ["a/scene_truth", "a/truth", "a/scene/truth"])
def test_a_truth_folder_in_or_beside_a_scene_is_found(
    place: str, toy_folder: Path, tmp_path: Path
) -> None:
    scene = shutil.copytree(toy_folder, tmp_path / "a/scene")
    assert parse(scene).truth is None
    truth(tmp_path / place)
    assert parse(scene).truth == tmp_path / place


def test_a_given_truth_folder_takes_precedence(toy_folder: Path, tmp_path: Path) -> None:
    scene = shutil.copytree(toy_folder, tmp_path / "a/scene")
    truth(tmp_path / "a/truth")
    truth(tmp_path / "b")
    assert parse(f"{scene}:{tmp_path / 'b'}").truth == tmp_path / "b"


def test_footage_of_synth_is_to_be_prepared(tmp_path: Path) -> None:
    folder = made(tmp_path / "room")
    scene = parse(folder, tmp_path / "out")
    assert scene.name == "room" and not scene.oracle and not scene.ready
    assert scene.folder == tmp_path / "out/scenes/room" and scene.truth == folder / "truth"
    assert scene.footage is not None and scene.footage.clip == folder / "clip"
    assert scene.footage.poses == folder / "poses_bounds.npy"
    assert scene.footage.hold_out == 2  # the toy's truth is of frames 1 and 3
    with pytest.raises(InputError, match="leave --protocol out"):
        parse(folder, protocol="novel-view")  # which would train on them
    edit(folder / "truth/truth.json", lambda t: [v.update(time=1.5) for v in t["views"]])
    novel = parse(folder, protocol="novel-view").footage
    assert novel is not None and novel.protocol == "novel-view"
    (folder / "transforms.json").write_text("{}")
    of_now = parse(folder).footage
    assert of_now is not None and of_now.poses == folder / "transforms.json"


def test_an_oracle_scene_is_named_so_however_it_is_given(tmp_path: Path) -> None:
    folder = made(tmp_path / "room")
    oracle = parse(folder, oracle=True)
    assert (oracle.name, oracle.folder) == ("room-oracle", folder / "oracle")
    assert oracle.oracle and oracle.ready
    assert parse(f"room={folder / 'oracle'}") == replace(oracle)  # by a note of its manifest


def test_texts_that_are_no_scene_are_refused(toy_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    cases = {
        tmp_path / "nowhere": "no such folder",
        "": "no such folder",
        tmp_path / "empty": "no scene.json",
        f"{toy_folder}:{tmp_path / 'empty'}": "no truth.json",
    }
    for text, words in cases.items():
        with pytest.raises(InputError, match=words):
            parse(text)


def test_settings_that_do_not_fit_the_scene_are_refused(toy_folder: Path, tmp_path: Path) -> None:
    folder = made(tmp_path / "room")
    shutil.rmtree(folder / "oracle")
    with pytest.raises(InputError, match="no oracle/"):
        parse(folder, oracle=True)
    with pytest.raises(InputError, match="made from footage"):
        parse(toy_folder, oracle=True)
    with pytest.raises(InputError, match="is prepared already, for none"):
        parse(toy_folder, protocol="novel-view-time")


def test_footage_alone_is_prepared_and_measured_on_its_held_out_frames(tmp_path: Path) -> None:
    frames = frames_of(tmp_path / "walk")
    scene = parse(frames, tmp_path / "out")
    assert scene.name == "walk" and scene.truth is None
    assert scene.footage is not None and scene.footage.clip == frames
    assert scene.footage.hold_out is None  # `prepare` chooses which


@pytest.mark.parametrize("held_out", [False, True])
def test_a_prepared_data_set_is_ready_once_its_held_out_views_are_written(
    held_out: bool, toy_folder: Path, tmp_path: Path
) -> None:
    data_set, name = tmp_path / "set", "transforms.json"
    nerfstudio.write(Source.open(toy_folder), data_set)
    if held_out:
        images = [f["file_path"] for f in json.loads((data_set / name).read_text())["frames"]]
        split = {"train_filenames": images[:-1], "test_filenames": images[-1:]}
        edit(data_set / name, lambda d: d.update(split))
    scene = parse(data_set, tmp_path / "out")
    shutil.copytree(toy_folder, scene.folder)
    edit(scene.folder / "scene.json", lambda m: m.update(steps={s: {"done": True} for s in STEPS}))
    assert scene.truth is None and scene.ready != held_out
