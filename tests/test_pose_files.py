"""Given poses in every convention: a known point in front of a known camera must land
on its known pixel.
"""

import json
import struct

import numpy as np
import pytest
from mutations import check_json_reader, check_reader
from scipy.spatial.transform import Rotation

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.colmap import read_model
from hdr_nsff.footage.lens_files import read_lens
from hdr_nsff.footage.pose_files import import_poses, rows_of_cameras
from hdr_nsff.footage.pose_formats import from_json, from_transforms
from hdr_nsff.geometry.poses import project

W, H, FOCAL = 64, 48, 50.0
POINT = np.array([0.3, -0.2, 5.0])
# cameras 0.5 apart, each turned by 0, 10, 20 degrees about the vertical
TURNS = Rotation.from_euler("y", [[0], [10], [20]], degrees=True).as_matrix().reshape(3, 3, 3)
# OpenCV: right, down, forward
C2W = np.concatenate([TURNS, np.array([[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0]])[:, :, None]], 2)
# camera 0 is the world: x = 32 + 50 * 0.3 / 5 = 35, y = 24 - 50 * 0.2 / 5 = 22
PIXEL_0 = np.array([35.0, 22.0])
NAMES = ["a_0.png", "a_1.png", "a_2.png"]


def pixels(poses, point=POINT) -> np.ndarray:
    """Where the three cameras see the point (3, 2)."""
    return project(poses, np.arange(3), np.tile(point, (3, 1)))[0]


def expected() -> np.ndarray:
    """The same, by hand: rotate into each camera, divide, scale."""
    local = np.stack([c[:, :3].T @ (POINT - c[:, 3]) for c in C2W])
    return np.stack(
        [W / 2 + FOCAL * local[:, 0] / local[:, 2], H / 2 + FOCAL * local[:, 1] / local[:, 2]], 1
    )


def opengl(c2w: np.ndarray) -> list:
    """A 4x4 with columns right, up, back."""
    right, down, forward, center = c2w.T
    return np.stack(
        [np.append(right, 0), np.append(-down, 0), np.append(-forward, 0), np.append(center, 1)], 1
    ).tolist()


def llff_table() -> np.ndarray:
    """poses_bounds (3, 17): columns down, right, back."""
    rows = []
    for c in C2W:
        right, down, forward, center = c.T
        matrix = np.stack([down, right, -forward, center, np.array([H, W, FOCAL])], 1)
        rows.append(np.append(matrix.ravel(), [2.0, 10.0]))
    return np.stack(rows)


def colmap_text(folder, names=NAMES, camera="1 SIMPLE_PINHOLE 64 48 50 32 24") -> None:
    """A COLMAP text model that saw the point with every camera."""
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text(f"# comment\n{camera}\n")
    lines = ["# comment"]
    for k, (c, name, xy) in enumerate(zip(C2W, names, expected(), strict=False), 1):
        q = np.roll(Rotation.from_matrix(c[:, :3].T).as_quat(), 1)
        t = -c[:, :3].T @ c[:, 3]
        lines += [" ".join(map(str, [k, *q, *t, 1, name])), f"{xy[0]} {xy[1]} 7 1.0 2.0 -1"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("7 0.3 -0.2 5.0 10 20 30 0.25 1 0 2 0 3 0\n")


def colmap_binary(folder) -> None:
    """The same model in binary."""
    folder.mkdir()
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ3d", 1, 1, 0, W, H, FOCAL, 32, 24))
    images = struct.pack("<Q", 3)
    for k, (c, name, xy) in enumerate(zip(C2W, NAMES, expected(), strict=True), 1):
        q = np.roll(Rotation.from_matrix(c[:, :3].T).as_quat(), 1)
        images += struct.pack("<i7di", k, *q, *(-c[:, :3].T @ c[:, 3]), 1) + name.encode() + b"\0"
        images += struct.pack("<Qddqddq", 2, *xy, 7, 1.0, 2.0, -1)
    (folder / "images.bin").write_bytes(images)
    point = struct.pack("<QQ3d3BdQ6i", 1, 7, *POINT, 10, 20, 30, 0.25, 3, 1, 0, 2, 0, 3, 0)
    (folder / "points3D.bin").write_bytes(point)


def transforms(**extra) -> dict:
    """transforms.json with intrinsics for all frames."""
    frames = [
        {"file_path": f"images/{n}", "transform_matrix": opengl(c)}
        for n, c in zip(NAMES, C2W, strict=True)
    ]
    return {
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": W / 2,
        "cy": H / 2,
        "w": W,
        "h": H,
        "frames": frames,
        **extra,
    }


def write(path, document) -> None:
    """JSON into a file."""
    path.write_text(json.dumps(document))


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_colmap_cameras_see_the_point_where_they_did(tmp_path, kind):
    (colmap_text if kind == "text" else colmap_binary)(tmp_path / "sparse")
    poses = import_poses(tmp_path, NAMES, (H, W))
    assert np.allclose(pixels(poses)[0], PIXEL_0)
    assert np.allclose(pixels(poses), expected())
    assert np.allclose(poses.points, POINT[None])
    assert np.allclose(poses.point_errors, 0.25)
    assert np.allclose(poses.tracks[:, 2:], expected())
    assert np.allclose(poses.frame_errors, 0, atol=1e-6)


def test_nerfstudio_axes(tmp_path):
    write(tmp_path / "transforms.json", transforms())
    assert np.allclose(pixels(import_poses(tmp_path, NAMES, (H, W))), expected())


def test_blender_angle_gives_the_focal_length(tmp_path):
    frames = [
        {"file_path": f"./train/a_{k}", "transform_matrix": opengl(c)} for k, c in enumerate(C2W)
    ]
    angle = 2 * np.arctan(W / 2 / FOCAL)
    write(
        tmp_path / "transforms_train.json",
        {"camera_angle_x": angle, "near": 2.0, "far": 6.0, "frames": frames},
    )
    poses = import_poses(tmp_path, NAMES, (H, W))
    assert np.allclose(pixels(poses), expected())
    assert (poses.near, poses.far) == (2.0, 6.0)


def test_llff_axes_and_bounds(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", llff_table())
    poses = import_poses(tmp_path / "poses_bounds.npy", NAMES, (H, W))
    assert np.allclose(pixels(poses), expected())
    assert poses.near == pytest.approx(0.8 * 2)
    assert poses.far == pytest.approx(1.25 * 10)


def test_json_of_llff_poses_has_columns_right_up_back(tmp_path):
    matrices = [np.column_stack([np.array(opengl(c))[:3], [H, W, FOCAL]]).tolist() for c in C2W]
    write(tmp_path / "precomputed.json", {"poses": matrices, "bds": [[2.0, 10.0]] * 3})
    assert np.allclose(pixels(import_poses(tmp_path, NAMES, (H, W))), expected())


# row by row in the files below
SORTED_BY_LLFF = ["img_1.png", "img_10.png", "img_2.png"]


@pytest.mark.parametrize("name", ["poses_bounds.npy", "precomputed.json"])
def test_rows_of_llff_are_in_plain_string_order_of_the_names(tmp_path, capsys, name):
    if name == "poses_bounds.npy":
        np.save(tmp_path / name, llff_table())
    else:
        matrices = [np.column_stack([np.array(opengl(c))[:3], [H, W, FOCAL]]) for c in C2W]
        poses = [matrix.tolist() for matrix in matrices]
        write(tmp_path / name, {"poses": poses, "bds": [[2.0, 10.0]] * 3})
    in_time = ["img_1.png", "img_2.png", "img_10.png"]
    poses = import_poses(tmp_path, in_time, (H, W))
    assert np.allclose(poses.c2w, C2W[[SORTED_BY_LLFF.index(n) for n in in_time]])
    said = " ".join(capsys.readouterr().err.split())
    assert f"{name}: poses are taken in plain string order of the names" in said
    assert "row 1 (from 0) is that of img_10.png" in said


@pytest.mark.parametrize(
    "sources", [[f"clip.mp4#{k}" for k in (1, 2, 10)], NAMES, ["8.png", "9.png", "a.png"]]
)
def test_rows_in_the_order_of_time_stay_so_without_a_word(tmp_path, capsys, sources):
    np.save(tmp_path / "poses_bounds.npy", llff_table())
    assert np.allclose(import_poses(tmp_path, sources, (H, W)).c2w, C2W)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("ending", ["/{}.png", ".mp4#{}"])
def test_rows_of_still_cameras_are_in_plain_string_order_of_their_names(tmp_path, capsys, ending):
    np.save(tmp_path / "poses_bounds.npy", llff_table())
    cameras = ["cam1", "cam2", "cam10"]
    sources = [camera + ending.format(k) for camera in cameras for k in range(2)]
    poses = import_poses(tmp_path, sources, (H, W))
    assert np.allclose(poses.c2w, C2W[[0, 0, 2, 2, 1, 1]])
    assert f"row 1 (from 0) is that of {sources[4]}" in " ".join(capsys.readouterr().err.split())
    assert rows_of_cameras(None, 3, cameras) == [[0], [2], [1]]  # of their lenses too
    names = ["x.png", "y.png", "z.png"]  # that fit no camera: the file's own order
    assert rows_of_cameras(names, 3, cameras) == [[0], [1], [2]]


def test_smaller_frames_have_smaller_pixels(tmp_path):
    write(tmp_path / "transforms.json", transforms())
    assert np.allclose(pixels(import_poses(tmp_path, NAMES, (H // 2, W // 2))), expected() / 2)


def test_frames_are_matched_by_name_not_by_order(tmp_path):
    document = transforms()
    document["frames"] = document["frames"][::-1]
    write(tmp_path / "transforms.json", document)
    assert np.allclose(pixels(import_poses(tmp_path, NAMES, (H, W))), expected())


def test_cameras_with_the_same_file_names_are_matched_by_their_folder(tmp_path):
    sources = ["left/0.png", "right/0.png", "up/0.png"]
    colmap_text(tmp_path, [sources[0], sources[1], sources[2]])
    order = [2, 0, 1]
    poses = import_poses(tmp_path, [sources[k] for k in order], (H, W))
    assert np.allclose(pixels(poses), expected()[order])


def test_frames_of_a_video_are_matched_in_order(tmp_path):
    write(tmp_path / "transforms.json", transforms())
    poses = import_poses(tmp_path, [f"clip.mp4#{k}" for k in range(3)], (H, W))
    assert np.allclose(pixels(poses), expected())


@pytest.mark.parametrize("names", [["left", "right.mp4", "shot/up.png"], ["0", "1", "2"]])
def test_still_cameras_have_one_pose_for_all_of_their_frames(tmp_path, names):
    document = transforms()
    for frame, name in zip(document["frames"], names, strict=True):
        frame["file_path"] = name
    write(tmp_path / "transforms.json", document)
    folders = [f"{camera}/{k}.png" for camera in ("left", "right", "up") for k in range(4)]
    videos = [f"{camera}.mp4#{k}" for camera in ("left", "right", "up") for k in range(4)]
    for sources in (folders, videos):
        poses = import_poses(tmp_path, sources, (H, W))
        assert np.allclose(poses.c2w, C2W[[0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2]])
        assert poses.parallax == "full"
    if names[0] == "left":  # by name, not by order
        poses = import_poses(tmp_path, [folders[8], folders[0], folders[4]], (H, W))
        assert np.allclose(poses.c2w, C2W[[2, 0, 1]])


def test_one_pose_is_not_that_of_all_frames_of_a_clip(tmp_path):
    document = transforms()
    document["frames"] = document["frames"][:1]
    write(tmp_path / "transforms.json", document)
    with pytest.raises(InputError, match="1 poses for 3 frames"):
        import_poses(tmp_path, [f"clip.mp4#{k}" for k in range(3)], (H, W))
    document["frames"][0]["file_path"] = "clip.mp4"  # it stood still
    write(tmp_path / "transforms.json", document)
    poses = import_poses(tmp_path, [f"clip.mp4#{k}" for k in range(3)], (H, W))
    assert np.allclose(poses.c2w, C2W[[0, 0, 0]]) and poses.parallax == "none"


def test_a_frame_of_a_video_without_a_pose_lies_between_those_of_its_camera(tmp_path):
    colmap_text(tmp_path, ["left.mp4#0", "left.mp4#2", "right.mp4#0"])
    sources = ["left.mp4#0", "left.mp4#1", "left.mp4#2", "right.mp4#0"]
    poses = import_poses(tmp_path, sources, (H, W))
    assert poses.registered.tolist() == [True, False, True, True]
    assert np.allclose(poses.c2w[1, :, 3], C2W[:2, :, 3].mean(0))


def test_a_frame_without_a_pose_has_the_focal_length_of_its_camera(tmp_path):
    """The first frame of the second camera has none."""
    names = [f"{camera}/{t}.png" for camera in ("a", "b") for t in range(3)]
    document = transforms()
    frame = document["frames"][0]
    document["frames"] = [
        frame | {"file_path": name, "fl_x": FOCAL if name[0] == "a" else 2 * FOCAL}
        for name in names
        if name != "b/0.png"
    ]
    write(tmp_path / "transforms.json", document)
    poses = import_poses(tmp_path, names, (H, W))
    assert poses.registered.tolist() == [True] * 3 + [False] + [True] * 2
    assert np.allclose(poses.K[:, 0, 0], [FOCAL] * 3 + [2 * FOCAL] * 3)


def test_a_frame_that_colmap_left_out_lies_between_its_neighbors(tmp_path):
    colmap_text(tmp_path)
    text = (tmp_path / "images.txt").read_text().splitlines()
    # without the second image
    (tmp_path / "images.txt").write_text("\n".join(text[:3] + text[5:]) + "\n")
    poses = import_poses(tmp_path, NAMES, (H, W))
    assert poses.registered.tolist() == [True, False, True]
    assert np.allclose(poses.c2w[1], C2W[1])  # midway in place and angle
    assert "did not register" in poses.notes[-1]


def test_cameras_at_rest_have_no_parallax(tmp_path):
    document = transforms()
    for frame in document["frames"]:
        frame["transform_matrix"] = opengl(np.concatenate([C2W[0][:, :3], C2W[0][:, 3:]], 1))
    write(tmp_path / "transforms.json", document)
    assert import_poses(tmp_path, NAMES, (H, W)).parallax == "none"


def test_positions_that_single_precision_cannot_hold_are_refused(tmp_path):
    """Cameras that move by one, and one that stands still, by UTM coordinates."""
    for moves in (True, False):
        document = transforms()
        for frame in document["frames"]:
            matrix = frame["transform_matrix"]
            x = matrix[0][3] if moves else 0.0
            matrix[0][3], matrix[1][3] = x + 483211.4, 5446321.7
        write(tmp_path / "transforms.json", document)
        with pytest.raises(InputError, match="subtract an offset from all positions"):
            import_poses(tmp_path, NAMES, (H, W))
    document["near"] = 600.0  # from a plane
    write(tmp_path / "transforms.json", document)
    assert import_poses(tmp_path, NAMES, (H, W)).near == 600


def test_a_model_holds_how_often_a_point_was_seen(tmp_path):
    colmap_binary(tmp_path / "m")
    model = read_model(tmp_path / "m")
    assert model.track_lengths.tolist() == [3]
    assert model.images[2].point_ids.tolist() == [7, -1]


def test_k3_of_a_transforms_file_becomes_part_of_k1_and_k2(tmp_path):
    path = tmp_path / "transforms.json"
    write(path, transforms(camera_model="OPENCV", k1=-0.2, k2=0.05, k3=-0.01, p1=1e-4))
    given = from_json(path)
    assert given.distortion is not None
    assert np.allclose(given.distortion, read_lens(path).distortion)
    assert given.distortion[0, 2] == 1e-4
    assert (np.abs(given.distortion[:, :2] - [-0.2, 0.05]) > 1e-4).all()
    write(path, transforms(k1=-0.2, k2=0.05, k3=0, k4=0, is_fisheye=False))
    assert np.array_equal(from_json(path).distortion, [[-0.2, 0.05, 0, 0]] * 3)


def test_k3_needs_the_size_of_the_pictures(tmp_path):
    document = transforms(camera_angle_x=0.9, k3=0.01)
    for key in ("fl_x", "w", "h", "cx", "cy"):
        del document[key]
    with pytest.raises(InputError, match="`k3` without `w` and `h`"):
        from_transforms(tmp_path / "transforms.json", document)


def test_damaged_poses_are_read_or_refused(tmp_path):
    def read(folder):
        return lambda: import_poses(folder, NAMES, (H, W))

    (tmp_path / "llff").mkdir()
    np.save(tmp_path / "llff/poses_bounds.npy", llff_table())
    check_reader(tmp_path / "llff/poses_bounds.npy", read(tmp_path / "llff"), 150)
    path = tmp_path / "transforms.json"
    write(path, transforms(near=1.0, far=9.0, k1=0.0, k3=1e-3, camera_model="OPENCV"))
    check_reader(path, read(tmp_path), 150)
    check_json_reader(path, read(tmp_path), 300)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_damaged_colmap_models_are_read_or_refused(tmp_path, name):
    for make, suffix in ((colmap_text, "txt"), (colmap_binary, "bin")):
        make(tmp_path / suffix)
        path = tmp_path / suffix / f"{name}.{suffix}"
        check_reader(path, lambda p=path: import_poses(p.parent, NAMES, (H, W)), 150)


def test_most_frames_must_have_a_pose(tmp_path):
    write(tmp_path / "transforms.json", transforms())
    with pytest.raises(InputError, match=r"3 of 6 frames have no pose there \(frames 3-5\)"):
        import_poses(tmp_path, [*NAMES, "b_0.png", "b_1.png", "b_2.png"], (H, W))
