"""`prepare` on Blender, HDR-NeRF and nerfstudio folders."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import miniatures as mini
import numpy as np
import pytest
from miniatures import EV, H, W

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.io import write_npy
from hdr_nsff.prepare.prepare import PrepareConfig, held_out_truth, prepare
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Scene
from hdr_nsff.scene.truth import Truth


def provenance(folder: Path) -> dict[str, str]:
    """Where each step's result comes from."""
    return {name: step.provenance for name, step in Manifest.load(folder).steps.items()}


def still(tmp_path: Path, count: int, root: Path) -> PrepareConfig:
    """A set without masks and depth; both are given, which saves their estimation."""
    for k in range(count):
        write_png(tmp_path / f"masks/{k}.png", mini.left(3))
        write_npy(tmp_path / f"depth/{k}.npy", np.full((H, W), 4.0, np.float32))
    return PrepareConfig(
        root, tmp_path / "scene", masks=tmp_path / "masks", depth=tmp_path / "depth"
    )


# Blender


@pytest.mark.parametrize("kind", ["hexplane", "hdr4d"])
def test_stored_exposures_are_known_in_stops(kind: str, tmp_path: Path) -> None:
    config = still(tmp_path, 8, mini.blender(tmp_path / "set", kind))
    m = Manifest.load(prepare(config))
    assert m.exposure_given
    assert m.steps["exposure"].details["source"] == "data set"
    gauge = m.frames[0].ev  # of EV[0]
    assert gauge is not None
    assert [round(f.ev - gauge, 6) for f in m.frames if f.ev is not None] == [
        EV[t % 3] - EV[0] for t in (0, 1, 2, 3, 5, 6, 7, 9)
    ]
    assert [f.time for f in m.frames] == [0, 1, 2, 3, 5, 6, 7, 9]
    truth = Truth.open(config.out.with_name("scene_truth"))
    assert [v.time for v in truth.views] == [4, 8]
    evs = [truth.bracket_ev[v.bracket] for v in truth.views]
    assert [ev - gauge for ev in evs if ev is not None] == pytest.approx(
        [EV[1] - EV[0], EV[2] - EV[0]]
    )


def test_fractional_times_count_frames(tmp_path: Path) -> None:
    config = still(tmp_path, 8, mini.blender(tmp_path / "set", "dnerf"))
    m = Manifest.load(prepare(config))
    assert [f.time for f in m.frames] == [0, 1, 2, 3, 5, 6, 7, 9]
    assert m.cycle == 1
    assert [v.time for v in Truth.open(config.out.with_name("scene_truth")).views] == [4, 8]


def test_transparent_pixels_are_white(tmp_path: Path) -> None:
    prepare(still(tmp_path, 8, mini.blender(tmp_path / "set")))
    seen = np.float32(mini.see(mini.blender_pose(0), EV[0]))
    shown = read_image(tmp_path / "scene/images/00000.png")
    quarter = 64 / 255
    assert np.allclose(shown[:-2], seen[:-2], atol=1e-6)
    assert np.allclose(shown[-2:], quarter * seen[-2:] + 1 - quarter, atol=2e-5)
    view = Truth.open(tmp_path / "scene_truth").views[0]
    held_out = read_image(tmp_path / "scene_truth" / view.recorded[view.bracket])
    seen = mini.see(mini.blender_pose(4), EV[1])
    assert np.allclose(held_out[-2:], quarter * seen[-2:] + 1 - quarter, atol=2e-5)


def test_exact_radiance_of_held_out_views_is_kept(tmp_path: Path) -> None:
    prepare(still(tmp_path, 8, mini.blender(tmp_path / "set", "hdr4d")))
    truth = Truth.open(tmp_path / "scene_truth")
    for view, t in zip(truth.views, (4, 8), strict=True):
        assert view.radiance is not None
        radiance = read_exr(tmp_path / "scene_truth" / view.radiance)["RGB"]
        assert (radiance == mini.radiance(mini.blender_pose(t))).all()
    assert not list((tmp_path / "scene").rglob("*.exr"))  # nor that of training pictures


def test_a_time_outside_the_training_pictures_cannot_be_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = mini.blender(tmp_path / "set")
    path = root / "transforms_test.json"
    path.write_text(path.read_text().replace('"time": 8', '"time": 12'))
    prepare(still(tmp_path, 8, root))
    assert [v.time for v in Truth.open(tmp_path / "scene_truth").views] == [4]
    assert "1 of 2 held-out views" in capsys.readouterr().err


def test_several_pictures_of_one_time_become_cameras(tmp_path: Path) -> None:
    root = mini.blender(tmp_path / "set", "dnerf")
    path = root / "transforms_train.json"
    document = json.loads(path.read_text())
    for k, frame in enumerate(document["frames"]):
        frame["time"] = (k // 2) / 3
    path.write_text(json.dumps(document))
    config = replace(still(tmp_path, 8, root), masks=None, depth=None, max_size=32)
    m = Manifest.load(prepare(config))
    expected = [(camera, time) for camera in (0, 1) for time in (0, 1, 2, 3)]
    assert [(f.camera_id, f.time) for f in m.frames] == expected


# HDR-NeRF and nerfstudio


def reference_of_rounds(m: Manifest) -> float:
    """The EV of the first picture of a still scene whose first, third and fifth
    exposures, all given, come in turn.
    """
    gauge = m.frames[0].ev
    assert gauge is not None
    assert [f.ev - gauge for f in m.frames if f.ev is not None] == pytest.approx([0, 4, 8, 0, 4, 8])
    assert m.steps["masks"].provenance == "given"
    assert m.exposure_given
    return gauge


def test_a_still_scene_trains_on_one_of_five_exposures_per_view(tmp_path: Path) -> None:
    config = replace(still(tmp_path, 6, mini.hdr_nerf(tmp_path / "set")), masks=None)
    m = Manifest.load(prepare(config))
    assert [f.source for f in m.frames] == [f"train/r_{n}_{(0, 2, 4)[n % 3]}.png" for n in range(6)]
    reference_of_rounds(m)
    assert not any(f.moving.any() for f in Scene.open(config.out).train if f.moving is not None)


def test_all_five_exposures_of_a_held_out_view_are_kept(tmp_path: Path) -> None:
    config = replace(still(tmp_path, 6, mini.hdr_nerf(tmp_path / "set")), masks=None)
    m = Manifest.load(prepare(config))
    truth = Truth.open(tmp_path / "scene_truth")
    view = truth.views[0]
    assert len(view.recorded) == 5
    assert view.radiance is not None
    # Two exposures occur in no training picture.
    assert sum(f is None for f in truth.bracket_frame or []) == 2
    zero = m.frames[0].ev
    assert zero is not None
    for bracket, name in view.recorded.items():
        ev = truth.bracket_ev[bracket]
        assert ev is not None
        expected = mini.see(mini.pose(0.3), ev - zero - 4)
        assert (read_image(tmp_path / "scene_truth" / name) == np.float32(expected)).all()


def test_every_second_pose_of_a_real_hdr_nerf_scene_is_held_out(tmp_path: Path) -> None:
    config = replace(still(tmp_path, 6, mini.hdr_nerf_real(tmp_path / "set")), masks=None)
    m = Manifest.load(prepare(config))
    assert [f.source for f in m.frames] == [
        f"input_images/{2 * k:03d}_{(0, 2, 4)[k % 3]}.png" for k in range(6)
    ]
    gauge = reference_of_rounds(m)
    assert all(
        np.allclose(f.c2w, mini.pose(0.2 * k)) for k, f in enumerate(m.frames) if f.c2w is not None
    )
    folder = tmp_path / "scene_truth"
    truth = Truth.open(folder)
    assert len(truth.views) == 6
    assert sum(f is None for f in truth.bracket_frame or []) == 2
    for k, view in enumerate(truth.views):
        assert len(view.recorded) == 5
        assert np.allclose(view.c2w, mini.pose(0.1 * (2 * k + 1)))
        for bracket, name in view.recorded.items():
            ev = truth.bracket_ev[bracket]
            assert ev is not None
            expected = mini.see(mini.pose(0.1 * (2 * k + 1)), ev - gauge - 4)
            assert (read_image(folder / name) == np.float32(expected)).all()


def test_nerfstudio_pictures_go_by_name_and_depth_is_in_millimeters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = PrepareConfig(mini.nerfstudio(tmp_path / "set"), tmp_path / "scene", max_size=W)
    m = Manifest.load(prepare(config))
    assert [f.source for f in m.frames] == [
        f"images/frame_{n:05d}.png" for n in (0, 1, 2, 3, 5, 6, 7)
    ]
    assert [f.time for f in m.frames] == [0, 1, 2, 3, 5, 6, 7]
    disparity = Scene.open(config.out).train[0].disparity[0, 0]
    assert float(1 / disparity) == pytest.approx(mini.WALL, rel=1e-3)
    assert provenance(config.out)["masks"] == "estimated"
    assert "not moving ones: not used" in " ".join(capsys.readouterr().err.split())
    view = Truth.open(tmp_path / "scene_truth").views[0]
    assert (view.name, view.time) == ("images_frame_00004", 4.0)


def test_depth_in_16_bit_pictures_is_in_millimeters_too(tmp_path: Path) -> None:
    root = mini.nerfstudio(tmp_path / "set")
    for path in (root / "depth").glob("*.npy"):
        write_png(path.with_suffix(".png"), np.full((H, W, 3), 1000 * mini.WALL / 65535), bits=16)
    text = (root / "transforms.json").read_text()
    (root / "transforms.json").write_text(re.sub(r"depth/(\d)\.npy", r"depth/\1.png", text))
    scene = Scene.open(prepare(PrepareConfig(root, tmp_path / "scene", max_size=W)))
    assert float(1 / scene.train[0].disparity[0, 0]) == pytest.approx(mini.WALL, rel=1e-3)


def test_an_unknown_name_in_the_list_of_held_out_pictures_is_refused(tmp_path: Path) -> None:
    root = mini.nerfstudio(tmp_path / "set", test_filenames=["images/frame_00009.png"])
    with pytest.raises(InputError, match=r"frame_00009\.png is listed as held out"):
        prepare(PrepareConfig(root, tmp_path / "scene"))


def test_a_data_set_that_holds_nothing_out_has_no_truth(tmp_path: Path) -> None:
    config = PrepareConfig(mini.gopro(tmp_path / "set", held_out=False), tmp_path / "scene")
    prepare(config)
    assert held_out_truth(config) is None
    assert not (tmp_path / "scene_truth").exists()
    assert len(Scene.open(config.out).test) == 1  # every eighth frame, as of any footage
