"""The way back: a scene written in a public layout and prepared again is the same
scene, bit by bit; what does not fit is reported.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import miniatures as mini
import numpy as np
import pytest
from estimates import forget_movers
from toy_scene import ToyScene

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import read_image, read_mask, write_png
from hdr_nsff.core.io import read_npy, write_json, write_npy
from hdr_nsff.footage.colmap import read_model
from hdr_nsff.footage.datasets import recognize
from hdr_nsff.footage.layouts import colmap as to_colmap
from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.radiometry.recording import response_curve
from hdr_nsff.rendering.export import ExportConfig, export
from hdr_nsff.rendering.export_gaussians import ColorTransform
from hdr_nsff.scene.manifest import FrameEntry, Manifest
from hdr_nsff.scene.response import read_response, write_response
from hdr_nsff.scene.scene import Scene
from hdr_nsff.scene.truth import Truth, TruthView, true_pictures

LAYOUTS = ("hdr-gopro", "nerfstudio")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A toy scene with what a real one has: poses that are no round numbers, static
    points, trust, unknown exposures.
    """
    folder = ToyScene().write(tmp_path / "scene")
    m = Manifest.load(folder)
    rng = np.random.default_rng(0)
    for f in m.frames:
        f.c2w = mini.pose(0.013 * f.index).tolist()
        f.disparity_confidence = f"disparity_confidence/{f.index:05d}.npy"
        write_npy(
            folder / f.disparity_confidence, rng.random((m.height, m.width)).astype(np.float16)
        )
        for files in f.flow.values():
            write_png(folder / files.valid, rng.random((m.height, m.width)) > 0.3)
            noise = rng.normal(size=(m.height, m.width, 2))
            write_npy(
                folder / files.flow, (read_npy(folder / files.flow) + noise).astype(np.float16)
            )
    m.points, m.bracket_ev, m.exposure_given, m.fps = "points.npy", [2.0, 0.0, None], False, 12.5
    for f in m.frames:
        f.ev = m.bracket_ev[f.bracket]
    write_npy(
        folder / "points.npy",
        rng.uniform(-1, 1, (50, 3)).astype(np.float32) + np.float32([0, 0, 4]),
    )
    m.save(folder)
    return folder


def round_trip(scene: Path, layout: str) -> Path:
    """The scene folder that comes back."""
    out = export(ExportConfig(scene, scene.with_name(layout), layout=layout))  # type: ignore[arg-type]
    return prepare(PrepareConfig(out, scene.with_name(f"again_{layout}"), hold_out=0))


def same_frame(one: Path, f: FrameEntry, other: Path, g: FrameEntry) -> None:
    """Nothing about a frame changed but its name."""
    assert (f.K, f.c2w) == (g.K, g.c2w)
    assert (f.time, f.camera_id, f.bracket, f.ev, f.split) == (
        g.time,
        g.camera_id,
        g.bracket,
        g.ev,
        g.split,
    )
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
        same_frame(scene, f, again, g)
    for name in (
        "near",
        "far",
        "cycle",
        "reference_bracket",
        "bracket_ev",
        "exposure_given",
        "parallax",
        "depth_kind",
        "fps",
    ):
        assert getattr(a, name) == getattr(b, name), name
    assert a.points
    assert b.points
    assert (read_npy(scene / a.points) == read_npy(again / b.points)).all()
    estimated = ("sheet", "response", "movers")
    steps = {n: s.provenance for n, s in b.steps.items() if n not in estimated}
    assert set(steps.values()) == {"given"}


def test_other_readers_find_what_the_gopro_layout_promises(scene: Path) -> None:
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
        assert matrix[:, 4].tolist() == [
            m.height,
            m.width,
            f.K[0][0] if f.K else None,
        ]
        assert 0 < row[15] < row[16]
    with np.load(dense / "flow_i1/00002_bwd.npz") as flow:
        files = m.frames[2].flow[1]
        assert (flow["flow"] == read_npy(scene / files.flow)).all()
        assert flow["flow"].dtype == np.float32
        assert (flow["mask"] == read_mask(scene / files.valid)).all()
    assert not (dense / "flow_i1/00000_bwd.npz").exists()
    assert not (dense / "flow_i1/00005_fwd.npz").exists()
    assert (
        read_mask(dense / "motion_masks/00003.png") == ~read_mask(dense.parent / "masks/00003.png")
    ).all()
    z = np.load(dense / "depth-anything/00003.npy")
    assert np.allclose(z * read_npy(scene / (m.frames[3].disparity or "")), 1, rtol=1e-6)
    assert sorted(p.name for p in (dense / f"images_{m.width}x{m.height}").iterdir()) == [
        f"{i:05d}.png" for i in range(6)
    ]


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
        assert np.allclose(
            np.load(out / entry["depth_file_path"]) / 1000,
            1 / read_npy(scene / (f.disparity or "")),
            rtol=1e-3,
        )


def test_held_out_frames_become_test_pictures_and_come_back_as_truth(scene: Path) -> None:
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


def test_cameras_that_record_at_once_fit_nerfstudio_alone(scene: Path) -> None:
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
    assert [(f.camera_id, f.time) for f in again.frames] == [
        (c, t) for c in (0, 1) for t in (0, 1, 2)
    ]


def test_an_exported_folder_without_one_of_its_notes_is_refused(scene: Path) -> None:
    out = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro"))
    note = out / "dense/hdr_nsff.json"
    content = json.loads(note.read_text())
    note.write_text(
        json.dumps(
            content | {"frames": {k: v for k, v in content["frames"].items() if k != "00003.png"}}
        )
    )
    with pytest.raises(InputError, match="no entry for picture 00003"):
        recognize(out)
    note.write_text(json.dumps({k: v for k, v in content.items() if k != "near"}))
    with pytest.raises(InputError, match="near"):
        recognize(out)


def files_of(folder: Path) -> dict[str, bytes]:
    """All files below `folder` with their contents."""
    files = [p for p in folder.rglob("*") if p.is_file()]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_exporting_again_leaves_the_files_of_others_alone(layout: str, scene: Path) -> None:
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
def test_files_of_an_earlier_export_do_not_stay(layout: str, scene: Path) -> None:
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


def test_a_folder_in_the_place_of_a_file_is_named_and_stays(scene: Path) -> None:
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
def test_an_edited_note_removes_nothing_outside(name: str, scene: Path) -> None:
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


def test_an_export_goes_into_a_folder_of_exports_alone(scene: Path, tmp_path: Path) -> None:
    config = ExportConfig(scene, tmp_path / "out", layout="hdr-gopro")
    write_png(tmp_path / "mine/photo.png", np.zeros((4, 4, 3)))
    with pytest.raises(InputError, match="not made by export"):
        export(replace(config, out=tmp_path / "mine"))
    for place in (scene / "inside", scene, scene.parent):
        with pytest.raises(InputError, match="overlaps the scene folder"):
            export(replace(config, out=place))


def test_settings_that_make_no_sense_with_a_layout_are_one_sentence(
    scene: Path, tmp_path: Path
) -> None:
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


# Held-out views


EXPOSURES = [2.0, 0.0, -1.0]  # of the toy scene's brackets 0 to 2


def write_truth(scene: Path, folder: Path, **changes: Any) -> Truth:
    """Five views with masks: of another frame's pose at a whole and a half time, as
    recorded in 16 bits; off the path; at another time. The world of the truth is the
    scene's, turned, shifted and five times as large.
    """
    m, rng = Manifest.load(scene), np.random.default_rng(5)
    turn, shift = mini.pose(4.0)[:, :3], np.array([1.0, -2.0, 0.5])

    def true(c2w: Any) -> np.ndarray:
        c2w = np.array(c2w)
        return np.concatenate([turn @ c2w[:, :3], (5 * turn @ c2w[:, 3] + shift)[:, None]], 1)

    views = []
    for name, time, anchor, bracket in (
        ("a", 1, 4, 0),
        ("b", 2.5, 5, 1),
        ("c", 3, 0, 2),
        ("off", 2, 2, 1),
        ("odd", 2.25, 0, 0),
    ):
        own = {"c2w": true(mini.pose(0.4)).tolist()} if name == "off" else {}
        views.append(
            TruthView(
                name=name,
                time=time,
                anchor=anchor,
                bracket=bracket,
                mask=f"masks/{name}.png",
                **own,
            )
        )
        write_png(folder / f"masks/{name}.png", rng.random((m.height, m.width)) > 0.5)
        if name == "c":
            views[-1].recorded = {2: "recorded/c.png"}
            write_png(folder / "recorded/c.png", rng.random((m.height, m.width, 3)), bits=16)
        else:
            views[-1].radiance = f"radiance/{name}.exr"
            write_exr(
                folder / f"radiance/{name}.exr",
                {"RGB": rng.random((m.height, m.width, 3), np.float32)},
            )
    curve = response_curve("film")
    truth = Truth(
        bracket_ev=EXPOSURES,
        reference_bracket=1,
        response_x=curve.x.tolist(),
        response_y=curve.y.tolist(),
        white_balance=[1.2, 1, 0.9],
        clip_c2w=[true(f.c2w).tolist() for f in m.frames],
        views=views,
        **changes,
    )
    write_json(folder / "truth.json", truth.model_dump())
    return truth


@pytest.fixture
def kept(scene: Path) -> tuple[Path, Path, Truth]:
    """A scene whose brackets' brightness is in the order of the truth's exposures, and
    its truth.
    """
    m = Manifest.load(scene)
    for f in m.frames:
        write_png(scene / f.image, read_image(scene / f.image) * (1.0, 0.5, 0.25)[f.bracket])
    return scene, scene.with_name("truth"), write_truth(scene, scene.with_name("truth"))


def carried(scene: Path, name: str) -> np.ndarray:
    """Where in the scene's world a view stands (3, 4)."""
    anchors = {"a": 4, "b": 5, "c": 0, "odd": 0}
    return (
        mini.pose(0.4)
        if name == "off"
        else np.array(Manifest.load(scene).frames[anchors[name]].c2w)
    )


@pytest.mark.parametrize(
    ("layout", "names"), [("hdr-gopro", "abc"), ("nerfstudio", ["a", "b", "c", "off", "odd"])]
)
def test_a_truth_comes_back_with_the_same_views(
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
        assert np.allclose(
            c2w, carried(scene, view.name), atol=1e-6 if view.name == "off" else 0, rtol=0
        )
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
    found = sorted(
        p.relative_to(out / "dense").as_posix() for p in (out / "dense").glob("mv_*/*/*")
    )
    assert found == [
        "mv_images/00001/00005.png", "mv_images/00003/00001.png", "mv_images_time/00002/00006.png",
        "mv_masks/00001/00005.png", "mv_masks/00003/00001.png", "mv_masks_time/00002/00006.png",
    ]  # fmt: skip


def test_cameras_of_a_rig_keep_their_numbers(kept: tuple[Path, Path, Truth]) -> None:
    """Frames 0 and 3 are of camera 1, and so on: a view from the pose of frame 4 is of
    camera 2.
    """
    scene, folder, _ = kept
    m = Manifest.load(scene)
    for f in m.frames:
        f.c2w = m.frames[f.index % 3].c2w
    m.save(scene)
    write_truth(scene, folder)
    out = export(ExportConfig(scene, scene.with_name("out"), layout="hdr-gopro", truth=folder))
    assert (out / "dense/mv_images/00001/00002.png").is_file()
    assert (out / "dense/mv_images_time/00002/00003.png").is_file()


def test_a_truth_that_does_not_fit_is_one_sentence(
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
    write_json(
        folder / "truth.json",
        truth.model_copy(update={"clip_c2w": truth.clip_c2w[:5]}).model_dump(),
    )
    with pytest.raises(InputError, match="a clip of 5 frames, the scene has 6"):
        export(config)
    write_json(folder / "truth.json", truth.model_dump())
    write_exr(folder / "radiance/b.exr", {"RGB": np.ones((8, 9, 3), np.float32)})
    with pytest.raises(InputError, match="view b has 9x8 pixels"):
        export(config)


def test_what_export_noted_of_held_out_views_is_checked(kept: tuple[Path, Path, Truth]) -> None:
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
