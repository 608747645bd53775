"""A scene that is exported in a public layout and prepared again is bit-identical."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import miniatures as mini
import numpy as np
import pytest
from estimates import forget_movers
from layout_scenes import LAYOUTS, exported_scene, round_trip

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import read_npy
from hdr_nsff.footage.colmap import read_model
from hdr_nsff.footage.datasets import recognize
from hdr_nsff.footage.layouts import colmap as to_colmap
from hdr_nsff.rendering.export import ExportConfig, export
from hdr_nsff.rendering.export_gaussians import ColorTransform
from hdr_nsff.scene.manifest import FrameEntry, Manifest
from hdr_nsff.scene.response import read_response, write_response
from hdr_nsff.scene.scene import Scene
from hdr_nsff.scene.truth import Truth, true_pictures

# Values of a manifest that a round trip keeps.
KEPT = (
    *("near", "far", "parallax", "depth_kind", "fps"),
    *("cycle", "reference_bracket", "bracket_ev", "exposure_given"),
)


@pytest.fixture
def scene(toy_folder: Path, tmp_path: Path) -> Path:
    return exported_scene(toy_folder, tmp_path / "scene")


def assert_same_frame(one: Path, f: FrameEntry, other: Path, g: FrameEntry) -> None:
    """Check that two frames differ in nothing but the names of their files."""
    assert (f.K, f.c2w) == (g.K, g.c2w)
    for name in ("time", "camera_id", "bracket", "ev", "split"):
        assert getattr(f, name) == getattr(g, name), name
    assert (one / f.image).read_bytes() == (other / g.image).read_bytes()
    assert f.mask
    assert g.mask
    assert (read_mask(one / f.mask) == read_mask(other / g.mask)).all()
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
        assert_same_frame(scene, f, again, g)
    for name in KEPT:
        assert getattr(a, name) == getattr(b, name), name
    assert a.points
    assert b.points
    assert (read_npy(scene / a.points) == read_npy(again / b.points)).all()
    estimated = ("sheet", "response", "movers")
    steps = {n: s.provenance for n, s in b.steps.items() if n not in estimated}
    assert set(steps.values()) == {"given"}


def test_the_gopro_layout_holds_the_files_that_other_readers_expect(scene: Path) -> None:
    dense = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro")) / "dense"
    m = Manifest.load(scene)
    table = np.load(dense / "poses_bounds.npy")
    assert table.shape == (6, 17)
    for f, row in zip(m.frames, table, strict=True):
        matrix, c2w = row[:15].reshape(3, 5), np.array(f.c2w)
        assert (matrix[:, 0] == c2w[:, 1]).all()
        assert (matrix[:, 1] == c2w[:, 0]).all()
        assert (matrix[:, 2] == -c2w[:, 2]).all()
        assert (matrix[:, 3] == c2w[:, 3]).all()
        assert f.K
        assert matrix[:, 4].tolist() == [m.height, m.width, f.K[0][0]]
        assert 0 < row[15] < row[16]
    with np.load(dense / "flow_i1/00002_bwd.npz") as flow:
        files = m.frames[2].flow[1]
        assert (flow["flow"] == read_npy(scene / files.flow)).all()
        assert flow["flow"].dtype == np.float32
        assert (flow["mask"] == read_mask(scene / files.valid)).all()
    assert not (dense / "flow_i1/00000_bwd.npz").exists()
    assert not (dense / "flow_i1/00005_fwd.npz").exists()
    static = ~read_mask(dense.parent / "masks/00003.png")
    assert (read_mask(dense / "motion_masks/00003.png") == static).all()
    z = np.load(dense / "depth-anything/00003.npy")
    assert np.allclose(z * read_npy(scene / (m.frames[3].disparity or "")), 1, rtol=1e-6)
    pictures = (dense / f"images_{m.width}x{m.height}").iterdir()
    assert sorted(p.name for p in pictures) == [f"{i:05d}.png" for i in range(6)]


def test_the_colmap_model_projects_points_onto_their_keypoints(scene: Path) -> None:
    dense = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro")) / "dense"
    model, m = read_model(dense / "sparse"), Manifest.load(scene)
    assert model.points.shape == (50, 3)
    assert [i.name for i in model.images.values()] == [f"{k:05d}.png" for k in range(6)]
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
    view = to_colmap.visible_points(points, mini.K, np.eye(4)[:3], np.full((mini.H, mini.W), 0.25))
    assert view.index.tolist() == [0]
    assert view.depth.tolist() == [4]
    assert view.xy.tolist() == [[mini.W / 2, mini.H / 2]]


def test_nerfstudio_gets_opengl_poses_and_millimeters(scene: Path) -> None:
    out = export(ExportConfig(scene, scene.with_name("out"), layout="nerfstudio"))
    document, m = json.loads((out / "transforms.json").read_text()), Manifest.load(scene)
    assert [f["time"] for f in document["frames"]] == [k / 5 for k in range(6)]
    for f, entry in zip(m.frames, document["frames"], strict=True):
        matrix, c2w = np.array(entry["transform_matrix"]), np.array(f.c2w)
        assert (matrix[:3] == c2w * [1, -1, -1, 1]).all()
        assert matrix[3].tolist() == [0, 0, 0, 1]
        depth = np.load(out / entry["depth_file_path"]) / 1000
        disparity = read_npy(scene / (f.disparity or ""))
        assert np.allclose(depth, 1 / disparity, rtol=1e-3)


def test_held_out_frames_become_test_pictures_and_then_truth(scene: Path) -> None:
    m = Manifest.load(scene)
    m.frames[3].split, m.frames[3].disparity, m.frames[3].disparity_confidence = "test", None, None
    keep = [0, 1, 2, 4, 5]
    m.frames[2].flow[4], m.frames[4].flow[2] = m.frames[2].flow[3], m.frames[4].flow[3]
    m.save(scene)
    forget_movers(scene)
    again = round_trip(scene, "nerfstudio")
    b = Manifest.load(again)
    assert [f.time for f in b.frames] == keep
    assert all(f.split == "train" for f in b.frames)
    for k, g in zip(keep, b.frames, strict=True):
        f = m.frames[k]
        assert (f.K, f.c2w, f.bracket) == (g.K, g.c2w, g.bracket)
        assert (scene / f.image).read_bytes() == (again / g.image).read_bytes()
    truth = Truth.open(again.with_name("again_nerfstudio_truth"))
    (view,) = truth.views
    assert view.time == 3
    assert view.bracket == m.frames[3].bracket
    assert np.allclose(view.c2w, m.frames[3].c2w)
    exact, pictures = true_pictures(truth, view, again.with_name("again_nerfstudio_truth"))
    assert exact is None
    assert (pictures[view.bracket] == Scene.open(scene).test[0].image.numpy()).all()


def test_the_gopro_layout_has_no_place_for_held_out_frames_of_the_clip(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    m = Manifest.load(scene)
    m.frames[3].split, m.frames[3].disparity, m.frames[3].disparity_confidence = "test", None, None
    m.frames[2].flow[4], m.frames[4].flow[2] = m.frames[2].flow[3], m.frames[4].flow[3]
    m.save(scene)
    forget_movers(scene)
    again = Manifest.load(round_trip(scene, "hdr-gopro"))
    assert [f.time for f in again.frames] == [0, 1, 2, 4, 5]
    assert "no place for the 1 frames" in " ".join(capsys.readouterr().err.split())


def test_several_cameras_at_one_time_fit_nerfstudio_alone(scene: Path) -> None:
    m = Manifest.load(scene)
    for f in m.frames:
        f.camera_id, f.time = divmod(f.index, 3)
        f.flow = {to: files for to, files in f.flow.items() if to // 3 == f.camera_id}
    m.save(scene)
    forget_movers(scene)
    response = read_response(scene / "response.json", num_cameras=1, num_brackets=3)
    both = replace(response, y=np.repeat(response.y, 2, 0), white_balance=np.zeros((2, 3)))
    write_response(scene / "response.json", both)
    with pytest.raises(InputError, match="one picture per time"):
        export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro"))
    again = Manifest.load(round_trip(scene, "nerfstudio"))
    expected = [(camera, time) for camera in (0, 1) for time in (0, 1, 2)]
    assert [(f.camera_id, f.time) for f in again.frames] == expected


def test_an_exported_folder_without_one_of_its_notes_is_refused(scene: Path) -> None:
    out = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro"))
    note = out / "dense/hdr_nsff.json"
    content = json.loads(note.read_text())
    frames = {k: v for k, v in content["frames"].items() if k != "00003.png"}
    note.write_text(json.dumps(content | {"frames": frames}))
    with pytest.raises(InputError, match="no entry for picture 00003"):
        recognize(out)
    note.write_text(json.dumps({k: v for k, v in content.items() if k != "near"}))
    with pytest.raises(InputError, match="near"):
        recognize(out)


def test_settings_that_do_not_fit_a_layout_are_refused(scene: Path, tmp_path: Path) -> None:
    config = ExportConfig(scene, tmp_path / "out", layout="nerfstudio")
    for wrong in (replace(config, ply=True), replace(config, layout=None)):
        with pytest.raises(InputError, match="choose what to write"):
            export(wrong)
    for wrong in (
        replace(config, time=1.0),
        replace(config, colors=ColorTransform(ev=1.0)),
        replace(config, colors=ColorTransform(linear=True)),
    ):
        with pytest.raises(InputError, match="are for Gaussians"):
            export(wrong)
    with pytest.raises(InputError, match="neither a scene folder nor a run folder"):
        export(replace(config, run=tmp_path))
