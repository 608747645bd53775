"""The step engine and the way from footage to a scene: skipped, redone, killed,
continued. Priors are given, so that it is quick.
"""

import json
import multiprocessing
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from hdr_nsff.core.images import read_image, read_mask, write_png
from hdr_nsff.core.io import write_npy
from hdr_nsff.geometry.round_trip import round_trip
from hdr_nsff.prepare.prepare import STEPS, PrepareConfig, prepare
from hdr_nsff.priors.flow.dense import average_with_reverse
from hdr_nsff.priors.flow.local_motion import LOCAL_MOTION_TUNING
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Scene

COUNT, H, W, FOCAL = 12, 32, 48, 40.0
EVS = (-2.0, 0.0, 2.0)


def footage(folder: Path, count: int = COUNT, blur: float = 0.0) -> Path:
    """A textured wall at z = 2, seen by a camera that slides along x by 0.1 per frame:
    the picture moves by -2 pixels.
    """
    pattern = np.random.default_rng(0).normal(size=(H, W + 2 * count, 3))
    if blur:
        pattern = cv2.GaussianBlur(pattern, (0, 0), blur)
        pattern /= pattern.std()
    world = np.exp(pattern * 0.8 - 2.0)
    for t in range(count):
        rgb = np.clip(world[:, 2 * t : 2 * t + W] * 2.0 ** EVS[t % 3], 0, 1) ** (1 / 2.2)
        write_png(folder / f"{t:03d}.png", rgb)
    return folder


def given(root: Path, count: int = COUNT) -> dict[str, Path]:
    """Exact poses, flow, masks and depth of `footage`."""
    rows = []
    for t in range(count):
        pose = np.array(
            [[0, 1, 0, 0.1 * t, H], [1, 0, 0, 0, W], [0, 0, -1, 0, FOCAL]]
        )  # LLFF: down, right, back
        rows.append([*pose.ravel(), 1.0, 4.0])
        write_png(root / f"masks/{t:03d}.png", np.arange(W)[None, :].repeat(H, 0) < 4)
        write_npy(root / f"depth/{t:03d}.npy", np.full((H, W), 2.0, np.float32))
        for other in range(max(t - 2, 0), min(t + 3, count)):
            write_npy(
                root / f"flow/{t:05d}_{other:05d}.npy",
                np.full((H, W, 2), [2.0 * (t - other), 0], np.float32),
            )
    write_npy(root / "poses_bounds.npy", np.array(rows))
    return {
        "poses": root / "poses_bounds.npy",
        "flow": root / "flow",
        "masks": root / "masks",
        "depth": root / "depth",
    }


@pytest.fixture
def config(tmp_path: Path) -> PrepareConfig:
    """Everything given, nothing held out."""
    return PrepareConfig(
        footage(tmp_path / "clip"), tmp_path / "scene", hold_out=0, **given(tmp_path / "given")
    )


def attempts(folder: Path) -> dict[str, int]:
    """How often each step was begun afresh."""
    return {name: step.details["attempt"] for name, step in Manifest.load(folder).steps.items()}


def stamps(folder: Path) -> dict[str, int]:
    """When each file was written."""
    return {
        p.relative_to(folder).as_posix(): p.stat().st_mtime_ns
        for p in folder.rglob("*")
        if p.is_file()
    }


def test_footage_becomes_a_scene_that_opens(config):
    scene = Scene.open(prepare(config))
    assert len(scene.train) == COUNT and not scene.test
    assert [f.bracket for f in scene.train] == [0, 1, 2] * 4
    middle = scene.train[5]
    assert (middle.camera.K[0, 0], middle.camera.c2w[0, 3]) == (FOCAL, pytest.approx(0.5))
    assert middle.neighbors == {-1: 4, 1: 6}
    assert (middle.flow[1] == -2 * np.array([1, 0])).all() and (
        middle.flow[-1] == 2 * np.array([1, 0])
    ).all()
    assert middle.flow_valid[1][:, 8:-8].all()
    assert middle.moving.sum() == 4 * H
    assert (middle.disparity == 0.5).all()


def test_the_manifest_records_the_provenance_of_every_step(config):
    m = Manifest.load(prepare(config))
    assert {name: step.provenance for name, step in m.steps.items()} == {
        "frames": "given",
        "exposure": "estimated",
        "flow": "given",
        "poses": "given",
        "masks": "given",
        "static_depth": "given",
        "response": "estimated",
        "refined_flow": "given",
        "movers": "estimated",
        "depth": "given",
        "sheet": "estimated",
    }
    assert m.inputs.keys() == {f"{t:03d}.png" for t in range(COUNT)} and all(
        len(h) == 64 for h in m.inputs.values()
    )
    assert (m.cycle, m.exposure_given, m.bracket_ev) == (3, False, [None] * 3)
    assert m.frames[7].source == "007.png"
    assert read_image(config.out / "contact_sheet.png").shape[0] > 5 * H


def test_frames_are_kept_exactly(config):
    prepare(config)
    for t in (0, 5, 11):
        assert np.array_equal(
            read_image(config.out / f"images/{t:05d}.png"), read_image(config.clip / f"{t:03d}.png")
        )


def test_a_second_run_does_nothing(config):
    before = stamps(prepare(config))
    start = time.monotonic()
    prepare(config)
    assert stamps(config.out) == before
    assert time.monotonic() - start < 1


def test_redo_does_a_step_and_what_builds_on_it(config):
    prepare(config)
    prepare(replace(config, redo=("poses",)))
    assert attempts(config.out) == {
        "frames": 1,
        "exposure": 1,
        "flow": 1,
        "poses": 2,
        "masks": 2,
        "static_depth": 2,
        "response": 2,
        "refined_flow": 2,
        "movers": 2,
        "depth": 2,
        "sheet": 2,
    }


def test_flow_is_refined_at_one_exposure_through_the_response(config):
    footage(config.clip, blur=2.0)
    prepare(replace(config, flow="dis"))
    steps = Manifest.load(config.out).steps
    assert steps["response"].note.startswith("779 static points, misfit 0.001")
    assert "at one exposure through the response" in steps["refined_flow"].note


def test_flow_of_movers_is_refined_and_what_was_matched_stays(config):
    estimated = replace(config, flow="dis")
    m = Manifest.load(prepare(estimated))
    f = m.frames[4]
    assert (f.flow[5].flow, f.flow[5].valid) == (
        "refined_flow/00004_00005.npy",
        "refined_flow/00004_00005_valid.png",
    )
    assert (f.raw_flow[5].flow, f.raw_flow[5].valid) == (
        "raw_flow/00004_00005.npy",
        "raw_flow/00004_00005_valid.png",
    )
    assert m.steps["refined_flow"].provenance == "estimated"
    before, after = (
        np.load(config.out / files[5].flow).astype(np.float32) for files in (f.raw_flow, f.flow)
    )
    back = np.load(config.out / m.frames[5].raw_flow[4].flow).astype(np.float32)
    trusted_px = LOCAL_MOTION_TUNING.trusted_round_trip_px
    sure = read_mask(config.out / f.raw_flow[5].valid) & (
        round_trip(before, back) < trusted_px - 0.02
    )
    changed = np.abs(average_with_reverse(before, back) - after).max(-1)
    assert (
        changed[:, :4].max() > 0.05 and sure[:, 7:].mean() > 0.5
    )  # 4 columns move, and others go there
    assert np.quantile(changed[:, 7:][sure[:, 7:]], 0.95) < 0.01  # the way back meets it halfway
    assert m.steps["refined_flow"].note.endswith("on frames equalized by brightness")

    (config.out / "refined_flow/00004_00005.npy").unlink()
    prepare(estimated)
    assert np.array_equal(np.load(config.out / "refined_flow/00004_00005.npy"), after)
    write_png(config.masks / "004.png", np.ones((H, W), bool))
    prepare(estimated)
    assert attempts(config.out)["flow"] == 1 and attempts(config.out)["refined_flow"] == 2
    assert np.array_equal(np.load(config.out / f.raw_flow[5].flow), before)
    assert not np.array_equal(np.load(config.out / f.flow[5].flow), after)


def test_a_changed_setting_redoes_what_depends_on_it(config):
    prepare(config)
    write_npy(
        config.depth / "003.npy", np.full((H, W), 3.0, np.float32)
    )  # the contents of a given folder count
    prepare(config)
    assert attempts(config.out) == {
        "frames": 1,
        "exposure": 1,
        "flow": 1,
        "poses": 1,
        "masks": 1,
        "static_depth": 2,
        "response": 2,
        "refined_flow": 2,
        "movers": 2,
        "depth": 2,
        "sheet": 2,
    }
    prepare(replace(config, ev="-2,0,2"))
    assert (
        attempts(config.out)["frames"] == 1
        and attempts(config.out)["exposure"] == 2
        and attempts(config.out)["flow"] == 2
    )


def test_a_lost_file_is_made_again_and_the_others_stay(config):
    before = stamps(prepare(config))
    (config.out / "raw_flow/00003_00004.npy").unlink()
    prepare(config)
    after = stamps(config.out)
    assert after.keys() == before.keys()
    assert {n for n in after if n.startswith("raw_flow/") and after[n] != before[n]} == {
        "raw_flow/00003_00004.npy",
        "raw_flow/00003_00004_valid.png",
    }


def test_lost_frames_are_read_again_and_everything_else_is_as_before(config):
    config = replace(config, poses=None, masks=None)  # estimated in two rounds

    def maps():
        files = [p for p in config.out.rglob("*") if p.suffix in (".npy", ".npz", ".png")]
        return {p: p.read_bytes() for p in files if p.parent.name != "poses"}

    prepare(config)
    before = maps()
    (config.out / "images/00003.png").unlink()
    prepare(config)
    assert maps() == before
    shutil.rmtree(config.out / "images")
    prepare(config)
    assert maps() == before


def test_a_changed_frame_of_the_same_footage_starts_over(config):
    prepare(config)
    write_png(config.clip / "004.png", np.full((H, W, 3), 0.5))
    prepare(config)
    assert attempts(config.out)["frames"] == 2
    assert np.allclose(read_image(config.out / "images/00004.png"), 0.5, atol=1 / 255)


def test_moved_footage_is_the_same_footage(config, tmp_path):
    before = stamps(prepare(config))
    config.clip.rename(tmp_path / "moved")
    prepare(replace(config, clip=tmp_path / "moved"))
    assert stamps(config.out) == before


def test_killed_at_any_moment_it_continues_to_the_same_scene(config, tmp_path):
    whole = prepare(replace(config, out=tmp_path / "whole"))
    kills = 0
    for delay in (0.02, 0.05, 0.1, 0.15, 0.2, 0.3):
        process = multiprocessing.get_context("fork").Process(target=prepare, args=(config,))
        process.start()
        time.sleep(delay)
        process.kill()
        process.join()
        kills += process.exitcode == -signal.SIGKILL
        if (config.out / "scene.json").exists():
            json.loads((config.out / "scene.json").read_text())  # never half-written
    assert kills
    prepare(config)
    names = {p.relative_to(whole) for p in whole.rglob("*") if p.is_file()}
    assert {p.relative_to(config.out) for p in config.out.rglob("*") if p.is_file()} == names
    for name in names - {Path("scene.json")}:
        assert (whole / name).read_bytes() == (config.out / name).read_bytes(), name


def test_exposures_given_are_relative_to_the_reference(config):
    m = Manifest.load(prepare(replace(config, exposures="1/1000,1/250,1/62.5")))
    ref = m.reference_bracket
    assert m.exposure_given and m.bracket_ev[ref] == 0
    assert np.allclose(m.bracket_ev, np.array([-2, 0, 2]) - [-2, 0, 2][ref])
    assert m.frames[4].ev == m.bracket_ev[1]


def test_a_csv_beside_the_frames_beats_brightness(config):
    rows = "".join(f"{t:03d}.png,{EVS[t % 3]}\n" for t in range(COUNT))
    (config.clip / "exposures.csv").write_text("file,ev\n" + rows)
    m = Manifest.load(prepare(config))
    assert m.exposure_given and m.steps["exposure"].details["source"] == "exposures.csv"
    assert [f.bracket for f in m.frames] == [0, 1, 2] * 4


def test_a_list_in_the_wrong_order_is_reported(config, capsys):
    m = Manifest.load(prepare(replace(config, ev="2,0,-2")))
    assert "go the way the brightness goes" in m.steps["exposure"].details["doubts"][0]
    assert "go the way the brightness goes" in capsys.readouterr().err


def test_lists_count_from_the_first_frame_of_the_footage(config, tmp_path):
    some = given(tmp_path / "some", 6)
    m = Manifest.load(prepare(replace(config, ev="-2,0,2", start=1, stride=2, **some)))
    assert [f.source for f in m.frames] == [f"{t:03d}.png" for t in (1, 3, 5, 7, 9, 11)]
    first = m.frames[0].ev
    assert [f.ev - first for f in m.frames] == [0, -2, 2, 0, -2, 2]


def test_held_out_frames_do_not_reach_training(config):
    scene = Scene.open(prepare(replace(config, hold_out=4)))
    assert [f.index for f in scene.test] == [2, 6, 10]
    assert [f.time for f in scene.train] == [0, 1, 3, 4, 5, 7, 8, 9, 11]
    assert (
        scene.train[1].neighbors == {-1: 0, 1: 2}
        and (scene.train[1].flow[1] == -4 * np.array([1, 0])).all()
    )  # over the gap
    assert all(f.disparity is None and f.moving is not None for f in scene.test)


def test_flow_across_held_out_frames_is_estimated_where_a_folder_lacks_it(config):
    """The public NSFF layout has flow between neighbors alone."""
    for path in config.flow.iterdir():
        i, j = map(int, path.stem.split("_"))
        if abs(i - j) != 1:
            path.unlink()
    m = Manifest.load(prepare(replace(config, hold_out=4)))
    assert m.steps["flow"].note.endswith("22 given, 6 estimated")
    held_out = next(f.index for f in m.frames if f.split == "test")
    f = m.frames[held_out - 1]
    assert f.flow[held_out].flow.startswith("raw_flow/")
    assert f.flow[held_out + 1].flow.startswith("refined_flow/")


def test_depth_kinds_are_converted(config):
    prepare(replace(config, depth_kind="disparity"))
    assert (Scene.open(config.out).train[0].disparity == 2).all()
    prepare(replace(config, depth_kind="relative"))
    assert Manifest.load(config.out).depth_kind == "relative"


def test_a_rig_has_one_camera_per_folder(tmp_path):
    one = given(tmp_path / "one", 6)
    for name in ("left", "right"):
        footage(tmp_path / "rig" / name, 6)
        for kind in ("masks", "depth"):
            shutil.copytree(one[kind], tmp_path / kind / name)
    write_npy(tmp_path / "poses_bounds.npy", np.load(one["poses"])[[*range(6)] * 2])
    config = PrepareConfig(
        tmp_path / "rig",
        tmp_path / "scene",
        hold_out=0,
        poses=tmp_path / "poses_bounds.npy",
        masks=tmp_path / "masks",
        depth=tmp_path / "depth",
    )
    scene = Scene.open(prepare(config))
    assert [f.camera_id for f in scene.train] == [0] * 6 + [1] * 6
    assert [f.time for f in scene.train] == [*range(6)] * 2
    assert scene.train[5].neighbors == {-1: 4} and scene.train[6].neighbors == {
        1: 7
    }  # never across cameras
    assert abs(float(scene.train[2].flow[1][8:-8, 8:-8, 0].median()) + 2) < 0.5


def test_a_clip_from_a_tripod_is_prepared_without_other_input(tmp_path):
    wall = np.kron(np.random.default_rng(0).random((12, 16, 3)), np.ones((6, 6, 1))) * 0.2 + 0.05
    for t in range(9):
        world = wall.copy()
        world[24:44, 6 * t + 4 : 6 * t + 24] = np.kron(
            np.random.default_rng(1).random((5, 5, 3)), np.ones((4, 4, 1))
        )
        write_png(tmp_path / f"clip/{t}.png", np.clip(world * 2.0 ** (t % 2), 0, 1) ** (1 / 2.2))
    scene = Scene.open(prepare(PrepareConfig(tmp_path / "clip", tmp_path / "scene", hold_out=0)))
    assert scene.manifest.parallax == "none" and scene.manifest.cycle == 2
    assert all((f.camera.c2w == scene.train[0].camera.c2w).all() for f in scene.train)
    assert (scene.near, scene.far) == (0.5, 2.0)
    for f in scene.train:  # movers stand before everything else
        assert (f.disparity[~f.moving] == 1).all()
        assert float((f.disparity[f.moving] - 1 / 0.85).abs().max()) < 1e-3
    middle = scene.train[4].moving
    assert middle[26:42, 30:46].float().mean() > 0.8 and middle.float().mean() < 0.25


def test_steps_depend_only_on_steps_before_them():
    order = list(STEPS)
    for name, kind in STEPS.items():
        assert all(order.index(n) < order.index(name) for n in kind.needs)


def test_a_list_that_is_added_or_changed_is_read(config):
    prepare(config)
    rows = "".join(f"{t:03d}.png,{EVS[t % 3]}\n" for t in range(COUNT))
    written = config.clip / "exposures.csv"
    written.write_text("file,ev\n" + rows)
    assert Manifest.load(prepare(config)).steps["exposure"].details["source"] == written.name
    before = stamps(prepare(config))
    assert stamps(prepare(config)) == before  # and not again
    written.write_text("file,ev\n" + rows.replace("-2.0", "-1.0"))
    m = Manifest.load(prepare(config))
    assert sorted(m.bracket_ev)[1] - sorted(m.bracket_ev)[0] == pytest.approx(1)
