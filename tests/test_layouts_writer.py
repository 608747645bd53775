"""An export replaces the files of an earlier one, and no others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from estimates import forget_movers
from layout_scenes import LAYOUTS, exported_scene, files_of

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.rendering.export import ExportConfig, export
from hdr_nsff.scene.manifest import Manifest


@pytest.fixture
def scene(toy_folder: Path, tmp_path: Path) -> Path:
    return exported_scene(toy_folder, tmp_path / "scene")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_exporting_again_keeps_files_of_other_programs(layout: str, scene: Path) -> None:
    out = scene.with_name("out")
    config = ExportConfig(scene, out, layout=layout)  # type: ignore[arg-type]
    whole = files_of(export(config))
    mine = {"logs/my_training.txt": b"a", "notes.md": b"b", "logs/old/c.txt": b"c"}
    for name, data in mine.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(data)
    export(config)
    assert files_of(out) == whole | mine


@pytest.mark.parametrize("layout", LAYOUTS)
def test_exporting_again_removes_files_of_the_earlier_export(layout: str, scene: Path) -> None:
    out = scene.with_name("out")
    config = ExportConfig(scene, out, layout=layout)  # type: ignore[arg-type]
    export(config)
    (out / "images").mkdir(exist_ok=True)
    (out / "images/mine.txt").write_text("mine")
    m = Manifest.load(scene)
    m.frames, m.points = m.frames[:4], None
    m.frames[3].flow.pop(4)
    m.save(scene)
    forget_movers(scene)
    export(config)
    left = files_of(out)
    assert left.pop("images/mine.txt") == b"mine"
    assert left == files_of(export(replace(config, out=scene.with_name("new"))))


@pytest.mark.parametrize("name", ["transforms.json", "images", "depth/00002.npy", "depth"])
def test_a_file_in_the_way_of_an_export_is_named_and_stays(name: str, scene: Path) -> None:
    out = scene.with_name("out")
    export(ExportConfig(scene, out, layout="hdr-gopro"))
    mine = out / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    before = files_of(out)
    with pytest.raises(InputError, match="did not write"):
        export(ExportConfig(scene, out, layout="nerfstudio"))
    assert files_of(out) == before
    assert mine.read_text() == "mine"


def test_a_folder_in_place_of_a_file_is_named_and_stays(scene: Path) -> None:
    config = ExportConfig(scene, scene.with_name("out"), layout="nerfstudio")
    export(config)
    (config.out / "transforms.json").unlink()
    (config.out / "transforms.json").mkdir()
    with pytest.raises(InputError, match=r"transforms\.json: .* did not write"):
        export(config)


def test_an_export_that_was_killed_is_replaced_by_the_next(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = ExportConfig(scene, scene.with_name("out"), layout="nerfstudio")
    written = []

    def stop(source: Path, target: Path) -> None:
        if len(written) == 5:
            raise KeyboardInterrupt
        written.append(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(source.read_bytes())

    with monkeypatch.context() as patch:
        patch.setattr("hdr_nsff.footage.layouts.nerfstudio.copy", stop)
        with pytest.raises(KeyboardInterrupt):
            export(config)
    export(config)
    new = replace(config, out=scene.with_name("new"))
    assert files_of(config.out) == files_of(export(new))


@pytest.mark.parametrize("name", ["../mine.txt", "/etc/hostname", "link/mine.txt"])
def test_an_edited_note_removes_no_file_outside_of_the_export(name: str, scene: Path) -> None:
    config = ExportConfig(scene, scene.with_name("out"), layout="nerfstudio")
    note = export(config) / "hdr_nsff_export.json"
    (scene.with_name("other")).mkdir()
    for place in (scene.with_name("mine.txt"), scene.with_name("other") / "mine.txt"):
        place.write_text("mine")
    (config.out / "link").symlink_to(scene.with_name("other"))
    content = json.loads(note.read_text())
    note.write_text(json.dumps(content | {"files": [*content["files"], name]}))
    with pytest.raises(InputError, match="points outside the export"):
        export(config)
    assert scene.with_name("mine.txt").is_file()
    assert (scene.with_name("other") / "mine.txt").is_file()


def test_an_export_refuses_a_folder_that_no_export_made(scene: Path, tmp_path: Path) -> None:
    config = ExportConfig(scene, tmp_path / "out", layout="hdr-gopro")
    write_png(tmp_path / "mine/photo.png", np.zeros((4, 4, 3)))
    with pytest.raises(InputError, match="not made by export"):
        export(replace(config, out=tmp_path / "mine"))
    for place in (scene / "inside", scene, scene.parent):
        with pytest.raises(InputError, match="overlaps the scene folder"):
            export(replace(config, out=place))
