"""Held-out views written in a public layout come back as the same truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import miniatures as mini
import numpy as np
import pytest
from layout_scenes import exported_scene, write_truth

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import read_image, read_mask, write_png
from hdr_nsff.core.io import write_json
from hdr_nsff.footage.datasets import recognize
from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.rendering.export import ExportConfig, export
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.truth import Truth, true_pictures


@pytest.fixture
def scene(toy_folder: Path, tmp_path: Path) -> Path:
    return exported_scene(toy_folder, tmp_path / "scene")


@pytest.fixture
def kept(scene: Path) -> tuple[Path, Path, Truth]:
    """A scene with its truth; brighter brackets have larger exposures in both."""
    m = Manifest.load(scene)
    for f in m.frames:
        write_png(scene / f.image, read_image(scene / f.image) * (1.0, 0.5, 0.25)[f.bracket])
    return scene, scene.with_name("truth"), write_truth(scene, scene.with_name("truth"))


def pose_in_scene(scene: Path, name: str) -> np.ndarray:
    """The pose (3, 4) of a view in the scene's world."""
    anchors = {"a": 4, "b": 5, "c": 0, "odd": 0}
    if name == "off":
        return mini.pose(0.4)
    return np.array(Manifest.load(scene).frames[anchors[name]].c2w)


@pytest.mark.parametrize(
    ("layout", "names"), [("hdr-gopro", "abc"), ("nerfstudio", ["a", "b", "c", "off", "odd"])]
)
def test_a_round_trip_keeps_the_views_of_a_truth(
    layout: Literal["hdr-gopro", "nerfstudio"], names: Sequence[str], kept: tuple[Path, Path, Truth]
) -> None:
    scene, folder, truth = kept
    out = export(ExportConfig(scene, scene.with_name("out"), layout=layout, truth=folder))
    again = prepare(PrepareConfig(out, scene.with_name("again")))
    place = again.with_name("again_truth")
    back, before = Truth.open(place), {v.name: v for v in truth.views}
    assert [v.name for v in back.views] == list(names)
    assert len(Manifest.load(again).frames) == len(Manifest.load(scene).frames)
    assert back.clip_c2w is not None
    for view in back.views:
        old = before[view.name]
        c2w = np.array(view.c2w or back.clip_c2w[view.anchor])
        tolerance = 1e-6 if view.name == "off" else 0
        assert np.allclose(c2w, pose_in_scene(scene, view.name), atol=tolerance, rtol=0)
        assert (view.time, view.bracket) == (old.time, old.bracket)
        assert view.radiance is None
        recorded = true_pictures(truth, old, folder)[1][old.bracket]
        exact = recorded if old.recorded else np.float32(np.rint(recorded * 255) / 255)
        assert (true_pictures(back, view, place)[1][view.bracket] == exact).all()
        assert exact.std() > 0.05
        assert view.mask
        assert old.mask
        assert (read_mask(place / view.mask) == read_mask(folder / old.mask)).all()


def test_a_view_that_the_gopro_layout_cannot_hold_is_named(
    kept: tuple[Path, Path, Truth], capsys: pytest.CaptureFixture[str]
) -> None:
    scene, folder, _ = kept
    out = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro", truth=folder))
    assert "left out 2 of 5 held-out views (off, odd)" in " ".join(capsys.readouterr().err.split())
    dense = out / "dense"
    found = sorted(p.relative_to(dense).as_posix() for p in dense.glob("mv_*/*/*"))
    assert found == [
        "mv_images/00001/00005.png",
        "mv_images/00003/00001.png",
        "mv_images_time/00002/00006.png",
        "mv_masks/00001/00005.png",
        "mv_masks/00003/00001.png",
        "mv_masks_time/00002/00006.png",
    ]


def test_cameras_of_a_rig_keep_their_numbers(kept: tuple[Path, Path, Truth]) -> None:
    """Frames 0 and 3 belong to camera 1, frames 1 and 4 to camera 2."""
    scene, folder, _ = kept
    m = Manifest.load(scene)
    for f in m.frames:
        f.c2w = m.frames[f.index % 3].c2w
    m.save(scene)
    write_truth(scene, folder)
    out = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro", truth=folder))
    assert (out / "dense/mv_images/00001/00002.png").is_file()
    assert (out / "dense/mv_images_time/00002/00003.png").is_file()


def test_a_truth_that_does_not_fit_the_scene_is_refused(
    kept: tuple[Path, Path, Truth], tmp_path: Path
) -> None:
    scene, folder, truth = kept
    config = ExportConfig(scene, tmp_path / "out", layout="nerfstudio", truth=folder)
    with pytest.raises(InputError, match=r"no truth\.json here"):
        export(replace(config, truth=tmp_path / "nothing"))
    with pytest.raises(InputError, match="overlaps the truth folder"):
        export(replace(config, out=folder / "inside"))
    with pytest.raises(InputError, match="use it with --layout"):
        export(replace(config, layout=None, ply=True, out=tmp_path / "a.ply"))
    assert truth.clip_c2w is not None
    shorter = truth.model_copy(update={"clip_c2w": truth.clip_c2w[:5]})
    write_json(folder / "truth.json", shorter.model_dump())
    with pytest.raises(InputError, match="a clip of 5 frames, the scene has 6"):
        export(config)
    write_json(folder / "truth.json", truth.model_dump())
    write_exr(folder / "radiance/b.exr", {"RGB": np.ones((8, 9, 3), np.float32)})
    with pytest.raises(InputError, match="view b has 9x8 pixels"):
        export(config)


def test_the_exported_note_on_held_out_views_is_validated(kept: tuple[Path, Path, Truth]) -> None:
    scene, folder, _ = kept
    out = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro", truth=folder))
    note = out / "dense/hdr_nsff.json"
    content = json.loads(note.read_text())
    (first, entry), *_ = content["held_out"].items()
    for wrong, words in (
        ({first: entry | {"anchor": "00099.png"}}, "pose of 00099.png"),
        ({first: entry | {"bracket": 7}}, "bracket 7"),
        ({first: entry | {"name": "../up"}}, "name"),
    ):
        note.write_text(json.dumps(content | {"held_out": wrong}))
        with pytest.raises(InputError, match=words):
            recognize(out)
    note.write_text(json.dumps(content | {"held_out": {"../../scene/images/00000.png": entry}}))
    with pytest.raises(InputError, match="points outside the data set"):
        prepare(PrepareConfig(out, scene.with_name("again")))
    note.write_text(json.dumps(content))
    (out / "dense" / first).unlink()
    with pytest.raises(InputError, match="it is held-out view a"):
        prepare(PrepareConfig(out, scene.with_name("again")))
