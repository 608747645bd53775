"""Public layouts: each is recognized for what it is, footage for none of them, and in
every convention a known point is where its picture shows it, in training pictures and
held-out ones.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import miniatures as mini
import numpy as np
import pytest
from mutations import check_json_reader, check_reader

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.video import write_video
from hdr_nsff.footage.datasets import held_out_views, layout_of, maps, recognize
from hdr_nsff.footage.datasets.capture import Capture, Clock, number_cameras
from hdr_nsff.footage.pose_files import fit_poses
from hdr_nsff.footage.pose_formats import GivenPoses

SETS = {
    "hdr-gopro": mini.gopro,
    "d-nerf": lambda root: mini.blender(root, "dnerf"),
    "nerf": lambda root: mini.blender(root, "nerf"),
    "hdr-hexplane": mini.blender,
    "hdr-4d": lambda root: mini.blender(root, "hdr4d"),
    "hdr-nerf": mini.hdr_nerf,
    "hdr-nerf-real": mini.hdr_nerf_real,
    "nerfstudio": mini.nerfstudio,
}
NAMES = {
    "hdr-gopro": "HDR-GoPro / NSFF (LLFF)",
    "d-nerf": "D-NeRF (Blender)",
    "nerf": "NeRF synthetic (Blender)",
    "hdr-hexplane": "HDR-HexPlane (Blender)",
    "hdr-4d": "HDR-4D (Blender)",
    "hdr-nerf": "HDR-NeRF (synthetic)",
    "hdr-nerf-real": "HDR-NeRF (real)",
    "nerfstudio": "nerfstudio",
}


def read(root: Path) -> Capture:
    """The training part of a data set."""
    capture = recognize(root)
    assert capture is not None
    return capture


def misses(
    root: Path,
    files: list[Path],
    given: GivenPoses,
    over: float | None,
    size: tuple[int, int] = (mini.H, mini.W),
) -> float:
    """How far the dot of a picture is from where its camera should see it, at worst, in
    pixels.
    """
    poses = fit_poses(root, given, list(range(len(files))), size)
    worst = 0.0
    for path, K, c2w in zip(files, poses.K, poses.c2w, strict=True):
        x, y, z = K @ (c2w[:, :3].T @ (mini.DOT - c2w[:, 3]))
        worst = max(
            worst,
            float(np.abs(np.array([x / z, y / z]) - mini.found_dot(read_image(path, over))).max()),
        )
    return worst


@pytest.mark.parametrize("name", SETS)
def test_a_layout_is_recognized_and_named(name: str, tmp_path: Path) -> None:
    capture = read(SETS[name](tmp_path))
    assert capture.layout == NAMES[name]
    assert capture.has_held_out
    assert all((tmp_path / p.source).is_file() for p in capture.pictures)


def test_footage_is_no_data_set(tmp_path: Path) -> None:
    for name in ("a/0.png", "a/1.png", "rig/left/0.png", "rig/right/0.png"):
        write_png(tmp_path / name, np.zeros((4, 4, 3)))
    write_video(tmp_path / "clip.mp4", [np.zeros((16, 16, 3))] * 3)
    np.save(tmp_path / "a/poses_bounds.npy", np.zeros((2, 17)))  # poses beside frames, for --poses
    elsewhere = {"frames": [{"file_path": "elsewhere/0.png", "transform_matrix": []}]}
    # poses of other pictures, for --poses
    mini.write_json(tmp_path / "rig/transforms.json", elsewhere)
    (tmp_path / "rig/dense").mkdir()
    (tmp_path / "empty").mkdir()
    for place in ("a", "rig", "rig/left", "clip.mp4", "empty", "missing"):
        assert layout_of(tmp_path / place) is None, place


def test_the_picture_shows_the_dot_where_it_was_drawn() -> None:
    c2w = mini.pose(0.6)
    assert np.abs(mini.found_dot(mini.see(c2w)) - mini.dot_pixel(c2w)).max() < 0.5


@pytest.mark.parametrize("name", SETS)
def test_training_cameras_see_the_dot_where_their_pictures_show_it(
    name: str, tmp_path: Path
) -> None:
    capture = read(SETS[name](tmp_path))
    assert capture.poses is not None
    assert (
        misses(
            tmp_path, [tmp_path / p.source for p in capture.pictures], capture.poses, capture.over
        )
        < 0.6
    )


@pytest.mark.parametrize("name", SETS)
def test_held_out_cameras_do_too(name: str, tmp_path: Path) -> None:
    capture = read(SETS[name](tmp_path))
    views, given = held_out_views.read_views(capture)
    assert views
    assert misses(tmp_path, [v.recorded[0][0] for v in views], given, capture.over) < 0.6


def test_a_wrong_convention_would_be_noticed(tmp_path: Path) -> None:
    capture = read(mini.blender(tmp_path))
    assert capture.poses is not None
    flipped = GivenPoses(
        None, capture.poses.K, capture.poses.c2w * [[[1, -1, -1, 1]]], capture.poses.size
    )
    assert misses(tmp_path, [tmp_path / p.source for p in capture.pictures], flipped, 1.0) > 3


def unpadded_gopro(root: Path) -> tuple[Path, list[str]]:
    """The HDR-GoPro layout with pictures img_5.png to img_13.png in time, and their
    names. Rows are as LLFF writes them: img_10.png first.
    """
    names = [f"img_{number + 5}.png" for number in range(mini.COUNT)]
    dense = mini.gopro(root) / "dense"
    for number, name in enumerate(names):
        for folder in ("images", f"images_{mini.W}x{mini.H}"):
            (dense / folder / f"{number:05d}.png").rename(dense / folder / name)
    table = np.load(dense / "poses_bounds.npy")
    table[:, 15] += 0.01 * np.arange(mini.COUNT)  # near, of this picture alone
    np.save(dense / "poses_bounds.npy", table[np.argsort(names)])
    return root, names


def test_rows_of_pictures_that_are_not_zero_padded_are_as_llff_sorts_names(
    tmp_path: Path,
) -> None:
    root, names = unpadded_gopro(tmp_path)
    points = np.random.default_rng(0).uniform([-1, -0.5, 3], [1, 0.5, 5], (30, 3))
    mini.colmap(root / "dense", points, names)
    capture = read(root)
    assert [Path(p.source).name for p in capture.pictures] == names
    assert [p.time for p in capture.pictures] == [*range(mini.COUNT)]
    assert capture.poses is not None
    files = [root / p.source for p in capture.pictures]
    assert misses(root, files, capture.poses, None) < 0.6
    for number, picture in enumerate(capture.pictures):
        sparse = capture.sparse_depth[picture.source]
        c2w = mini.gopro_pose(number % mini.CAMERAS)
        local = (points - c2w[:, 3]) @ c2w[:, :3]
        pixels = (local / local[:, 2:]) @ mini.K.T
        assert np.allclose(sparse.depth, local[:, 2])
        assert np.allclose(sparse.xy * [mini.W, mini.H], pixels[:, :2])
        assert sparse.bounds == pytest.approx((3 + 0.01 * number, 5))
    assert any("row 0 (from 0) is that of" in note and "img_10" in note for note in capture.notes)
    views, given = held_out_views.read_views(capture)
    assert misses(root, [v.recorded[0][0] for v in views], given, None) < 0.6


def test_rows_of_real_hdr_nerf_scenes_are_as_llff_sorts_names(tmp_path: Path) -> None:
    padded = read(mini.hdr_nerf_real(tmp_path / "padded"))
    assert padded.notes == () and padded.poses is not None
    root = mini.hdr_nerf_real(tmp_path / "set")
    files = sorted((root / "input_images").iterdir())
    names = [f"{number}.png" for number in range(len(files))]
    for file, name in zip(files, names, strict=True):
        file.rename(file.with_name(name))
    path = root / "poses_bounds_exps.npy"
    np.save(path, np.load(path)[np.argsort(names)])
    capture = read(root)
    assert capture.poses is not None and "of 10.png" in capture.notes[0]
    assert [p.source for p in capture.pictures[:2]] == ["input_images/0.png", "input_images/12.png"]
    assert [p.ev for p in capture.pictures] == [p.ev for p in padded.pictures]
    assert np.array_equal(capture.poses.c2w, padded.poses.c2w)
    views, given = held_out_views.read_views(capture)
    evs = [exposure for _, exposure in views[0].recorded]
    assert evs == pytest.approx([-4, -2, 0, 2, 4])
    assert misses(root, [v.recorded[0][0] for v in views], given, None) < 0.6


@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "EQUIRECTANGULAR"])
def test_a_data_set_of_another_camera_model_is_refused(
    model: str, per_frame: bool, tmp_path: Path
) -> None:
    root = mini.nerfstudio(tmp_path, **({} if per_frame else {"camera_model": model}))
    document = json.loads((root / "transforms.json").read_text())
    if per_frame:
        document["frames"][2]["camera_model"] = model
    mini.write_json(root / "transforms.json", document)
    with pytest.raises(InputError, match=f"the model {model} is not that of a lens"):
        recognize(root)


def test_depth_of_a_data_set_in_8_bits_is_refused(tmp_path: Path) -> None:
    root = mini.nerfstudio(tmp_path)
    write_png(root / "depth/3.png", np.full((mini.H, mini.W), 0.5))
    path = root / "transforms.json"
    path.write_text(path.read_text().replace("depth/3.npy", "depth/3.png"))
    capture = read(root)
    with pytest.raises(InputError, match=r"3\.png: 8 bits hold no metric depth"):
        maps.disparities(capture, capture.pictures, (mini.H, mini.W))


def test_times_in_any_unit_become_frames() -> None:
    clock = Clock.of([k / 149 for k in range(150) if k % 5])
    assert clock.step == pytest.approx(1 / 149)
    assert [clock(t / 149) for t in (1, 2, 149)] == [0, 1, 148]
    assert clock(5 / 149) == 4
    assert clock(2.5 / 149) == pytest.approx(1.5)
    assert Clock.of([7.0])(7.0) == 0


def test_pictures_of_one_time_are_of_several_cameras() -> None:
    assert number_cameras([0, 1, 0, 1, 2, 1]) == [0, 0, 1, 1, 0, 2]


@pytest.mark.parametrize(
    ("name", "lost", "words"),
    [
        ("hdr-gopro", "dense/poses_bounds.npy", "camera poses"),
        ("hdr-gopro", "dense/images_48x32/00004.png", "8 pictures, but .* camera poses of 9"),
        ("hdr-gopro", "dense/motion_masks/00004.png", "moving masks"),
        ("hdr-gopro", "dense/depth-anything/00004.npy", "metric depth"),
        ("hdr-gopro", "dense/flow_i1/00004_bwd.npz", "optical flow from picture 4 to 3"),
        ("d-nerf", "train/0003.png", "training picture 3"),
        ("hdr-nerf", "train/r_1_2.png", "exposure 2 of training view 1"),
        ("hdr-nerf", "exposure_train.json", "exposure times of the train pictures"),
        (
            "hdr-nerf-real",
            "input_images/003_2.png",
            "59 pictures, but .* cameras and exposures of 60",
        ),
        ("nerfstudio", "images/frame_00003.png", "a training picture"),
        ("nerfstudio", "depth/3.npy", "depth of images/frame_00003.png"),
    ],
)
def test_a_missing_file_is_named_with_what_it_was_for(
    name: str, lost: str, words: str, tmp_path: Path
) -> None:
    SETS[name](tmp_path)
    (tmp_path / lost).unlink()
    with pytest.raises(InputError, match=words) as error:
        recognize(tmp_path)
    assert Path(lost).stem in str(error.value) or Path(lost).parent.name in str(error.value)


@pytest.mark.parametrize(
    ("name", "lost", "words"),
    [
        ("hdr-gopro", "dense/mv_images/00004/00001.png", "what camera 1 saw at time 4"),
        ("hdr-gopro", "dense/mv_masks/00004/00001.png", "moving mask of held-out view"),
        ("d-nerf", "test/0001.png", "held-out view 1"),
        ("hdr-4d", "test/0001.exr", "radiance of held-out view 1"),
        ("hdr-nerf", "exposure_test.json", "exposure times of the test pictures"),
        ("hdr-nerf", "test/r_1_3.png", "exposure 3 of held-out view 1"),
        ("nerfstudio", "images/frame_00004.png", "a held-out view"),
    ],
)
def test_a_missing_held_out_file_is_named_and_matters_to_the_truth_alone(
    name: str, lost: str, words: str, tmp_path: Path
) -> None:
    SETS[name](tmp_path)
    (tmp_path / lost).unlink()
    capture = read(tmp_path)
    with pytest.raises(InputError, match=words):
        held_out_views.read_views(capture)


@pytest.mark.parametrize("name", ["d-nerf", "hdr-nerf", "nerfstudio"])
@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"frames": []}', '{"frames": [{"file_path": "a"}]}']
)
def test_a_transforms_file_cut_short_is_one_sentence(name: str, text: str, tmp_path: Path) -> None:
    SETS[name](tmp_path)
    path = tmp_path / ("transforms.json" if name == "nerfstudio" else "transforms_train.json")
    path.write_text(text)
    with pytest.raises(InputError, match=path.name):
        recognize(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t[:, :17], r"expected an array \(frames, 18\)"),
        (lambda t: t[:58], "58 rows, but every pose has 5"),
        (lambda t: t * np.where(np.arange(18) == 17, -1, 1), "exposure time in its last column"),
        (lambda t: t[:55], "60 pictures, but .* of 55"),
    ],
)
def test_cameras_of_real_hdr_nerf_scenes_that_make_no_sense_are_one_sentence(
    change: Callable[[np.ndarray], np.ndarray], words: str, tmp_path: Path
) -> None:
    path = mini.hdr_nerf_real(tmp_path) / "poses_bounds_exps.npy"
    np.save(path, change(np.load(path)))
    with pytest.raises(InputError, match=words):
        recognize(tmp_path)


def exported_nerfstudio(root: Path, names: dict[str, Any]) -> Path:
    """nerfstudio's layout as `export` writes it, with these `names` of maps in each
    entry under `hdr_nsff`, or at its top.
    """
    mini.nerfstudio(root)
    document = json.loads((root / "transforms.json").read_text())
    top = {"points": names.pop("points", None)}
    frames = {
        f["file_path"]: {"time": k, "disparity": "depth/0.npy", **names}
        for k, f in enumerate(document["frames"])
    }
    document["hdr_nsff"] = {
        "fps": 24,
        "reference_bracket": 0,
        "bracket_ev": [0.0],
        "exposure_given": True,
        "near": 1.0,
        "far": 9.0,
        "depth_kind": "scene",
        "frames": frames,
        **top,
    }
    mini.write_json(root / "transforms.json", document)
    return root


def test_maps_of_an_export_are_found_by_their_names(tmp_path: Path) -> None:
    names = {"confidence": "depth/1.npy", "points": "depth/2.npy", "flow": {"a": "depth/3.npy"}}
    root = exported_nerfstudio(tmp_path, names)
    np.save(root / "depth/2.npy", [[1.0, 2.0, 3.0]])
    capture = read(root)
    first = capture.pictures[0]
    paths = [first.depth, first.confidence, first.flow["a"]]
    assert paths == [tmp_path.resolve() / f"depth/{k}.npy" for k in (0, 1, 3)]
    assert capture.points is not None
    assert (capture.points == [[1, 2, 3]]).all()


@pytest.mark.parametrize("name", ["../secret.npy", "/etc/passwd", "link.npy"])
@pytest.mark.parametrize("key", ["disparity", "confidence", "moving", "points", "flow"])
def test_a_map_outside_the_data_set_is_refused(key: str, name: str, tmp_path: Path) -> None:
    np.save(tmp_path / "secret.npy", np.ones((2, 3)))
    root = tmp_path / "set"
    exported_nerfstudio(root, {key: {"a": name} if key == "flow" else name})
    (root / "link.npy").symlink_to(tmp_path / "secret.npy")
    with pytest.raises(InputError, match="points outside the data set"):
        capture = read(root)
        held_out_views.read_views(capture)


def test_a_depth_map_outside_the_data_set_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "secret.npy", np.ones((2, 3)))
    path = mini.nerfstudio(tmp_path / "set") / "transforms.json"
    path.write_text(path.read_text().replace("depth/3.npy", "../secret.npy"))
    with pytest.raises(InputError, match="points outside the data set"):
        recognize(path.parent)


@pytest.mark.parametrize("bad", ["\0", "a\0b", "\ud800", "x" * 5000, "a/" * 3000])
@pytest.mark.parametrize("name", ["d-nerf", "hdr-nerf", "nerfstudio"])
def test_a_name_that_no_file_can_have_is_one_short_sentence(
    name: str, bad: str, tmp_path: Path
) -> None:
    SETS[name](tmp_path)
    path = tmp_path / ("transforms.json" if name == "nerfstudio" else "transforms_train.json")
    document = json.loads(path.read_text())
    document["frames"][1]["file_path"] = bad
    path.write_text(json.dumps(document))
    refusals = "cannot be the name of a file|missing|no exposure"
    with pytest.raises(InputError, match=refusals) as error:
        recognize(tmp_path)
    assert len(str(error.value)) < 500


def test_pictures_may_be_links_to_other_places(tmp_path: Path) -> None:
    root = mini.gopro(tmp_path / "set")
    picture = root / "dense/images_48x32/00004.png"
    picture.rename(tmp_path / "elsewhere.png")
    picture.symlink_to(tmp_path / "elsewhere.png")
    assert read(root).pictures[4].source == "dense/images_48x32/00004.png"


def read_whole(root: Path) -> None:
    """All that `prepare` asks of a data set before it makes anything of it."""
    capture = recognize(root)
    if capture is None:
        return
    capture.footage()
    if capture.poses is not None:
        fit_poses(root, capture.poses, list(range(len(capture.pictures))), (mini.H, mini.W))
    if capture.has_held_out:
        held_out_views.read_views(capture)


@pytest.mark.parametrize("name", [*SETS, "exported"])
def test_damaged_data_sets_are_read_or_refused(name: str, tmp_path: Path) -> None:
    if name == "exported":
        exported_nerfstudio(tmp_path, {"confidence": "depth/1.npy", "flow": {"a": "depth/3.npy"}})
    else:
        SETS[name](tmp_path)
    for path in sorted(tmp_path.rglob("*.json")):
        check_reader(path, lambda: read_whole(tmp_path), 20)
        check_json_reader(path, lambda: read_whole(tmp_path), 60)
    for path in sorted(tmp_path.rglob("poses_bounds*.npy")):
        check_reader(path, lambda: read_whole(tmp_path), 60)


@pytest.mark.parametrize("value", [[{"a": 1}], "all", [3], {}])
@pytest.mark.parametrize("key", ["train_filenames", "val_filenames", "test_filenames"])
def test_a_list_of_names_that_is_none_is_one_sentence(key: str, value: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"`{key}` is no list of file names"):
        recognize(mini.nerfstudio(tmp_path, **{key: value}))


def test_a_file_name_that_leaves_the_data_set_is_refused(tmp_path: Path) -> None:
    root = mini.blender(tmp_path / "set")
    write_png(tmp_path / "secret.png", np.zeros((4, 4, 3)))
    text = (root / "transforms_train.json").read_text().replace("./train/0000", "../secret")
    (root / "transforms_train.json").write_text(text)
    with pytest.raises(InputError, match="outside the data set"):
        recognize(root)
