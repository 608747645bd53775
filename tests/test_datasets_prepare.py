"""`prepare` on the HDR-GoPro tree: its priors are used, held-out views become truth."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import miniatures as mini
import numpy as np
import pytest
from miniatures import EV, H, W

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.footage.datasets import maps
from hdr_nsff.footage.datasets.capture import SparseDepth
from hdr_nsff.prepare.engine import step_key
from hdr_nsff.prepare.prepare import STEPS, PrepareConfig, begin, held_out_truth, prepare
from hdr_nsff.scene.manifest import Manifest, StepRecord
from hdr_nsff.scene.scene import Scene
from hdr_nsff.scene.truth import Truth, true_pictures


def provenance(folder: Path) -> dict[str, str]:
    """Where each step's result comes from."""
    return {name: step.provenance for name, step in Manifest.load(folder).steps.items()}


@pytest.fixture
def gopro(tmp_path: Path) -> PrepareConfig:
    """The HDR-GoPro tree, everything given."""
    return PrepareConfig(mini.gopro(tmp_path / "set"), tmp_path / "scene")


def test_a_complete_gopro_tree_needs_few_estimates(
    gopro: PrepareConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Scene.open(prepare(gopro))
    printed = " ".join(capsys.readouterr().err.split())
    expected = "HDR-GoPro / NSFF (LLFF), 9 pictures, with its own poses, flow, masks, depth"
    assert expected in printed
    found = provenance(gopro.out)
    estimated = {step for step, how in found.items() if how == "estimated"}
    assert estimated == {"exposure", "response", "movers", "sheet"}
    assert set(found.values()) == {"estimated", "given"}
    assert [f.bracket for f in scene.train] == [0, 1, 2] * 3
    assert not scene.test
    assert [f.time for f in scene.train] == list(range(9))
    assert {f.camera_id for f in scene.train} == {0}
    f = scene.train[4]
    assert np.allclose(f.camera.K, mini.K)
    assert np.allclose(f.camera.c2w, mini.gopro_pose(1), atol=1e-6)
    assert (f.image.numpy() == np.float32(mini.see(mini.gopro_pose(1), EV[1]))).all()
    assert (f.flow[1].numpy() == [1, 0.5]).all()
    assert (f.flow[-1].numpy() == [-1, 0.5]).all()
    assert f.flow_valid[1].sum() == 30 * H
    assert f.moving is not None
    assert f.moving.sum() == 3 * H


def test_masks_next_to_dense_mark_moving_pixels_in_black(gopro: PrepareConfig) -> None:
    shutil.rmtree(gopro.clip / "dense/motion_masks")
    moving = Scene.open(prepare(gopro)).train[0].moving
    assert moving is not None
    assert moving.sum() == 5 * H
    assert moving[:, 0].all()


def test_semantic_flow_is_preferred(gopro: PrepareConfig) -> None:
    shutil.copytree(gopro.clip / "dense/flow_i1", gopro.clip / "dense/semantic_flow_i1")
    np.savez(
        gopro.clip / "dense/semantic_flow_i1/00000_fwd.npz",
        flow=np.full((H, W, 2), 7.0),
        mask=np.ones((H, W)),
    )
    assert (Scene.open(prepare(gopro)).train[0].flow[1] == 7).all()


def test_metric_depth_is_scaled_to_the_units_of_the_poses(gopro: PrepareConfig) -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.6, 0.6, (40, 2)), np.full((40, 1), mini.WALL)], 1)
    mini.colmap(gopro.clip / "dense", points)
    scene = Scene.open(prepare(gopro))
    # The map holds 2 everywhere; the points lie about 4 away.
    depth = [((points - c2w[:, 3]) @ c2w[:, 2]) for c2w in map(mini.gopro_pose, range(3))]
    aligned = float(1 / scene.train[0].disparity[0, 0])
    assert aligned == pytest.approx(float(np.median(depth)), rel=2e-3)
    assert "360 static points" in Manifest.load(gopro.out).steps["depth"].note
    assert np.allclose(scene.points, points, atol=1e-6)


def test_without_points_the_bounds_of_the_pictures_give_the_scale(gopro: PrepareConfig) -> None:
    scene = Scene.open(prepare(gopro))
    # near 3, far 5
    assert float(1 / scene.train[0].disparity[0, 0]) == pytest.approx(np.sqrt(3 * 5), rel=2e-3)
    assert "bounds of the pictures alone" in Manifest.load(gopro.out).steps["depth"].note


def test_disparity_up_to_scale_and_shift_is_fitted_to_the_points() -> None:
    depth = np.linspace(2, 8, H * W).reshape(H, W)
    rng = np.random.default_rng(0)
    y, x = rng.integers(0, H, 60), rng.integers(0, W, 60)
    xy = np.stack([(x + 0.5) / W, (y + 0.5) / H], 1)
    seen = SparseDepth(xy, depth[y, x], (0.0, 0.0))
    fitted, note = maps.align_disparity(
        ((1 / depth - 0.05) / 0.02)[None].astype(np.float32), [seen]
    )
    assert np.allclose(fitted[0], 1 / depth, rtol=1e-3)
    assert "1 of 1 maps by static points" in note


def test_maps_that_shrink_are_read_at_the_centers_of_pixels(tmp_path: Path) -> None:
    columns = np.tile(np.arange(9.0), (9, 1))
    write_png(tmp_path / "mask.png", columns == 4)
    np.save(tmp_path / "depth.npy", columns + 1)
    moving = maps.moving_mask(tmp_path / "mask.png", (3, 3), True)
    assert moving.tolist() == [[False, True, False]] * 3
    assert maps.depth_map(tmp_path / "depth.npy", (3, 3), True)[0].tolist() == [2, 5, 8]


def test_flow_that_is_not_valid_does_not_mix_into_resampled_flow(tmp_path: Path) -> None:
    valid = np.zeros((9, 12), bool)
    valid[:, :7] = True  # not a multiple of the two pixels that become one
    flow = np.where(valid[..., None], np.float32([6, 3]), np.float32(0))
    np.savez(tmp_path / "flow.npz", flow=flow, mask=valid)
    resampled, known = maps.flow_map(tmp_path / "flow.npz", (6, 8))
    assert known[:, :4].all() and not known[:, 5:].any()
    assert np.allclose(resampled[known], [4, 2])


def test_maps_of_another_size_are_resampled_and_flow_is_scaled(tmp_path: Path) -> None:
    root = mini.gopro(tmp_path / "set", scale=2)  # pictures twice as large as the maps
    m = Manifest.load(prepare(PrepareConfig(root, tmp_path / "scene")))
    scene = Scene.open(tmp_path / "scene")
    assert (m.width, m.height) == (2 * W, 2 * H)
    assert np.allclose(scene.train[0].camera.K[:2], 2 * mini.K[:2])
    assert (scene.train[0].flow[1].numpy() == [2, 1]).all()
    assert scene.train[0].flow_valid[1].sum() == 60 * 2 * H
    write_png(root / "dense/motion_masks/00003.png", np.zeros((H, H), bool))
    with pytest.raises(InputError, match=r"00003\.png: 32x32 for frames of 96x64"):
        prepare(PrepareConfig(root, tmp_path / "other"))


def test_other_cameras_at_the_training_times_become_the_truth(gopro: PrepareConfig) -> None:
    prepare(gopro)
    folder = held_out_truth(gopro)
    assert folder == gopro.out.with_name("scene_truth")
    truth = Truth.open(folder)
    # the others at each time, and all of them half a frame later
    assert len(truth.views) == 9 * 2 + 8 * 3
    assert truth.bracket_ev == Manifest.load(gopro.out).bracket_ev == [None] * 3
    assert truth.bracket_frame == [0, 1, 2]
    view = next(v for v in truth.views if v.name == "t00004.0_camera3")
    # the pose and exposure of training frame 2
    assert (view.time, view.anchor, view.c2w, view.bracket) == (4.0, 2, None, 2)
    exact, pictures = true_pictures(truth, view, folder)
    assert exact is None
    assert (pictures[2] == np.float32(mini.see(mini.gopro_pose(2), EV[2]))).all()
    assert view.mask is not None
    assert read_mask(folder / view.mask).sum() == 6 * H
    assert next(v for v in truth.views if v.name == "t00004.5_camera2").time == 4.5


def test_a_stride_of_two_holds_out_the_other_frames(gopro: PrepareConfig) -> None:
    prepare(replace(gopro, stride=2))
    scene, truth = Scene.open(gopro.out), Truth.open(gopro.out.with_name("scene_truth"))
    assert [f.time for f in scene.train] == [0, 1, 2, 3, 4]
    assert {v.time for v in truth.views} == {t / 4 for t in range(0, 17)}
    assert provenance(gopro.out)["flow"] == "estimated"  # the set has flow between neighbors alone


def test_a_protocol_splits_a_data_set_and_keeps_its_times(gopro: PrepareConfig) -> None:
    prepare(replace(gopro, protocol="novel-view-time"))
    scene, truth = Scene.open(gopro.out), Truth.open(gopro.out.with_name("scene_truth"))
    assert [f.time for f in scene.train] == [0, 2, 4, 6, 8]
    assert [f.time for f in scene.test] == [1, 3, 5, 7]
    assert scene.manifest.protocol == "novel-view-time"
    # all: `evaluate` sorts them by protocol
    assert {v.time for v in truth.views} == {t / 2 for t in range(0, 17)}
    flow = Manifest.load(gopro.out).steps["flow"].note
    assert "24 pairs" in flow
    assert "16 given, 8 estimated" in flow  # the set has flow between neighbors alone
    prepare(replace(gopro, protocol="novel-view"))
    assert len(Scene.open(gopro.out).train) == 9


def test_a_truth_of_other_settings_does_not_stay(gopro: PrepareConfig) -> None:
    """With the first three times alone, later views are removed."""
    prepare(gopro)
    prepare(replace(gopro, end=3, redo=("frames",)))
    folder = held_out_truth(gopro)
    assert folder is not None
    assert {v.time for v in Truth.open(folder).views} == {0.0, 0.5, 1.0, 1.5, 2.0}


def test_parts_can_be_estimated_although_they_are_given(gopro: PrepareConfig) -> None:
    prepare(replace(gopro, estimate=("flow",)))
    assert provenance(gopro.out)["flow"] == "estimated"
    assert provenance(gopro.out)["masks"] == "given"
    assert not (Scene.open(gopro.out).train[4].flow[1].numpy() == [1, 0.5]).all()


def test_a_second_run_does_nothing_and_a_changed_map_redoes_its_step(gopro: PrepareConfig) -> None:
    prepare(gopro)
    truth = gopro.out.with_name("scene_truth")
    before = {p: p.stat().st_mtime_ns for folder in (gopro.out, truth) for p in folder.rglob("*.*")}
    prepare(gopro)
    assert {p: p.stat().st_mtime_ns for p in before} == before
    lost = truth / "recorded/t00004.0_camera3_2.png"
    lost.unlink()
    prepare(gopro)
    assert lost.is_file()
    write_png(gopro.clip / "dense/motion_masks/00003.png", mini.left(9))
    prepare(gopro)
    steps = Manifest.load(gopro.out).steps
    attempts = {name: step.details["attempt"] for name, step in steps.items()}
    repeated = {name for name, attempt in attempts.items() if attempt == 2}
    assert {"frames", "exposure", "flow", "poses"} == attempts.keys() - repeated
    assert max(attempts.values()) == 2


def test_poses_are_estimated_again_where_their_masks_change(gopro: PrepareConfig) -> None:
    def key(config: PrepareConfig) -> str:
        work = begin(config)
        work.manifest.steps["flow"] = StepRecord(done=True)
        return step_key(work, "poses", STEPS["poses"])

    estimate, with_masks = replace(gopro, estimate=("poses",)), ("poses", "masks")
    assert key(estimate) != key(replace(gopro, estimate=with_masks))
    given, before = key(gopro), key(estimate)
    write_png(gopro.clip / "dense/motion_masks/00003.png", mini.left(9))
    assert key(gopro) == given and key(estimate) != before


# What training must not see


def test_held_out_pixels_change_nothing_in_the_scene(tmp_path: Path) -> None:
    one, other = mini.gopro(tmp_path / "one/set"), mini.gopro(tmp_path / "other/set")
    for name in ("mv_images", "mv_images_time", "mv_masks"):
        for path in (other / "dense" / name).rglob("*.png"):
            write_png(path, np.random.default_rng(0).random((H, W, 3)))
    scenes = [prepare(PrepareConfig(root, root.with_name("scene"))) for root in (one, other)]
    files = [
        {p.relative_to(s).as_posix(): p.read_bytes() for p in s.rglob("*") if p.is_file()}
        for s in scenes
    ]
    noted = [json.loads(f.pop("scene.json")) for f in files]
    assert files[0] == files[1]
    for note in noted:
        note.pop("source")
        for step in note["steps"].values():
            for cost in ("seconds", "cpu_seconds", "peak_memory_mb"):
                step.pop(cost)
    assert noted[0] == noted[1]
    assert (scenes[0].with_name("scene_truth") / "truth.json").is_file()


def test_the_scene_does_not_name_the_truth(gopro: PrepareConfig) -> None:
    prepare(gopro)
    text = (gopro.out / "scene.json").read_text()
    assert "truth" not in text
    assert "mv_" not in text


def test_the_truth_may_not_lie_where_training_reads(gopro: PrepareConfig) -> None:
    with pytest.raises(InputError, match="inside the scene folder"):
        prepare(replace(gopro, truth_out=gopro.out / "truth"))


def test_a_folder_of_other_files_is_not_overwritten_with_truth(
    gopro: PrepareConfig, tmp_path: Path
) -> None:
    write_png(tmp_path / "mine/photo.png", np.zeros((4, 4, 3)))
    with pytest.raises(InputError, match="not made by prepare"):
        prepare(replace(gopro, truth_out=tmp_path / "mine"))
    assert (tmp_path / "mine/photo.png").is_file()


def test_an_empty_map_is_refused() -> None:
    with pytest.raises(InputError, match="0x0 for frames of 60x34"):
        maps.fit_size(Path("a.npy"), np.zeros((0, 0)), (34, 60), cv2.INTER_NEAREST)
