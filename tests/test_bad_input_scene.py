"""Invalid scene folders: one sentence names the file and the fix, with no traceback."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_input import Capture, call, clip, edit, reading, refused, snapshot, training
from estimates import forget_movers

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import how_to_restore, write_npy
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig
from hdr_nsff.tonemap.build import tone_mapper_for

Change = Callable[[dict[str, Any]], object]


@pytest.fixture
def folder(toy_folder: Path, tmp_path: Path) -> Path:
    """A copy of the scene, which a test may damage."""
    return shutil.copytree(toy_folder, tmp_path / "scene")


def sentence(folder: Path) -> str:
    """The error of opening the scene or of making its tone mapper; one line."""
    with pytest.raises(InputError) as caught:
        tone_mapper_for(ToneMapConfig(), Scene.open(folder))
    text = str(caught.value)
    assert "\n" not in text and len(text) < 400, text
    return text


def frame(key: str, value: object, number: int = 2) -> Change:
    return lambda d: d["frames"][number].update({key: value})


def top(key: str, value: object) -> Change:
    return lambda d: d.update({key: value})


TURNED = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
K = [[55.2, 0, 30.0], [0, 55.2, 17.0], [0, 0, 1.0]]

NONSENSE: dict[str, tuple[Change, str]] = {
    "a word for a width": (top("width", "wide"), "width"),
    "no height": (lambda d: d.pop("height"), "height"),
    "a width of nothing": (top("width", 0), "width"),
    "a key nobody knows": (top("sparkle", 1), "sparkle"),
    "a key nobody knows in a frame": (frame("sparkle", 1), "frames.2.sparkle"),
    "another version": (top("version", 99), "version"),
    "version 1": (top("version", 1), "again into a new folder"),
    "frames that are no list": (top("frames", "many"), "frames"),
    "a frame that is no frame": (lambda d: d["frames"].append(7), "frames.6"),
    "an unknown split": (frame("split", "both"), "frames.2.split"),
    "a negative bracket": (frame("bracket", -1), "frames.2.bracket"),
    "a negative depth": (top("near", -1.0), "near"),
    "no frames at all": (top("frames", []), "no frames"),
    "no training frames": (
        lambda d: [f.update(split="test") for f in d["frames"]],
        "no training frames",
    ),
    "no poses yet": (frame("c2w", None), "no camera poses yet"),
    "a pose of the wrong shape": (frame("c2w", TURNED[:2]), "c2w"),
    "a ragged pose": (frame("c2w", [[1.0], [0.0, 1.0], [0.0]]), "c2w"),
    "a pose that is not a number": (frame("c2w", [*TURNED[:2], [0, 0, 1.0, float("nan")]]), "c2w"),
    "a pose that is no rotation": (frame("c2w", [[2.0, 0, 0, 0], *TURNED[1:]]), "c2w"),
    "a camera matrix of the wrong shape": (frame("K", K[:2]), "K"),
    "a focal length of nothing": (frame("K", [[0.0, 0, 30.0], *K[1:]]), "K"),
    "a time that is not a number": (frame("time", float("nan")), "time"),
    "near beyond far": (top("near", 9.0), "near"),
    "a bracket without an exposure": (frame("bracket", 3), "bracket"),
    "a reference that is no bracket": (top("reference_bracket", 5), "bracket"),
    "a reference that is not 0": (top("bracket_ev", [2.0, 1.0, -2.0]), "bracket"),
    "two frames of one index": (frame("index", 1), "index"),
    "a name that leaves the folder": (frame("image", "../image.png"), "outside the scene folder"),
    "an absolute name": (frame("mask", "/etc/passwd"), "outside the scene folder"),
    "points that leave the folder": (top("points", "../points.npy"), "outside the scene folder"),
    "an image that is not there": (frame("image", "images/none.png"), "images/none.png"),
    "a mask that is not there": (frame("mask", "masks/none.png"), "masks/none.png"),
    "a depth that is not there": (frame("disparity", "disparity/none.npy"), "disparity/none.npy"),
    "a flow that is not there": (
        lambda d: d["frames"][2]["flow"]["3"].update(flow="flow/none.npy"),
        "flow/none.npy",
    ),
    "a flow mask that is not there": (
        lambda d: d["frames"][2]["flow"]["3"].update(valid="flow/none.png"),
        "flow/none.png",
    ),
    "points that are not there": (top("points", "points.npy"), "points.npy"),
    "a held-out frame without an exposure": (
        lambda d: d["frames"][2].update(split="test", bracket=3),
        "bracket 3",
    ),
    "an exposure with NaN": (top("bracket_ev", [2.0, 0.0, float("nan")]), "bracket_ev.2"),
    "an exposure beyond all light": (top("bracket_ev", [2.0, 0.0, 1e9]), "bracket_ev holds 1e+09"),
    "brackets without end": (
        lambda d: (d.update(bracket_ev=[]), d["frames"][2].update(bracket=10**12)),
        "bracket 1000000000000",
    ),
    "cameras without end": (frame("camera_id", 10**12), "camera_ids"),
    "a camera that is left out": (frame("camera_id", 2), "camera_ids"),
    "two frames at one time": (frame("time", 1.0), "same time"),
    "a time without end": (frame("time", 1e300), "time 1e+300"),
    "a pose out of this world": (frame("c2w", [[1.0, 0, 0, 1e300], *TURNED[1:]]), "c2w"),
    "a skewed camera": (frame("K", [[55.2, 3.0, 30.0], *K[1:]]), "K"),
    "a depth of nearly nothing": (top("near", 1e-300), "near 1e-300"),
    "a depth without end": (top("far", 1e300), "far 1e+300"),
    "more frames a second than a video can have": (top("fps", 1e30), "fps"),
    "flow to a frame that is not there": (
        lambda d: d["frames"][2]["flow"].update({"77": d["frames"][2]["flow"]["3"]}),
        "frame 77",
    ),
    "a name with a NUL": (frame("image", "a\0.png"), "cannot be the name of a file"),
    "a name without end": (frame("image", "x" * 5000), "cannot be the name of a file"),
    "a name with half a character": (frame("image", "\ud800.png"), "cannot be the name of a file"),
    "a step counted in words": (
        top("steps", {"flow": {"details": {"attempt": "first"}}}),
        "attempt",
    ),
}


@pytest.mark.parametrize("what", NONSENSE)
def test_nonsense_in_scene_json_is_named(what: str, folder: Path) -> None:
    change, expected = NONSENSE[what]
    edit(folder / "scene.json", change)
    assert expected in sentence(folder)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '"scene"', "\x00"])
def test_a_scene_json_that_is_no_scene_is_said_to_be_none(text: str, folder: Path) -> None:
    (folder / "scene.json").write_text(text)
    said = sentence(folder)
    assert "scene.json: not a valid scene" in said and "--redo frames" in said


def test_binary_rubbish_for_scene_json(folder: Path) -> None:
    (folder / "scene.json").write_bytes(b"\xff\xfe\x00\x80")
    assert "not a valid scene" in sentence(folder)


def test_no_folder_and_no_scene_json(tmp_path: Path) -> None:
    assert "no scene.json here; make a scene folder with `hdr-nsff prepare" in sentence(tmp_path)
    assert "no scene.json here" in sentence(tmp_path / "nowhere")
    (tmp_path / "file").write_text("mine")
    assert "is a file, no scene; name the folder" in sentence(tmp_path / "file")


H, W = 34, 60
MAPS: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "a small image": (
        "images/00002.png",
        lambda p: write_png(p, np.zeros((9, 9, 3))),
        "image of frame 2 has shape (9, 9, 3)",
    ),
    "a small mask": (
        "masks/00002.png",
        lambda p: write_png(p, np.zeros((H, 9), bool)),
        "mask of frame 2 has shape (34, 9)",
    ),
    "a small depth": (
        "disparity/00002.npy",
        lambda p: write_npy(p, np.ones((9, W))),
        "disparity of frame 2 has shape (9, 60)",
    ),
    "a flow without y": (
        "raw_flow/00002_00003.npy",
        lambda p: write_npy(p, np.ones((H, W))),
        "flow of frame 2 has shape (34, 60)",
    ),
    "a small flow": (
        "raw_flow/00002_00003.npy",
        lambda p: write_npy(p, np.ones((3, 3, 2))),
        "flow of frame 2 has shape (3, 3, 2)",
    ),
    "a small flow mask": (
        "raw_flow/00002_00003_valid.png",
        lambda p: write_png(p, np.zeros((3, 3), bool)),
        "flow mask of frame 2",
    ),
    "a depth with NaN": (
        "disparity/00002.npy",
        lambda p: write_npy(p, np.full((H, W), np.nan)),
        "NaN or Inf",
    ),
    "a depth beyond single precision": (
        "disparity/00002.npy",
        lambda p: write_npy(p, np.full((H, W), 1e300)),
        "NaN or Inf",
    ),
    "a flow with Inf": (
        "raw_flow/00002_00003.npy",
        lambda p: write_npy(p, np.full((H, W, 2), np.inf)),
        "NaN or Inf",
    ),
    "a depth behind the camera": (
        "disparity/00002.npy",
        lambda p: write_npy(p, np.full((H, W), -1.0)),
        "negative",
    ),
    "a depth of words": (
        "disparity/00002.npy",
        lambda p: write_npy(p, np.full((H, W), "far")),
        "disparity of frame 2",
    ),
    "an image cut short": (
        "images/00002.png",
        lambda p: p.write_bytes(p.read_bytes()[:200]) and None,
        "cut short",
    ),
    "a depth cut short": (
        "disparity/00002.npy",
        lambda p: p.write_bytes(p.read_bytes()[:200]) and None,
        "not a readable .npy",
    ),
    "a text file for a mask": (
        "masks/00002.png",
        lambda p: p.write_text("not a mask") and None,
        "cut short",
    ),
    "a pickle for a flow": (
        "raw_flow/00002_00003.npy",
        lambda p: np.save(p, np.array([{}]), allow_pickle=True),
        "not a readable .npy",
    ),
    "an empty image": (
        "images/00002.png",
        lambda p: p.write_bytes(b"") and None,
        "images/00002.png",
    ),
}


@pytest.mark.parametrize("what", MAPS)
def test_a_map_that_does_not_fit_is_named(what: str, folder: Path) -> None:
    name, damage, expected = MAPS[what]
    damage(folder / name)
    said = sentence(folder)
    assert name in said and expected in said


def test_points_of_another_shape_are_named(folder: Path) -> None:
    write_npy(folder / "points.npy", np.ones((5, 2)))
    edit(folder / "scene.json", top("points", "points.npy"))
    assert "points.npy" in sentence(folder)


def test_a_link_out_of_the_folder_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere.npy").write_bytes((folder / "disparity/00002.npy").read_bytes())
    (folder / "disparity/00002.npy").unlink()
    (folder / "disparity/00002.npy").symlink_to(tmp_path / "elsewhere.npy")
    assert "outside the scene folder" in sentence(folder)


def test_a_scene_with_a_single_frame_opens(folder: Path) -> None:
    edit(folder / "scene.json", lambda d: d.update(frames=[{**d["frames"][1], "flow": {}}]))
    forget_movers(folder)
    scene = Scene.open(folder)
    assert len(scene.train) == 1 and scene.train[0].neighbors == {}


def test_a_manifest_survives_saving(folder: Path) -> None:
    before = Manifest.load(folder)
    before.save(folder)
    assert Manifest.load(folder) == before


# At the command line, verb by verb


EDITS: dict[str, tuple[Change, str]] = {
    "a word for a width": (lambda d: d.update(width="wide"), "width"),
    "a held-out frame in no bracket": (
        lambda d: d["frames"][3].update(split="test", bracket=9),
        "bracket 9",
    ),
    "a pose with NaN": (
        lambda d: d["frames"][3].update(c2w=[[float("nan")] * 4] * 3),
        "frames.3.c2w",
    ),
    "no focal length": (
        lambda d: d["frames"][3].update(K=[[0, 0, 30], [0, 0, 17], [0, 0, 1]]),
        "frame 3 has a K",
    ),
    "near beyond far": (lambda d: d.update(near=9.0), "near 9 and far 5"),
    "two frames of one index": (lambda d: d["frames"][3].update(index=2), "same index"),
    "a file outside the folder": (
        lambda d: d["frames"][3].update(image="../clip/003.png"),
        "outside the scene folder",
    ),
}


@pytest.mark.parametrize("what", EDITS)
def test_every_verb_that_reads_a_scene_names_what_is_wrong_in_it(
    what: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    change, expected = EDITS[what]
    scene, footage = run_folder.parent / "scene", clip(tmp_path / "clip")
    edit(scene / "scene.json", change)
    before = snapshot(tmp_path)
    assert expected in refused(capsys, *training(scene, tmp_path / "new", 1))
    assert expected in refused(capsys, "prepare", footage, scene)
    assert expected in refused(capsys, "run", footage, run_folder.parent)
    for command in reading(run_folder, tmp_path / "new"):
        assert expected in refused(capsys, *command)
    assert snapshot(tmp_path) == before


def test_a_prepared_scene_whose_frames_are_out_of_order_is_not_built_on(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    scene = shutil.copytree(toy_folder, tmp_path / "scene")
    edit(scene / "scene.json", lambda d: d["frames"].reverse())
    assert "out of order" in refused(capsys, "prepare", clip(tmp_path / "clip"), scene)
    assert len(Scene.open(scene).train) == 6  # which is nothing to training


def test_missing_maps_and_maps_of_the_wrong_size(
    run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    scene = run_folder.parent / "scene"
    commands = [training(scene, tmp_path / "new", 1), *reading(run_folder, tmp_path / "new")]
    for name, wrong in (
        ("masks/00002.png", np.zeros((9, 60))),
        ("raw_flow/00002_00003.npy", np.zeros((9, 60, 2))),
    ):
        kept = (scene / name).read_bytes()
        (write_png if name.endswith("png") else write_npy)(scene / name, wrong)
        assert all(
            name in said and "shape (9, 60" in said
            for said in (refused(capsys, *c) for c in commands)
        )
        (scene / name).unlink()
        assert all(name in refused(capsys, *c) for c in commands)
        (scene / name).write_bytes(kept)
    assert call("report", run_folder) == 0 and not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("place", "step"), [("images/00002.png", "frames"), ("raw_flow/00002_00003.npy", "flow")]
)
def test_the_step_that_restores_a_damaged_file_is_named(
    place: str, step: str, folder: Path
) -> None:
    files = sorted((folder / place).parent.iterdir())
    for file in files:
        file.write_bytes(b"cut short")
    assert how_to_restore(files[0]) == f"run `hdr-nsff prepare` with `--redo {step}`"
    assert how_to_restore(folder.parent / "photo.png") == "copy it again"
