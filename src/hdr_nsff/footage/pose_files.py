"""Poses made elsewhere: a COLMAP model, `transforms.json` (nerfstudio, Blender),
`poses_bounds.npy` (LLFF) or the JSON of LLFF poses that non-rigid NeRF publishes. Every
convention becomes ours here: c2w OpenCV (+x right, +y down, +z forward), pixels of the
working size with centers at +0.5. The world and its units stay the giver's.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.footage.arrays import read_array
from hdr_nsff.footage.colmap import ColmapCamera, ColmapModel, read_model
from hdr_nsff.geometry.poses import LEAST, Poses, interpolate, project, ranges, trusted_points
from hdr_nsff.scene.scene import LARGEST

FROM_OPENGL = np.diag([1.0, -1.0, -1.0])  # columns right, up, back -> right, down, forward
FROM_LLFF = np.array(
    [[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]
)  # columns down, right, back -> right, down, forward
ROUNDING = 1e-6  # off which a rotation is made one again
BENT = 2.0  # pixels of lens distortion at a corner that a pinhole may stand in for
Parallax = Literal["full", "rotation", "none"]
# what Python and numpy raise for JSON values of another shape or size than expected
UNREADABLE = (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError)
NAMES = ("transforms.json", "transforms_train.json", "poses_bounds.npy", "precomputed.json")


@dataclass(frozen=True)
class Given:
    """Poses as a file has them, in its own order."""

    names: list[str] | None  # image file names, None: only the order counts
    K: np.ndarray  # (N, 3, 3) pixels of `size`
    c2w: np.ndarray  # (N, 3, 4) OpenCV
    size: np.ndarray  # (N, 2) width, height that K is for
    near: float | None = None
    far: float | None = None


def import_poses(path: Path | str, sources: list[str], size: tuple[int, int]) -> Poses:
    """Poses of the frames named `sources` (T) from `path`, for frames of `size`
    (height, width).

    Frames are matched by file name, or in order where no name fits and the numbers do.
    `path` is a file, or a folder that holds one of the known ones. InputError where it
    cannot be read, does not fit, or has fewer poses than six frames in ten.
    """
    path = locate(Path(path))
    model = None
    if path.is_dir():
        model = read_model(path)
        given = from_colmap(path, model)
    elif path.suffix == ".npy":
        given = from_llff(path)
    else:
        given = from_json(path)
    chosen = arrange(path, given.names, len(given.c2w), sources)
    poses = placed(path, given, chosen, size)
    if model is not None:
        poses = with_points(poses, model, chosen)
    missing = [t for t, k in enumerate(chosen) if k is None]
    cameras = sorted({str(Path(s).parent) for s in sources})
    groups = [[t for t, s in enumerate(sources) if str(Path(s).parent) == c] for c in cameras]
    return interpolate(poses, groups) if missing else poses


def locate(path: Path) -> Path:
    """The file, or the folder of a COLMAP model, that `path` means."""
    if path.is_file():
        if path.suffix not in (".json", ".npy"):
            raise InputError(
                f"{path}: poses come as a COLMAP folder, transforms.json, poses_bounds.npy or precomputed.json"
            )
        return path
    if not path.is_dir():
        raise InputError(f"{path}: no such file or folder of poses")
    for folder in (path, path / "sparse" / "0", path / "sparse", path / "0"):
        if any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    for name in NAMES:
        if (path / name).is_file():
            return path / name
    raise InputError(
        f"{path}: no poses here; expected a COLMAP model (cameras, images, points3D) or one of {', '.join(NAMES)}"
    )


def from_colmap(path: Path, model: ColmapModel) -> Given:
    """The poses of a COLMAP model, by image name."""
    if not model.images:
        raise InputError(f"{path}: the COLMAP model has no registered images; map again")
    images = sorted(model.images.values(), key=lambda i: i.name)
    cameras = [model.cameras[i.camera_id] for i in images]
    for c in {id(c): c for c in cameras}.values():
        check_lens(path, c.K, c.width, c.height, colmap_distortion(path, c))
    return Given(
        names=[i.name for i in images],
        K=np.stack([c.K for c in cameras]),
        c2w=np.stack([i.c2w for i in images]),
        size=np.array([(c.width, c.height) for c in cameras]),
    )


def colmap_distortion(path: Path, camera: ColmapCamera) -> np.ndarray:
    """k1, k2, p1, p2 of OpenCV's model. InputError for models beyond it, unless nothing
    is distorted.
    """
    values = camera.distortion
    if camera.model in (
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
    ) or not np.any(values):
        return np.pad(values, (0, 4))[:4]
    raise InputError(
        f"{path}: camera model {camera.model} bends rays; undistort the frames (colmap image_undistorter) and export again"
    )


def check_lens(
    path: Path, K: np.ndarray, width: float, height: float, distortion: np.ndarray
) -> None:
    """InputError where leaving out the `distortion` (k1, k2, p1, p2) would misplace a
    corner by more than `BENT` pixels.
    """
    k1, k2, p1, p2 = (float(v) for v in distortion)
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)])
    with np.errstate(all="ignore"):  # impossible numbers are refused later
        x, y = ((corners - K[:2, 2]) / K[(0, 1), (0, 1)]).T
        r2 = x * x + y * y
        radial = k1 * r2 + k2 * r2 * r2
        dx = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        worst = np.hypot(dx * K[0, 0], dy * K[1, 1]).max()
    if worst > BENT:
        raise InputError(
            f"{path}: lens distortion moves corners by {worst:.0f} px; undistort the frames (colmap image_undistorter) and export again"
        )


def from_llff(path: Path) -> Given:
    """`poses_bounds.npy` (N, 17): 3x5 row by row (columns down, right, back, center,
    (height, width, focal)), then near, far.
    """
    return llff_rows(llff_table(path, 17))


def llff_table(path: Path, columns: int) -> np.ndarray:
    """The numbers (N, columns) of a `.npy` in the way of LLFF."""
    table = read_array(path, np.float64)
    if table.ndim != 2 or table.shape[1] != columns or not len(table):
        raise InputError(
            f"{path}: expected an array (frames, {columns}) as LLFF writes it, found {table.shape}"
        )
    return table


def llff_rows(table: np.ndarray) -> Given:
    """The poses of rows (N, 17) of `poses_bounds.npy`."""
    return llff(
        table[:, :15].reshape(-1, 3, 5),
        table[:, 15:],
        FROM_LLFF,
    )


def llff(poses: np.ndarray, bounds: np.ndarray, columns: np.ndarray) -> Given:
    """From (N, 3, 5) matrices and (N, 2) depth bounds; `columns` turns the first three
    columns into ours.
    """
    height, width, focal = poses[:, :, 4].T
    K = np.zeros((len(poses), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = focal
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = width / 2, height / 2, 1
    c2w = np.concatenate([poses[:, :, :3] @ columns, poses[:, :, 3:4]], 2)
    # a single stray point makes a bound of one frame useless: not the minimum, as is
    # usual, but what nine frames in ten agree on
    near, far = 0.8 * np.percentile(bounds[:, 0], 10), 1.25 * np.percentile(bounds[:, 1], 90)
    fits = bool(np.isfinite(bounds).all() and 0 < near < far)
    return Given(
        None,
        K,
        c2w,
        np.stack([width, height], 1),
        float(near) if fits else None,
        float(far) if fits else None,
    )


def from_json(path: Path) -> Given:
    """`transforms.json`, or the JSON with `poses` and `bds` of non-rigid NeRF (LLFF's
    matrices with columns right, up, back).
    """
    try:
        document = read_json(path)
        if isinstance(document, dict) and "frames" in document:
            return from_transforms(path, document)
        if isinstance(document, dict) and "poses" in document and "bds" in document:
            poses = np.array(document["poses"], np.float64).reshape(-1, 3, 5)
            return llff(
                poses, np.array(document["bds"], np.float64).reshape(len(poses), 2), FROM_OPENGL
            )
    except InputError:
        raise
    except UNREADABLE as error:
        raise unreadable(path, error) from error
    raise InputError(
        f"{path}: neither `frames` (transforms.json) nor `poses` and `bds` in it; export the poses again"
    )


def unreadable(path: Path, error: Exception) -> InputError:
    """What to say of a JSON whose poses are of another shape than they should."""
    problem = f"{type(error).__name__}: {shorten(error)}"
    return InputError(f"{path}: not readable as poses ({problem}); export them again")


def from_transforms(path: Path, document: dict[str, Any]) -> Given:
    """nerfstudio's and Blender's layout: `transform_matrix` c2w with OpenGL axes,
    intrinsics for all or per frame.
    """
    try:
        return parse_transforms(path, document)
    except InputError:
        raise
    except UNREADABLE as error:
        raise unreadable(path, error) from error


def parse_transforms(path: Path, document: dict[str, Any]) -> Given:
    """The same, with the exceptions `UNREADABLE` for values of another shape."""
    frames = document["frames"]
    if not frames:
        raise InputError(f"{path}: no frames in it; export the poses again")
    lenses = [lens(path, {**document, **frame}) for frame in frames]
    matrices = np.array([frame["transform_matrix"] for frame in frames], np.float64)[:, :3]
    c2w = np.concatenate([matrices[:, :, :3] @ FROM_OPENGL, matrices[:, :, 3:4]], 2)
    near, far = (None if v is None else float(v) for v in map(document.get, ("near", "far")))
    if not (near or 1 / LARGEST) <= (far or LARGEST) <= LARGEST or (near or 0) < 0:
        raise InputError(f"{path}: near {near} and far {far} are no range of depths; correct them")
    return Given(
        names=[str(frame["file_path"]) for frame in frames],
        K=np.stack([K for K, _ in lenses]),
        c2w=c2w,
        size=np.array([size for _, size in lenses], np.float64),
        near=near,
        far=far,
    )


def lens(path: Path, values: dict[str, Any]) -> tuple[np.ndarray, tuple[float, float]]:
    """K (3, 3) and the size (width, height) it is for, from the keys of one frame.
    Without a size the unit is the frame's width.
    """
    if "fl_x" in values:
        fx, fy = float(values["fl_x"]), float(values.get("fl_y", values["fl_x"]))
        width = float(values.get("w", 2 * float(values.get("cx", 0))))
        height = float(values.get("h", 2 * float(values.get("cy", 0))))
        if width <= 0 or height <= 0:
            raise InputError(
                f"{path}: `fl_x` without `w` and `h`: the size that the focal length is for is missing; add it"
            )
    elif "camera_angle_x" in values:
        width, height = float(values.get("w", 1)), float(values.get("h", 0))
        fx = width / 2 / math.tan(float(values["camera_angle_x"]) / 2)
        fy = (
            height / 2 / math.tan(float(values["camera_angle_y"]) / 2)
            if height and "camera_angle_y" in values
            else fx
        )
    else:
        raise InputError(f"{path}: neither `fl_x` nor `camera_angle_x`: no focal length; add one")
    cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    check_lens(
        path,
        K,
        width,
        height,
        np.array([float(values.get(k, 0)) for k in ("k1", "k2", "p1", "p2")]),
    )
    return K, (width, height)


def arrange(
    path: Path, names: list[str] | None, count: int, sources: list[str]
) -> list[int | None]:
    """Which given pose belongs to each of `sources`: by the longest ending of the path
    that tells them apart, else in order.
    """
    if names is not None:
        for key in (path_key(3), path_key(2), path_key(1)):
            have = {key(name): k for k, name in enumerate(names)}
            wanted = [key(source) for source in sources]
            if (
                len(have) == len(names)
                and len(set(wanted)) == len(wanted)
                and any(w in have for w in wanted)
            ):
                chosen = [have.get(w) for w in wanted]
                missing = [t for t, k in enumerate(chosen) if k is None]
                if len(missing) > (1 - LEAST) * len(sources):
                    raise InputError(
                        f"{path}: {len(missing)} of {len(sources)} frames have no pose there (frames {ranges(missing)}); "
                        "give poses for all of them"
                    )
                return chosen
    if count != len(sources):
        raise InputError(
            f"{path}: {count} poses for {len(sources)} frames, and no file name fits; give one pose per used frame"
        )
    return list(range(count))


def path_key(parts: int) -> Any:
    """A function from a file name to its last `parts` parts, without an image's ending."""
    return lambda name: tuple(
        re.sub(r"\.(png|jpe?g|tiff?|exr|dng)$", "", name.replace("\\", "/"), flags=re.I).split("/")[
            -parts:
        ]
    )


def placed(path: Path, given: Given, chosen: list[int | None], size: tuple[int, int]) -> Poses:
    """The chosen poses, rescaled to frames of `size` (height, width)."""
    if not all(np.abs(v).max() <= LARGEST for v in (given.K, given.c2w, given.size)):
        raise InputError(
            f"{path}: poses hold NaN, Inf or numbers beyond {LARGEST:g}; export them again"
        )
    if given.size[:, 0].min() <= 0:
        raise InputError(f"{path}: poses are for frames without width; export them again")
    height, width = size
    K, c2w = np.tile(np.eye(3), (len(chosen), 1, 1)), np.tile(np.eye(4)[:3], (len(chosen), 1, 1))
    for t, k in enumerate(chosen):
        source = next(k for k in chosen if k is not None) if k is None else k
        w, h = given.size[source]
        if h > 0 and abs(width / w / (height / h) - 1) > 0.02:
            raise InputError(
                f"{path}: poses are for {w:.0f}x{h:.0f} frames, these are {width}x{height}: another shape; give the same"
            )
        scale = np.array([width / w, height / h if h > 0 else width / w, 1])[:, None]
        K[t] = given.K[source] * scale
        if h <= 0:
            K[t, 1, 2] = height / 2
        if k is not None:
            c2w[t] = given.c2w[k]
    rotation = c2w[:, :, :3]
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) > ROUNDING
    u, _, vt = np.linalg.svd(rotation)
    if (np.linalg.det(c2w[:, :, :3]) <= 0).any() or (K[:, (0, 1), (0, 1)] <= 0).any():
        raise InputError(
            f"{path}: a pose is no rotation (mirrored or all zero), or a focal length is not positive; export them again"
        )
    c2w[off, :, :3] = (u @ vt)[off]
    registered = np.array([k is not None for k in chosen])
    centers = c2w[registered, :, 3]
    turns = np.abs(c2w[registered, :, :3] - c2w[registered][:1, :, :3]).max()
    moves = np.linalg.norm(centers - centers[:1], axis=1).max() > 1e-6 * (given.near or 1.0)
    parallax: Parallax = "full" if moves else ("rotation" if turns > 1e-6 else "none")
    return Poses(
        K,
        c2w,
        registered,
        parallax,
        near=given.near,
        far=given.far,
        notes=(f"poses given: {path.name}",),
    )


def with_points(poses: Poses, model: ColmapModel, chosen: list[int | None]) -> Poses:
    """With the model's static points and what the chosen images saw of them, near and
    far from those.
    """
    images = sorted(model.images.values(), key=lambda i: i.name)
    row = {int(key): r for r, key in enumerate(model.point_ids)}
    seen = []
    for t, k in enumerate(chosen):
        if k is None:
            continue
        camera = model.cameras[images[k].camera_id]
        scale = poses.K[t, (0, 1), (0, 1)] / camera.K[(0, 1), (0, 1)]
        has = [p >= 0 and int(p) in row for p in images[k].point_ids]
        seen += [
            (t, row[int(p)], *(xy * scale))
            for xy, p in zip(images[k].xy[has], images[k].point_ids[has], strict=True)
        ]
    tracks = np.array(seen, np.float64).reshape(-1, 4)
    shrink = poses.K[0, 0, 0] / next(iter(model.cameras.values())).K[0, 0]
    poses = trusted_points(
        replace(poses, points=model.points, point_errors=model.errors * shrink, tracks=tracks)
    )
    if len(poses.tracks) < 10:
        return poses
    depth = project(
        poses, poses.tracks[:, 0].astype(int), poses.points[poses.tracks[:, 1].astype(int)]
    )[1]
    return replace(
        poses, near=float(0.7 * np.percentile(depth, 1)), far=float(1.3 * np.percentile(depth, 99))
    )
