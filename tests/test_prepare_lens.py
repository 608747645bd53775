"""What `prepare` does about the lens: settings, given lenses, frames undistorted
once.
"""

import json

import numpy as np
import pytest
from posed_clips import PLACES, H, K, W, sliding

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.geometry.lens import Lens, undistorted_picture
from hdr_nsff.prepare.engine import run_step, step_key
from hdr_nsff.prepare.lens import known_lenses, lens_to_find, parse_lens
from hdr_nsff.prepare.prepare import STEPS, begin
from hdr_nsff.prepare.steps.poses import find_poses
from hdr_nsff.prepare.work import PrepareConfig
from hdr_nsff.scene.manifest import LensEntry, Manifest

LENS = Lens(K, (0.15, 0.0, 0.0, 0.0), W, H)


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    """Four frames, and a transforms.json that says they are distorted."""
    folder = tmp_path_factory.mktemp("distorted")
    frames = []
    for t, picture in enumerate(sliding(PLACES[:4])):
        write_png(folder / "clip" / f"{t}.png", picture)
        pose = np.eye(4)
        pose[:3, 3] = PLACES[t]
        frames.append({"file_path": f"{t}.png", "transform_matrix": pose.tolist()})
    size = {"w": W, "h": H, "fl_x": K[0, 0], "cx": W / 2, "cy": H / 2, "k1": 0.15}
    (folder / "poses.json").write_text(json.dumps({"frames": frames, **size}))
    return folder


def test_the_option_is_read_or_refused_in_a_sentence():
    assert parse_lens("auto") == "auto" and parse_lens("none") == "none"
    assert parse_lens("-0.2") == (-0.2, 0) and parse_lens("-0.2,0.03") == (-0.2, 0.03)
    for text in ("", "much"):
        with pytest.raises(InputError, match="no such file; write auto, none, K1"):
            parse_lens(text)
    for text in ("1,2,3", "nan", "inf,0", "-99"):
        with pytest.raises(InputError, match=r"one or two numbers.*K1"):
            parse_lens(text)


def test_frames_of_given_poses_are_undistorted_and_poses_are_of_a_pinhole(tmp_path, footage):
    config = PrepareConfig(footage / "clip", tmp_path / "scene", poses=footage / "poses.json")
    work = begin(config)
    run_step(work, "frames", STEPS["frames"])
    straight = undistorted_picture(read_image(footage / "clip" / "2.png"), LENS)
    assert np.abs(read_image(tmp_path / "scene" / "images" / "00002.png") - straight).max() < 3e-3
    entry = Manifest.load(tmp_path / "scene").lens[0]
    assert entry.given and entry.distortion == [0.15, 0, 0, 0]
    focal = find_poses(work).frames["K"][0][0][0]
    assert focal == pytest.approx(LENS.pinhole()[0, 0])


def test_each_camera_of_a_rig_has_the_lens_of_its_pose(tmp_path):
    bends = {"left": 0.15, "middle": 0.0, "right": -0.1}
    frames = []
    for camera, k1 in bends.items():
        for t, picture in enumerate(sliding(PLACES[:3])):
            write_png(tmp_path / "rig" / camera / f"{t}.png", picture)
        pose = np.eye(4)
        pose[0, 3] = k1
        size = {"w": W, "h": H, "fl_x": K[0, 0], "cx": W / 2, "cy": H / 2, "k1": k1}
        frames.append({"file_path": camera, "transform_matrix": pose.tolist(), **size})
    (tmp_path / "poses.json").write_text(json.dumps({"frames": frames}))
    work = begin(PrepareConfig(tmp_path / "rig", tmp_path / "scene", poses=tmp_path / "poses.json"))
    assert {c: e.distortion[0] for c, e in work.manifest.lens.items()} == {0: 0.15, 2: -0.1}
    run_step(work, "frames", STEPS["frames"])
    found = find_poses(work).frames
    lenses = [Lens(K, (k1, 0.0, 0.0, 0.0), W, H) for k1 in bends.values()]
    focals = [lenses[0].pinhole()[0, 0], K[0, 0], lenses[2].pinhole()[0, 0]]
    assert [found["K"][t][0][0] for t in (0, 4, 8)] == pytest.approx(focals)
    assert [found["c2w"][t][0][3] for t in (0, 4, 8)] == pytest.approx(list(bends.values()))
    for camera, lens in enumerate(lenses):
        recorded = read_image(tmp_path / "rig" / list(bends)[camera] / "1.png")
        straight = undistorted_picture(recorded, lens) if lens.distortion[0] else recorded
        seen = read_image(tmp_path / "scene" / "images" / f"{3 * camera + 1:05d}.png")
        assert np.abs(seen - straight).max() < 3e-3


def test_the_lens_of_a_scene_stays_while_the_settings_ask_for_it(tmp_path):
    found, given = LensEntry.of(LENS, given=False), LensEntry.of(LENS, given=True)
    for entry, choice, stays in (
        *((found, "auto", True), (given, "auto", False), (found, "none", False)),
        *((given, "0.15", True), (given, "0.2", False), (found, "0.15", False)),
    ):
        manifest = Manifest(source="clip", width=W, height=H, lens={0: entry})
        config = PrepareConfig(tmp_path, tmp_path, lens_distortion=choice)
        assert bool(known_lenses(manifest, config)) == stays
    assert not known_lenses(manifest, PrepareConfig(tmp_path, tmp_path, redo=("frames",)))


def test_a_scene_keeps_its_lens_on_disk(tmp_path):
    Manifest(source="clip", width=W, height=H, lens={0: LensEntry.of(LENS, False)}).save(tmp_path)
    again = Manifest.load(tmp_path).lens[0].lens()
    assert np.array_equal(again.K, LENS.K) and again.distortion == LENS.distortion


def test_a_calibration_undistorts_the_frames(tmp_path, footage):
    text = f"1 SIMPLE_RADIAL {2 * W} {2 * H} {2 * K[0, 0]} {W} {H} 0.15\n"
    (tmp_path / "cameras.txt").write_text(text)
    file = str(tmp_path / "cameras.txt")
    config = PrepareConfig(footage / "clip", tmp_path / "scene", lens_distortion=file)
    work = begin(config)
    run_step(work, "frames", STEPS["frames"])
    straight = undistorted_picture(read_image(footage / "clip" / "2.png"), LENS)
    assert np.abs(read_image(tmp_path / "scene" / "images" / "00002.png") - straight).max() < 3e-3
    assert work.manifest.lens[0].given and lens_to_find(work) == "none"
    done = work.manifest.steps["frames"].key
    assert step_key(begin(config), "frames", STEPS["frames"]) == done  # read again, the same


def test_a_calibration_of_another_shape_is_refused(tmp_path, footage):
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 100 900 500 50 450 0.15\n")
    file = str(tmp_path / "cameras.txt")
    with pytest.raises(InputError, match="another shape"):
        begin(PrepareConfig(footage / "clip", tmp_path / "scene", lens_distortion=file))
