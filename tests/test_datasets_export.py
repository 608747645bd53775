"""The way back: a scene written in a public layout and prepared again is the same scene, bit by bit; what does not fit is said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import miniatures as mini
import numpy as np
import pytest
from toy_scene import ToyScene

from hdr_nsff.datasets import recognise, to_colmap
from hdr_nsff.errors import InputError
from hdr_nsff.export import ExportConfig, Look, export
from hdr_nsff.io import read_mask, read_npy, write_npy, write_png
from hdr_nsff.prepare import PrepareConfig, prepare
from hdr_nsff.priors.colmap import read_model
from hdr_nsff.scene import FrameEntry, Manifest, Scene
from hdr_nsff.truth import Truth, true_pictures

LAYOUTS = ("hdr-gopro", "nerfstudio")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A toy scene with what a real one has: poses that are no round numbers, static points, trust, unknown exposures."""
    folder = ToyScene().write(tmp_path / "scene")
    m = Manifest.load(folder)
    rng = np.random.default_rng(0)
    for f in m.frames:
        f.c2w = mini.pose(0.013 * f.index).tolist()
        f.disparity_confidence = f"disparity_confidence/{f.index:05d}.npy"
        write_npy(folder / f.disparity_confidence, rng.random((m.height, m.width)).astype(np.float16))
        for files in f.flow.values():
            write_png(folder / files.valid, rng.random((m.height, m.width)) > 0.3)
            noise = rng.normal(size=(m.height, m.width, 2))
            write_npy(folder / files.flow, (read_npy(folder / files.flow) + noise).astype(np.float16))
    m.points, m.bracket_ev, m.exposure_given, m.fps = "points.npy", [2.0, 0.0, None], False, 12.5
    for f in m.frames:
        f.ev = m.bracket_ev[f.bracket]
    write_npy(folder / "points.npy", rng.uniform(-1, 1, (50, 3)).astype(np.float32) + np.float32([0, 0, 4]))
    m.save(folder)
    return folder


def round_trip(scene: Path, layout: str) -> Path:
    """The scene folder that comes back."""
    out = export(ExportConfig(scene, scene.with_name(layout), layout=layout))  # type: ignore[arg-type]
    return prepare(PrepareConfig(out, scene.with_name(f"again_{layout}"), hold_out=0))


def same_frame(one: Path, f: FrameEntry, other: Path, g: FrameEntry) -> None:
    """Nothing about a frame changed but its name."""
    assert (f.K, f.c2w) == (g.K, g.c2w)
    assert (f.time, f.camera_id, f.bracket, f.ev, f.split) == (g.time, g.camera_id, g.bracket, g.ev, g.split)
    assert (one / f.image).read_bytes() == (other / g.image).read_bytes()
    assert f.mask and g.mask and (read_mask(one / f.mask) == read_mask(other / g.mask)).all()
    for name in ("disparity", "disparity_confidence"):
        a, b = getattr(f, name), getattr(g, name)
        assert (read_npy(one / a) == read_npy(other / b)).all(), name
    assert f.flow.keys() == g.flow.keys()
    for to, files in f.flow.items():
        assert (read_npy(one / files.flow) == read_npy(other / g.flow[to].flow)).all()
        assert (read_mask(one / files.valid) == read_mask(other / g.flow[to].valid)).all()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_round_trip_is_exact(layout: str, scene: Path) -> None:
    again = round_trip(scene, layout)
    a, b = Manifest.load(scene), Manifest.load(again)
    for f, g in zip(a.frames, b.frames, strict=True):
        same_frame(scene, f, again, g)
    for name in ("near", "far", "cycle", "reference_bracket", "bracket_ev", "exposure_given", "parallax", "depth_kind", "fps"):
        assert getattr(a, name) == getattr(b, name), name
    assert a.points and b.points and (read_npy(scene / a.points) == read_npy(again / b.points)).all()
    steps = {n: s.provenance for n, s in b.steps.items() if n != "sheet"}
    assert set(steps.values()) == {"given"}


def test_other_readers_find_what_the_gopro_layout_promises(scene: Path) -> None:
    dense = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro")) / "dense"
    m = Manifest.load(scene)
    table = np.load(dense / "poses_bounds.npy")
    assert table.shape == (6, 17)
    for f, row in zip(m.frames, table, strict=True):
        matrix, c2w = row[:15].reshape(3, 5), np.array(f.c2w)
        assert (matrix[:, 0] == c2w[:, 1]).all() and (matrix[:, 1] == c2w[:, 0]).all() and (matrix[:, 2] == -c2w[:, 2]).all()
        assert (matrix[:, 3] == c2w[:, 3]).all() and matrix[:, 4].tolist() == [m.height, m.width, f.K[0][0] if f.K else None]
        assert 0 < row[15] < row[16]
    with np.load(dense / "flow_i1/00002_bwd.npz") as flow:
        files = m.frames[2].flow[1]
        assert (flow["flow"] == read_npy(scene / files.flow)).all() and flow["flow"].dtype == np.float32
        assert (flow["mask"] == read_mask(scene / files.valid)).all()
    assert not (dense / "flow_i1/00000_bwd.npz").exists() and not (dense / "flow_i1/00005_fwd.npz").exists()
    assert (read_mask(dense / "motion_masks/00003.png") == ~read_mask(dense.parent / "masks/00003.png")).all()
    z = np.load(dense / "depth-anything/00003.npy")
    assert np.allclose(z * read_npy(scene / (m.frames[3].disparity or "")), 1, rtol=1e-6)
    assert sorted(p.name for p in (dense / f"images_{m.width}x{m.height}").iterdir()) == [f"{i:05d}.png" for i in range(6)]


def test_the_colmap_model_projects_points_onto_their_keypoints(scene: Path) -> None:
    dense = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro")) / "dense"
    model, m = read_model(dense / "sparse"), Manifest.load(scene)
    assert model.points.shape == (50, 3) and [i.name for i in model.images.values()] == [f"{k:05d}.png" for k in range(6)]
    seen = 0
    for image, f in zip(model.images.values(), m.frames, strict=True):
        assert np.allclose(image.c2w, f.c2w, atol=1e-12)
        K = model.cameras[image.camera_id].K
        local = (model.points[image.point_ids - 1] - image.c2w[:, 3]) @ image.c2w[:, :3]
        xy = local[:, :2] / local[:, 2:] * K[0, 0] + K[:2, 2]
        assert np.allclose(xy, image.xy)
        seen += len(xy)
    assert seen == model.track_lengths.sum() > 20


def test_hidden_points_are_not_seen() -> None:
    points = np.array([[0, 0, 4.0], [0, 0, 6.0], [0, 0, -4.0], [9, 0, 4.0]])
    view = to_colmap.seen(points, mini.K, np.eye(4)[:3], np.full((mini.H, mini.W), 0.25))
    assert view.index.tolist() == [0] and view.depth.tolist() == [4] and view.xy.tolist() == [[mini.W / 2, mini.H / 2]]


def test_nerfstudio_gets_opengl_poses_and_millimetres(scene: Path) -> None:
    out = export(ExportConfig(scene, scene.with_name("out"), layout="nerfstudio"))
    document, m = json.loads((out / "transforms.json").read_text()), Manifest.load(scene)
    assert [f["time"] for f in document["frames"]] == [k / 5 for k in range(6)]
    for f, entry in zip(m.frames, document["frames"], strict=True):
        matrix, c2w = np.array(entry["transform_matrix"]), np.array(f.c2w)
        assert (matrix[:3] == c2w * [1, -1, -1, 1]).all() and matrix[3].tolist() == [0, 0, 0, 1]
        assert np.allclose(np.load(out / entry["depth_file_path"]) / 1000, 1 / read_npy(scene / (f.disparity or "")), rtol=1e-3)


def test_held_out_frames_become_test_pictures_and_come_back_as_truth(scene: Path) -> None:
    m = Manifest.load(scene)
    m.frames[3].split, m.frames[3].disparity, m.frames[3].disparity_confidence = "test", None, None
    keep = [0, 1, 2, 4, 5]
    m.frames[2].flow[4], m.frames[4].flow[2] = m.frames[2].flow[3], m.frames[4].flow[3]
    m.save(scene)
    again = round_trip(scene, "nerfstudio")
    b = Manifest.load(again)
    assert [f.time for f in b.frames] == keep and all(f.split == "train" for f in b.frames)
    for k, g in zip(keep, b.frames, strict=True):
        f = m.frames[k]
        assert (f.K, f.c2w, f.bracket) == (g.K, g.c2w, g.bracket)
        assert (scene / f.image).read_bytes() == (again / g.image).read_bytes()
    truth = Truth.open(again.with_name("again_nerfstudio_truth"))
    (view,) = truth.views
    assert view.time == 3 and view.bracket == m.frames[3].bracket and np.allclose(view.c2w, m.frames[3].c2w)
    exact, pictures = true_pictures(truth, view, again.with_name("again_nerfstudio_truth"))
    assert exact is None and (pictures[view.bracket] == Scene.open(scene).test[0].image.numpy()).all()


def test_the_gopro_layout_has_no_place_for_held_out_frames_of_the_clip(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    m = Manifest.load(scene)
    m.frames[3].split, m.frames[3].disparity, m.frames[3].disparity_confidence = "test", None, None
    m.frames[2].flow[4], m.frames[4].flow[2] = m.frames[2].flow[3], m.frames[4].flow[3]
    m.save(scene)
    again = Manifest.load(round_trip(scene, "hdr-gopro"))
    assert [f.time for f in again.frames] == [0, 1, 2, 4, 5]
    assert "no place for the 1 frames" in " ".join(capsys.readouterr().err.split())


def test_cameras_that_record_at_once_fit_nerfstudio_alone(scene: Path) -> None:
    m = Manifest.load(scene)
    for f in m.frames:
        f.camera_id, f.time = divmod(f.index, 3)
        f.flow = {to: files for to, files in f.flow.items() if to // 3 == f.camera_id}
    m.save(scene)
    with pytest.raises(InputError, match="one picture per time"):
        export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro"))
    again = Manifest.load(round_trip(scene, "nerfstudio"))
    assert [(f.camera_id, f.time) for f in again.frames] == [(c, t) for c in (0, 1) for t in (0, 1, 2)]


def test_an_exported_folder_without_one_of_its_notes_is_refused(scene: Path) -> None:
    out = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro"))
    note = out / "dense/hdr_nsff.json"
    told = json.loads(note.read_text())
    note.write_text(json.dumps(told | {"frames": {k: v for k, v in told["frames"].items() if k != "00003.png"}}))
    with pytest.raises(InputError, match="no entry for picture 00003"):
        recognise(out)
    note.write_text(json.dumps({k: v for k, v in told.items() if k != "near"}))
    with pytest.raises(InputError, match="near"):
        recognise(out)


def test_exporting_again_replaces_what_was_there_but_nothing_else(scene: Path, tmp_path: Path) -> None:
    config = ExportConfig(scene, tmp_path / "out", layout="hdr-gopro")
    export(config)
    write_png(tmp_path / "out/dense/images/00099.png", np.zeros((4, 4, 3)))
    export(config)
    assert not (tmp_path / "out/dense/images/00099.png").exists()
    write_png(tmp_path / "mine/photo.png", np.zeros((4, 4, 3)))
    with pytest.raises(InputError, match="not made by export"):
        export(replace(config, out=tmp_path / "mine"))
    for place in (scene / "inside", scene, scene.parent):
        with pytest.raises(InputError, match="overlaps the scene folder"):
            export(replace(config, out=place))


def test_settings_that_make_no_sense_with_a_layout_are_one_sentence(scene: Path, tmp_path: Path) -> None:
    config = ExportConfig(scene, tmp_path / "out", layout="nerfstudio")
    for wrong in (replace(config, ply=True), replace(config, layout=None)):
        with pytest.raises(InputError, match="say what to write"):
            export(wrong)
    for wrong in (replace(config, time=1.0), replace(config, look=Look(ev=1.0)), replace(config, look=Look(linear=True))):
        with pytest.raises(InputError, match="are for Gaussians"):
            export(wrong)
    with pytest.raises(InputError, match="neither a scene folder nor a run folder"):
        export(replace(config, run=tmp_path))
