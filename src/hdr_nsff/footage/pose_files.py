"""Poses that other programs estimated, brought to the frames of a clip.

A file or folder in one of the formats of `pose_formats.py` lists poses of pictures;
here they are matched to the frames by name or order, and rescaled to their size.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.colmap import ColmapModel, read_model
from hdr_nsff.footage.pose_formats import (
    GivenPoses,
    common_lens,
    distorted,
    from_colmap,
    from_json,
    from_llff,
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
MIN_TRACKED_POINTS = 10  # from which near and far are taken from the points
Parallax = Literal["full", "rotation", "none"]
NAMES = ("transforms.json", "transforms_train.json", "poses_bounds.npy", "precomputed.json")


def import_poses(
    path: Path | str, sources: list[str], size: tuple[int, int], lens: Lens | None = None
) -> Poses:
    """Poses of the frames named `sources` (T) from `path`, for `size` (height, width).

    Frames are matched by file name, or in order where no name fits and the numbers do.
    `path` is a file, or a folder that holds one of the known ones. Where frames were
    undistorted, `lens` is what distorted them. InputError where it cannot be read, does
    not fit, or has fewer poses than six frames in ten.
    """
    path = locate(Path(path))
    given, model = read_given(path)
    rows = match_frames(path, given.names, len(given.c2w), sources)
    poses = fit_poses(path, given, rows, size, lens)
    if model is not None:
        poses = with_points(poses, model, rows, lens)
    if all(row is not None for row in rows):
        return poses
    folders = [str(Path(source).parent) for source in sources]
    cameras = [
        [t for t, folder in enumerate(folders) if folder == camera]
        for camera in sorted(set(folders))
    ]
    return interpolate(poses, cameras)


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

    By the longest ending of the path that distinguishes pictures, else in order.
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
    if count != len(sources):
        raise InputError(
            f"{path}: {count} poses for {len(sources)} frames, and no file name fits; "
            "give one pose per used frame"
        )
    return list(range(count))


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
    lens: Lens | None = None,
) -> Poses:
    """The poses `rows` (T) of `given`, for frames of `size` (height, width) that were
    freed of the distortion of `lens`.

    A row of None is a frame without a pose. InputError, which names `path`, for poses
    that make no sense or are for frames of another shape.
    """
    check_given(path, given)
    first = next(row for row in rows if row is not None)
    K = np.stack([scaled_intrinsics(path, given, first if r is None else r, size) for r in rows])
    if lens is not None:
        height, width = size
        K[:] = lens.resized(width, height).pinhole()
    elif (found := common_lens(path, given)) is not None:
        raise distorted(path, found.max_displacement_px())
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


def check_given(path: Path, given: GivenPoses) -> None:
    """InputError for poses with numbers that cannot be."""
    if not all(np.abs(v).max() <= MAX_NUMBER for v in (given.K, given.c2w, given.size)):
        raise InputError(
            f"{path}: poses hold NaN, Inf or numbers beyond {MAX_NUMBER:g}; export them again"
        )
    if given.size[:, 0].min() <= 0:
        raise InputError(f"{path}: poses are for frames without width; export them again")


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
    poses: Poses, model: ColmapModel, rows: Sequence[int | None], lens: Lens | None = None
) -> Poses:
    """`poses` with the static points of a COLMAP model, and near and far from those.

    `rows` (T) are the images of the frames in the order of their names; `lens` what
    distorted their keypoints.
    """
    tracks = tracks_of(poses, model, rows, lens)
    shrink = poses.K[0, 0, 0] / next(iter(model.cameras.values())).K[0, 0]
    errors = model.errors * shrink  # in pixels of the frames
    poses = trusted_points(replace(poses, points=model.points, point_errors=errors, tracks=tracks))
    if len(poses.tracks) < MIN_TRACKED_POINTS:
        return poses
    frames = poses.tracks[:, 0].astype(int)
    seen = poses.points[poses.tracks[:, 1].astype(int)]
    _, depth = project(poses, frames, seen)
    near = float(0.7 * np.percentile(depth, 1))
    far = float(1.3 * np.percentile(depth, 99))
    return replace(poses, near=near, far=far)


def tracks_of(
    poses: Poses, model: ColmapModel, rows: Sequence[int | None], lens: Lens | None
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
        if lens is not None:
            pixels = lens.resized(camera.width, camera.height).undistort(image.xy, poses.K[t])
        for (x, y), key in zip(pixels, image.point_ids, strict=True):
            if key >= 0 and int(key) in points:
                tracks.append((t, points[int(key)], x, y))
    return np.array(tracks, np.float64).reshape(-1, 4)
