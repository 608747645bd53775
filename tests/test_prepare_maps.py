"""Given masks and depth, what they tell of near and far, and the contact sheet."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from test_prepare import COUNT, FOCAL, H, W, config  # noqa: F401

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.core.io import write_npy
from hdr_nsff.prepare.prepare import prepare
from hdr_nsff.prepare.steps.masks import moving_share
from hdr_nsff.prepare.steps.sheet import NO_FLOW, flow_cell, places_shown
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Scene

# ruff: noqa: F811


def test_a_tripod_that_moves_is_doubted():
    moving = np.ones((3, 4, 4), bool)
    assert "leave out --tripod" in moving_share(moving, tripod=True)
    assert "--tripod" not in moving_share(moving, tripod=False)
    assert "--tripod" not in moving_share(~moving, tripod=True)


def poses_without_range(bounds: Path, path: Path) -> Path:
    """The poses of `given` as a `transforms.json`, which tells no near and far."""
    transforms = {"w": W, "h": H, "fl_x": FOCAL, "fl_y": FOCAL, "cx": W / 2, "cy": H / 2}
    transforms["frames"] = []
    for t, row in enumerate(np.load(bounds)):
        pose = np.eye(4)
        pose[0, 3] = row[3]
        frame = {"file_path": f"{t:03d}.png", "transform_matrix": pose.tolist()}
        transforms["frames"].append(frame)
    path.write_text(json.dumps(transforms))
    return path


def test_depth_in_a_folder_tells_near_and_far_where_poses_do_not(config, tmp_path):
    known = Manifest.load(prepare(config))
    assert (known.near, known.far) == (0.8, 5)  # of the poses, with room
    for t in range(COUNT):
        write_npy(tmp_path / f"far/{t:03d}.npy", np.full((H, W), 8.0, np.float32))
    poses = poses_without_range(config.poses, tmp_path / "transforms.json")
    far = replace(config, poses=poses, depth=tmp_path / "far", out=tmp_path / "other")
    m = Manifest.load(prepare(far))
    assert 4 < m.near < 8 < m.far < 16


def test_flow_tells_near_and_far_where_neither_poses_nor_relative_depth_do(config, tmp_path):
    """The wall is at z = 2."""
    poses = poses_without_range(config.poses, tmp_path / "transforms.json")
    relative = replace(config, poses=poses, depth_kind="relative")
    m = Manifest.load(prepare(relative))
    assert 1 < m.near < 2 < m.far < 4 and m.depth_kind == "relative"
    for path in config.flow.iterdir():
        write_npy(path, np.zeros((H, W, 2), np.float32))
    with pytest.raises(InputError, match="too little parallax"):
        prepare(replace(relative, redo=("flow",)))


@pytest.mark.parametrize("tripod", [False, True])
def test_near_and_far_of_earlier_depth_do_not_stay(config, tmp_path, tripod):
    config = replace(config, tripod=tripod, poses=None if tripod else config.poses)
    disparity = np.full((H, W), 0.1, np.float32)
    disparity[:8] = 0  # sky
    for t in range(COUNT):
        write_npy(tmp_path / f"far/{t:03d}.npy", disparity)
    far = replace(config, depth=tmp_path / "far", depth_kind="disparity")
    geometric = replace(config, depth=None)

    def depths(config):
        m = Manifest.load(prepare(config))
        return m.near, m.far

    fresh = {c: depths(replace(c, out=tmp_path / f"fresh_{c is far}")) for c in (far, geometric)}
    assert fresh[far] != fresh[geometric]
    for again in (geometric, far, geometric):
        assert depths(again) == fresh[again]


@pytest.mark.parametrize("codes", [np.uint8(1), np.array([0, 0, 128], np.uint8)])
def test_masks_without_white_are_refused(config, codes):
    for path in sorted(config.masks.glob("*.png")):
        moving = read_mask(path)
        cv2.imwrite(str(path), moving[..., None] * codes)
    with pytest.raises(InputError, match="no mask is white anywhere"):
        prepare(config)


def test_masks_that_mark_nothing_are_taken(config):
    for path in sorted(config.masks.glob("*.png")):
        write_png(path, np.zeros((H, W)))
    assert not any(f.moving.any() for f in Scene.open(prepare(config)).train)


@pytest.mark.parametrize("count", [3, 6, 10, 11, 31, 36])
@pytest.mark.parametrize("cycle", [1, 2, 3])
def test_the_sheet_shows_all_exposures_over_the_whole_clip(count, cycle):
    brackets = [t % cycle for t in range(count)]
    places = places_shown(brackets)
    shown = [brackets[k] for k in places]
    assert len(places) == min(count, 6) and places[0] == 0 and places[-1] >= count - cycle
    assert {shown.count(b) for b in range(cycle)} == {len(shown) // cycle} or count < 6
    assert max(np.diff(places)) <= count / 5 + 2 * cycle


def test_a_frame_without_flow_is_gray_in_the_sheet(config):
    prepare(config)
    m = Manifest.load(config.out)
    cell = flow_cell(SimpleNamespace(folder=config.out, manifest=m), m.frames[0])
    assert cell.shape == (H, W, 3) and cell.std() > 0
    alone = m.frames[0].model_copy(update={"flow": {}})
    assert (flow_cell(SimpleNamespace(folder=config.out, manifest=m), alone) == NO_FLOW).all()
