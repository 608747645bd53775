"""Tracks of one camera that record at the same times, prepared."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_prepare import COUNT, H, W, given

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.footage.layouts import nerfstudio
from hdr_nsff.footage.layouts.writer import Source
from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Scene

EVS = {"bright": 1.0, "dark": -2.0}


@pytest.fixture
def config(tmp_path: Path) -> PrepareConfig:
    """The wall of `test_prepare.footage`, recorded twice at all times."""
    pattern = np.random.default_rng(0).normal(size=(H, W + 2 * COUNT, 3))
    pattern = cv2.GaussianBlur(pattern, (0, 0), 2.0)
    world = np.exp(0.8 * pattern / pattern.std() - 2.0)
    for name, ev in EVS.items():
        for t in range(COUNT):
            rgb = np.clip(world[:, 2 * t : 2 * t + W] * 2.0**ev, 0, 1) ** (1 / 2.2)
            write_png(tmp_path / "clip" / name / f"{t:03d}.png", rgb)
    maps = given(tmp_path / "maps")
    return PrepareConfig(
        tmp_path / "clip",
        tmp_path / "scene",
        same_camera=("bright", "dark"),
        hold_out=0,
        poses=maps["poses"],
        flow="dis",
    )


def test_both_tracks_share_times_poses_masks_and_a_response(config: PrepareConfig) -> None:
    scene = Scene.open(prepare(config))
    m = scene.manifest
    assert [f.bracket for f in m.frames] == [0] * COUNT + [1] * COUNT
    assert m.num_cameras == 1 and m.num_tracks == 2 and len(scene.times) == COUNT
    for one, other in zip(scene.train[:COUNT], scene.train[COUNT:], strict=True):
        assert one.time == other.time
        assert (one.camera.c2w == other.camera.c2w).all()
        assert one.moving is not None and (one.moving == other.moving).all()
    assert scene.train[5].neighbors == {-1: 4, 1: 6}
    assert scene.train[COUNT].neighbors == {1: COUNT + 1}  # never of the other track
    ev = scene.response.ev
    assert scene.response.source == "static points"
    assert abs(abs(ev[0] - ev[1]) - 3) < 0.3


def test_exposures_are_listed_one_per_track(config: PrepareConfig) -> None:
    scene = Scene.open(prepare(replace(config, ev="1,-2")))
    m = scene.manifest
    assert m.exposure_given and m.bracket_ev in ([0.0, -3.0], [3.0, 0.0])
    with pytest.raises(InputError, match="list one per track"):
        prepare(replace(config, ev="1,-2,0"))


def test_exposures_of_tracks_that_the_pixels_contradict_are_reported(
    config: PrepareConfig,
) -> None:
    m = Manifest.load(prepare(replace(config, ev="-2,1")))
    (doubt,) = m.steps["exposure"].details["doubts"]
    assert "0% of the exposure steps go the way the brightness goes" in doubt
    agreeing = prepare(replace(config, ev="1,-2", out=config.out.with_name("agreeing")))
    assert Manifest.load(agreeing).steps["exposure"].details["doubts"] == []


def test_a_csv_names_the_frames_of_tracks_with_their_folders(config: PrepareConfig) -> None:
    rows = [f"{name}/{t:03d}.png,{ev}" for name, ev in EVS.items() for t in range(COUNT)]
    text = "\n".join(["file,ev", *rows])
    (config.clip / "exposures.csv").write_text(text)
    m = Scene.open(prepare(config)).manifest
    assert [f.bracket for f in m.frames] == [0] * COUNT + [1] * COUNT
    assert m.exposure_given and m.bracket_ev in ([0.0, -3.0], [3.0, 0.0])


def test_exported_to_nerfstudio_tracks_become_cameras(config: PrepareConfig) -> None:
    scene = Scene.open(prepare(config))
    out = config.out.with_name("export")
    nerfstudio.write(Source.open(scene.folder), out)
    again = prepare(PrepareConfig(out, config.out.with_name("again"), hold_out=0, flow="dis"))
    cameras = [f.camera_id for f in Manifest.load(again).frames]
    assert cameras == [0] * COUNT + [1] * COUNT


def test_given_maps_of_tracks_are_found_by_the_names_of_the_tracks(config: PrepareConfig) -> None:
    width = {"bright": 8, "dark": 4}  # px that move in each mask
    for name, columns in width.items():
        for t in range(COUNT):
            mask = np.arange(W)[None, :].repeat(H, 0) < columns
            write_png(config.clip.with_name("masks") / name / f"{t:03d}.png", mask)
    masks = config.clip.with_name("masks")
    for order in (("bright", "dark"), ("dark", "bright")):
        changes = {"same_camera": order, "masks": masks, "out": config.out / order[0]}
        scene = Scene.open(prepare(replace(config, **changes)))
        for f, frame in zip(scene.manifest.frames, scene.train, strict=True):
            assert frame.moving is not None
            assert frame.moving.sum() == H * width[Path(f.source).parent.name]
    (masks / "dark/011.png").rename(masks / "bright/012.png")
    with pytest.raises(InputError, match=r"--mask .*: 13 in bright and 11 in dark; every camera"):
        prepare(replace(config, masks=masks, out=config.out / "moved"))
