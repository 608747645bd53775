"""Poses that other programs estimated, brought to the frames of a clip.

A file or folder in one of the formats of `pose_formats.py` lists poses of pictures;
here they are matched to the frames by name or order, and rescaled to their size.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.footage.colmap import ColmapModel, read_model
from hdr_nsff.footage.pose_formats import (
    MAX_DISTORTION_PX,
    GivenPoses,
    distorted,
    from_colmap,
    from_json,
    from_llff,
    llff_places,
    max_displacement_px,
    order_note,
)
from hdr_nsff.geometry.alignment import nearest_rotation
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.poses import (
    MIN_REGISTERED_SHARE,
    Poses,
    format_ranges,
    interpolate,
    project,
    trusted_points,
)
from hdr_nsff.scene.manifest import MAX_NUMBER

# off which a rotation matrix counts as rounded, and is made exact again
MAX_ROTATION_ERROR = 1e-6
MAX_ASPECT_ERROR = 0.02  # by which the shape of the poses' frames may differ from the frames used
MIN_TURN = 1e-6  # entries of rotations, and centers over `near`: less is no motion
# distance of cameras from the origin, over `near`: single precision then moves what is
# near by half a pixel of a picture 1000 wide
MAX_OFFSET = 1e4
MIN_TRACKED_POINTS = 10  # from which near and far are taken from the points
Parallax = Literal["full", "rotation", "none"]
FRAME_OF_VIDEO = re.compile(r"#\d+$")  # ends its name
NAMES = ("transforms.json", "transforms_train.json", "poses_bounds.npy", "precomputed.json")


def import_poses(
    path: Path | str,
    sources: list[str],
    size: tuple[int, int],
    lenses: Sequence[Lens | None] = (),
) -> Poses:
    """Poses of the frames named `sources` (T) from `path`, for `size` (height, width).

    Frames are matched by file name, else still cameras by theirs, else either in order
    where the numbers fit. `path` is a file, or a folder that holds one of the known
    ones. `lenses` (T), or none, distorted the frames before these were undistorted.
    InputError where it cannot be read, does not fit, or has fewer poses than six frames
    in ten.
    """
    path = locate(Path(path))
    given, model = read_given(path)
    rows = match_frames(path, given.names, len(given.c2w), sources)
    note = order_note(sources, rows) if given.names is None else None
    if note is not None:
        say(f"{path.name}: {note}")
    cameras = [camera_of(source) for source in sources]
    poses = fit_poses(path, given, rows, size, lenses, cameras)
    if model is not None:
        poses = with_points(poses, model, rows, lenses)
    check_offset(path, poses)
    if all(row is not None for row in rows):
        return poses
    frames_of: dict[str, list[int]] = {camera: [] for camera in cameras}
    for t, camera in enumerate(cameras):
        frames_of[camera].append(t)
    return interpolate(poses, list(frames_of.values()))


def read_given(path: Path) -> tuple[GivenPoses, ColmapModel | None]:
    """The poses at a place that `locate` returns, and their COLMAP model."""
    if path.is_dir():
        model = read_model(path)
        return from_colmap(path, model), model
    if path.suffix == ".npy":
        return from_llff(path), None
    return from_json(path), None


def locate(path: Path) -> Path:
    """The file, or the folder of a COLMAP model, that `path` means."""
    if path.is_file():
        if path.suffix not in (".json", ".npy"):
            raise InputError(
                f"{path}: poses come as a COLMAP folder, transforms.json, poses_bounds.npy "
                "or precomputed.json"
            )
        return path
    if not path.is_dir():
        raise InputError(f"{path}: no such file or folder of poses; correct the path")
    for folder in (path, path / "sparse" / "0", path / "sparse", path / "0"):
        if (folder / "images.bin").is_file() or (folder / "images.txt").is_file():
            return folder
    for name in NAMES:
        if (path / name).is_file():
            return path / name
    raise InputError(
        f"{path}: no poses here; expected a COLMAP model (cameras, images, points3D) "
        f"or one of {', '.join(NAMES)}"
    )


# Which pose is of which frame


def match_frames(
    path: Path, names: list[str] | None, count: int, sources: list[str]
) -> list[int | None]:
    """Which of `count` given poses belongs to each of the frames `sources`.

    By the longest ending of the path that distinguishes pictures, else the one pose
    that a camera has for all of its frames, else in order.
    """
    for parts in (3, 2, 1) if names is not None else ():
        assert names is not None
        rows = match_names(names, sources, parts)
        if rows is None:
            continue
        missing = [t for t, row in enumerate(rows) if row is None]
        if len(missing) > (1 - MIN_REGISTERED_SHARE) * len(sources):
            raise InputError(
                f"{path}: {len(missing)} of {len(sources)} frames have no pose there "
                f"(frames {format_ranges(missing)}); give poses for all of them"
            )
        return rows
    cameras = list(dict.fromkeys(map(camera_of, sources)))
    rows_of = rows_of_cameras(names, count, cameras)
    if rows_of is not None and all(len(rows) == 1 for rows in rows_of):
        row_of = {camera: row for camera, (row,) in zip(cameras, rows_of, strict=True)}
        return [row_of[camera_of(source)] for source in sources]
    if count != len(sources):
        raise InputError(
            f"{path}: {count} poses for {len(sources)} frames, and no file name fits; "
            "give one pose per used frame, or one per still camera by the camera's name"
        )
    return [*rows_in_order(names, sources)]


def rows_in_order(names: list[str] | None, wanted: Sequence[str]) -> list[int]:
    """The row of each of the frames, or cameras, `wanted` (N), of as many poses.

    Poses without `names` are as LLFF writes them, in the order of sorted file names;
    those of a video's frames are in time, and poses with `names` in their own order.
    """
    if names is None and not all(FRAME_OF_VIDEO.search(name) for name in wanted):
        return llff_places(wanted)
    return list(range(len(wanted)))


def rows_of_cameras(
    names: list[str] | None, count: int, cameras: Sequence[str]
) -> list[list[int]] | None:
    """The rows, of `count` poses with these `names`, that belong to each of `cameras`.

    A pose is a camera's if its file or its folder has the camera's name; one pose per
    camera of several may also come in order. None where neither fits.
    """
    ends = [(camera_of(f"{name}#"), camera_of(name)) for name in names or ()]
    rows_of = [[row for row, end in enumerate(ends) if camera in end] for camera in cameras]
    if rows_of and all(rows_of):
        return rows_of
    if not count == len(cameras) > 1:
        return None
    return [[row] for row in rows_in_order(names, cameras)]


def camera_of(source: str) -> str:
    """The name of a frame's camera: its video's, or its folder's."""
    file, is_video, _ = source.replace("\\", "/").partition("#")
    return PurePosixPath(file).stem if is_video else PurePosixPath(file).parent.name


def match_names(names: list[str], sources: list[str], parts: int) -> list[int | None] | None:
    """The row of each source among `names`, by the last `parts` parts of their paths.

    None where these do not distinguish pictures, or no source is among them.
    """
    given = [path_end(name, parts) for name in names]
    wanted = [path_end(source, parts) for source in sources]
    rows = {end: row for row, end in enumerate(given)}
    if len(rows) < len(given) or len(set(wanted)) < len(wanted):
        return None
    found = [rows.get(end) for end in wanted]
    return None if all(row is None for row in found) else found


def path_end(name: str, parts: int) -> tuple[str, ...]:
    """The last `parts` parts of a path, without the ending of an image."""
    stem = re.sub(r"\.(png|jpe?g|tiff?|exr|dng)$", "", name.replace("\\", "/"), flags=re.I)
    return tuple(stem.split("/")[-parts:])


# Poses of the frames


def fit_poses(
    path: Path,
    given: GivenPoses,
    rows: Sequence[int | None],
    size: tuple[int, int],
    lenses: Sequence[Lens | None] = (),
    cameras: Sequence[str] = (),
) -> Poses:
    """The poses `rows` (T) of `given`, for frames of `size` (height, width) that were
    freed of the distortion of `lenses` (T), or of none.

    A row of None is a frame without a pose; it has the intrinsics of the first other
    one of its camera, by the names `cameras` (T), or of one camera. InputError, which
    names `path`, for poses that make no sense or are for frames of another shape.
    """
    check_given(path, given)
    rows_of_K = known_rows(rows, cameras or [""] * len(rows))
    K = np.stack([scaled_intrinsics(path, given, row, size) for row in rows_of_K])
    height, width = size
    pinholes = {id(lens): lens.resized(width, height).pinhole() for lens in lenses if lens}
    for t, lens in enumerate(lenses):
        K[t] = pinholes.get(id(lens), K[t])
    if not pinholes and (displacement := max_displacement_px(given)) > MAX_DISTORTION_PX:
        raise distorted(path, displacement)
    c2w = np.tile(np.eye(4)[:3], (len(rows), 1, 1))
    for t, row in enumerate(rows):
        if row is not None:
            c2w[t] = given.c2w[row]
    rotation = c2w[:, :, :3]
    if (np.linalg.det(rotation) <= 0).any() or (K[:, (0, 1), (0, 1)] <= 0).any():
        raise InputError(
            f"{path}: a pose is not a rotation (mirrored or all zero), or a focal length is not "
            "positive; export them again"
        )
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    rounded = error > MAX_ROTATION_ERROR
    c2w[rounded, :, :3] = nearest_rotation(rotation[rounded])
    registered = np.array([row is not None for row in rows])
    return Poses(
        K,
        c2w,
        registered,
        parallax_of(c2w[registered], given.near or 1.0),
        near=given.near,
        far=given.far,
        notes=(f"poses given: {path.name}",),
    )


def known_rows(rows: Sequence[int | None], cameras: Sequence[str]) -> list[int]:
    """`rows` (T) where None is the first row of the same camera, by the names `cameras`
    (T), else the first of all: a camera without any is refused when poses are
    interpolated.
    """
    first: dict[str, int] = {}
    for camera, row in zip(cameras, rows, strict=True):
        if row is not None:
            first.setdefault(camera, row)
    any_row = next(iter(first.values()))
    return [
        first.get(camera, any_row) if row is None else row
        for camera, row in zip(cameras, rows, strict=True)
    ]


def check_given(path: Path, given: GivenPoses) -> None:
    """InputError for poses with numbers that cannot be."""
    if not all(np.abs(v).max() <= MAX_NUMBER for v in (given.K, given.c2w, given.size)):
        raise InputError(
            f"{path}: poses hold NaN, Inf or numbers beyond {MAX_NUMBER:g}; export them again"
        )
    if given.size[:, 0].min() <= 0:
        raise InputError(f"{path}: poses are for frames without width; export them again")


def check_offset(path: Path, poses: Poses) -> None:
    """InputError where cameras are so far from the origin that single precision loses
    their parallax. Where `near` is not known, the extent of their path stands for it.
    """
    centers = poses.c2w[poses.registered, :, 3]
    extent = float(np.linalg.norm(centers - centers[:1], axis=1).max())
    scale = poses.near or extent or 1.0
    offset = float(np.abs(centers).max())
    if offset > MAX_OFFSET * scale:
        raise InputError(
            f"{path}: the cameras are {offset:.3g} units from the origin, so single precision "
            "would lose their parallax; subtract an offset from all positions"
        )


def scaled_intrinsics(path: Path, given: GivenPoses, row: int, size: tuple[int, int]) -> np.ndarray:
    """K (3, 3) of a given pose in pixels of frames of `size` (height, width)."""
    height, width = size
    w, h = given.size[row]
    if h > 0 and abs(width / w / (height / h) - 1) > MAX_ASPECT_ERROR:
        raise InputError(
            f"{path}: poses are for {w:.0f}x{h:.0f} frames, these are {width}x{height}: "
            "another shape; give poses for these frames"
        )
    scale_x = width / w
    scale_y = height / h if h > 0 else scale_x
    K = given.K[row] * np.array([scale_x, scale_y, 1])[:, None]
    if h <= 0:
        K[1, 2] = height / 2
    return K


def parallax_of(c2w: np.ndarray, near: float) -> Parallax:
    """How cameras c2w (T, 3, 4) move; `near` is the depth of the nearest content."""
    centers = c2w[:, :, 3]
    if np.linalg.norm(centers - centers[:1], axis=1).max() > MIN_TURN * near:
        return "full"
    turns = np.abs(c2w[:, :, :3] - c2w[:1, :, :3]).max()
    return "rotation" if turns > MIN_TURN else "none"


def with_points(
    poses: Poses,
    model: ColmapModel,
    rows: Sequence[int | None],
    lenses: Sequence[Lens | None] = (),
) -> Poses:
    """`poses` with the static points of a COLMAP model, and near and far from those.

    `rows` (T) are the images of the frames in the order of their names; `lenses` (T),
    or none, distorted their keypoints.
    """
    tracks = tracks_of(poses, model, rows, lenses)
    shrink = poses.K[0, 0, 0] / next(iter(model.cameras.values())).K[0, 0]
    errors = model.errors * shrink  # in pixels of the frames
    poses = trusted_points(replace(poses, points=model.points, point_errors=errors, tracks=tracks))
    return with_depth_range(poses)


def with_depth_range(poses: Poses) -> Poses:
    """`poses` with near and far from their points, where these are enough."""
    if len(poses.tracks) < MIN_TRACKED_POINTS:
        return poses
    frames = poses.tracks[:, 0].astype(int)
    seen = poses.points[poses.tracks[:, 1].astype(int)]
    _, depth = project(poses, frames, seen)
    near = float(0.7 * np.percentile(depth, 1))
    far = float(1.3 * np.percentile(depth, 99))
    return replace(poses, near=near, far=far)


def tracks_of(
    poses: Poses,
    model: ColmapModel,
    rows: Sequence[int | None],
    lenses: Sequence[Lens | None],
) -> np.ndarray:
    """Every view of a point (O, 4): frame, point, x, y in pixels of the frames."""
    images = sorted(model.images.values(), key=lambda i: i.name)
    points = {int(key): p for p, key in enumerate(model.point_ids)}
    tracks = []
    for t, row in enumerate(rows):
        if row is None:
            continue
        image = images[row]
        camera = model.cameras[image.camera_id]
        pixels = image.xy * (poses.K[t, (0, 1), (0, 1)] / camera.K[(0, 1), (0, 1)])
        lens = lenses[t] if lenses else None
        if lens is not None:
            pixels = lens.resized(camera.width, camera.height).undistort(image.xy, poses.K[t])
        for (x, y), key in zip(pixels, image.point_ids, strict=True):
            if key >= 0 and int(key) in points:
                tracks.append((t, points[int(key)], x, y))
    return np.array(tracks, np.float64).reshape(-1, 4)
