"""The scene folder in memory: what is read, who is whose neighbor."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_scene import CARD, EV, WALL, ToyScene

from hdr_nsff.core.errors import InputError
from hdr_nsff.scene import scene as scene_module
from hdr_nsff.scene.manifest import FrameEntry, Manifest, StepRecord
from hdr_nsff.scene.movers import write_movers
from hdr_nsff.scene.scene import Frame, Scene, StoredFrame, neighbors, outline


def entry(index: int, time: float, camera: int = 0) -> FrameEntry:
    return FrameEntry(index=index, image="", source="", time=time, camera_id=camera, bracket=0)


def test_neighbors_are_the_frames_before_and_after_in_time_in_any_order() -> None:
    assert neighbors([entry(0, 2.0), entry(1, 0.0), entry(2, 1.0)]) == [
        {-1: 2},
        {1: 2},
        {-1: 1, 1: 0},
    ]


def test_neighbors_span_a_frame_that_is_held_out() -> None:
    assert neighbors([entry(0, 0.0), entry(2, 2.0), entry(3, 3.0)]) == [
        {1: 1},
        {-1: 0, 1: 2},
        {-1: 1},
    ]


def test_neighbors_stay_within_a_physical_camera() -> None:
    two = [entry(0, 0.0, 0), entry(1, 1.0, 0), entry(2, 0.0, 1), entry(3, 1.0, 1)]
    assert neighbors(two) == [{1: 1}, {-1: 0}, {1: 3}, {-1: 2}]


def test_a_camera_that_missed_a_training_time_has_no_neighbor_across_it() -> None:
    entries = [
        entry(0, 0.0, 0),
        entry(1, 1.0, 0),
        entry(2, 2.0, 0),
        entry(3, 0.0, 1),
        entry(4, 2.0, 1),
    ]
    assert neighbors(entries) == [{1: 1}, {-1: 0, 1: 2}, {-1: 1}, {}, {}]


def test_a_scene_holds_what_was_written(toy: Scene) -> None:
    truth = ToyScene()
    assert len(toy.train) == 6 and toy.test == [] and toy.times.tolist() == [0, 1, 2, 3, 4, 5]
    for f in toy.train:
        radiance, moving, _ = truth.see(f.time)
        assert f.moving is not None and f.disparity is not None
        recorded = np.clip(radiance * 2.0 ** EV[f.bracket], 0, 1) ** (1 / 2.2)
        assert float(np.abs(f.image.numpy() - recorded).max()) <= 0.5 / 255 + 1e-6
        assert torch.equal(f.moving, torch.from_numpy(moving))
        assert sorted({round(1 / v, 2) for v in f.disparity.unique().tolist()}) == pytest.approx(
            [CARD, WALL], rel=1e-3
        )
        assert set(f.flow) == set(f.neighbors) == {o for o in (-1, 1) if 0 <= f.index + o < 6}


def test_the_outline_of_a_mask_is_two_pixels_on_either_side() -> None:
    mask = torch.zeros(12, 12, dtype=torch.bool)
    mask[:, 6:] = True
    assert outline(mask).any(0).nonzero()[:, 0].tolist() == [4, 5, 6, 7]
    assert torch.equal(outline(mask), outline(~mask))
    assert not outline(torch.ones(8, 8, dtype=torch.bool)).any()  # the picture's edge is no outline


@pytest.mark.parametrize("provenance", ["estimated", "given"])
def test_only_an_estimated_mask_has_a_doubtful_outline(
    toy_folder: Path, tmp_path: Path, provenance: str
) -> None:
    folder = shutil.copytree(toy_folder, tmp_path / "scene")
    manifest = Manifest.load(folder)
    manifest.steps["masks"] = StepRecord(done=True, provenance=provenance)
    manifest.save(folder)
    f = Scene.open(folder).train[0]
    assert f.moving is not None and (f.outline is None) == (provenance == "given")
    assert f.outline is None or (f.outline.any() and not f.outline.all())


def test_held_out_frames_lend_no_map_to_training(toy_folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(toy_folder, tmp_path / "scene")
    data = json.loads((folder / "scene.json").read_text())
    data["frames"][2]["split"] = "test"
    (folder / "scene.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match="--redo movers"):
        Scene.open(folder)
    write_movers(folder / "movers.npz", [])
    scene = Scene.open(folder)
    assert [f.index for f in scene.train] == [0, 1, 3, 4, 5]
    assert [f.index for f in scene.test] == [2]
    assert scene.test[0].flow == {} and scene.test[0].neighbors == {}
    assert scene.train[1].neighbors == {-1: 0, 1: 2} and set(scene.train[1].flow) == {
        -1
    }  # no flow from 1 to 3 was made
    assert scene.times.tolist() == [0, 1, 3, 4, 5]


def test_frames_are_forgotten_and_read_again(
    toy_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_module, "MIN_KEPT_FRAMES", 1)
    monkeypatch.setattr(scene_module, "FRAME_MEMORY", 0)
    scene = Scene.open(toy_folder)
    first = scene.train[0].image
    assert scene.train[1].image is not None
    assert scene.train[0].image is not first and torch.equal(scene.train[0].image, first)
    moved = replace(scene.train[0], time=9.0)
    assert moved.time == 9.0 and torch.equal(moved.image, first)


def test_a_frame_of_another_camera_stays_in_the_folder(toy_folder: Path) -> None:
    frame = Scene.open(toy_folder).train[1]
    turned = frame.with_camera(frame.camera.resized(7, 5))
    assert (turned.camera.width, turned.index, turned.flow.keys()) == (7, 1, frame.flow.keys())
    assert torch.equal(turned.image, frame.image)
    assert isinstance(turned, StoredFrame) and turned.load is frame.load
    held = Frame(0, 0.0, frame.camera, 0, 0, frame.image)
    assert held.with_camera(turned.camera).camera is turned.camera
