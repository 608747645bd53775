"""A COLMAP model on disk: cameras, images and points3D, binary or text, as COLMAP's
documentation describes the format.

Poses in these files are world to camera, quaternions (w, x, y, z), OpenCV axes; pixel
centers at +0.5, like ours.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.core.errors import InputError

# model number -> name, number of parameters, whether fx and fy are one number
MODELS = {
    0: ("SIMPLE_PINHOLE", 3, True),
    1: ("PINHOLE", 4, False),
    2: ("SIMPLE_RADIAL", 4, True),
    3: ("RADIAL", 5, True),
    4: ("OPENCV", 8, False),
    5: ("OPENCV_FISHEYE", 8, False),
    6: ("FULL_OPENCV", 12, False),
    7: ("FOV", 5, False),
    8: ("SIMPLE_RADIAL_FISHEYE", 4, True),
    9: ("RADIAL_FISHEYE", 5, True),
    10: ("THIN_PRISM_FISHEYE", 12, False),
}
NUMBERS = {name: number for number, (name, _, _) in MODELS.items()}


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics of one camera."""

    model: str
    width: int
    height: int
    K: np.ndarray  # (3, 3) pixels
    distortion: np.ndarray  # what the model has beyond the pinhole


@dataclass(frozen=True)
class ColmapImage:
    """One registered image."""

    name: str
    camera_id: int
    c2w: np.ndarray  # (3, 4) OpenCV
    xy: np.ndarray  # (N, 2) keypoints, pixels
    point_ids: np.ndarray  # (N,) the 3D point each keypoint saw, -1 for none


@dataclass(frozen=True)
class ColmapModel:
    """One reconstruction."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    point_ids: np.ndarray  # (P,)
    points: np.ndarray  # (P, 3) world
    errors: np.ndarray  # (P,) mean reprojection error, pixels
    track_lengths: np.ndarray  # (P,) how many keypoints saw the point


def read_model(folder: Path | str) -> ColmapModel:
    """The COLMAP model in `folder` (cameras, images, points3D; .bin before .txt).
    InputError where a file is missing or cut short.
    """
    folder = Path(folder)
    parts: list[Any] = []
    for name, readers in {
        "cameras": (cameras_bin, cameras_txt),
        "images": (images_bin, images_txt),
        "points3D": (points_bin, points_txt),
    }.items():
        path = next(
            (p for p in (folder / f"{name}.bin", folder / f"{name}.txt") if p.is_file()), None
        )
        if path is None:
            raise InputError(
                f"{folder}: no {name}.bin or {name}.txt here; name the folder that COLMAP wrote (often sparse/0)"
            )
        try:
            with open(path, "rb") as file:
                parts.append(readers[path.suffix == ".txt"](file))
        except (
            struct.error,
            ValueError,
            IndexError,
            KeyError,
            UnicodeDecodeError,
            MemoryError,
            OverflowError,
        ) as error:
            raise InputError(
                f"{path}: not a readable COLMAP file, or cut short ({error}); export the model again"
            ) from error
    cameras, images, (ids, points, errors, lengths) = parts
    if not (np.isfinite(points).all() and np.isfinite(errors).all()):
        raise InputError(f"{folder}: points3D holds NaN or Inf; export the model again")
    lost = next((i for i in images.values() if i.camera_id not in cameras), None)
    if lost is not None:
        raise InputError(
            f"{folder}: image {lost.name} names camera {lost.camera_id}, which the model has not; export it again"
        )
    return ColmapModel(cameras, images, ids, points, errors, lengths)


def camera(model: str, width: int, height: int, params: np.ndarray) -> ColmapCamera:
    """A camera from its parameters in COLMAP's order: focal length(s), principal point,
    distortion.
    """
    count, single = MODELS[NUMBERS[model]][1:]
    if len(params) != count:
        raise ValueError(f"{model} has {count} parameters, found {len(params)}")
    fx, fy, cx, cy = (params[0], *params[:3]) if single else params[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return ColmapCamera(model, width, height, K, params[3:] if single else params[4:])


def pose(quaternion: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """c2w (3, 4) from COLMAP's world-to-camera quaternion (w, x, y, z) and translation."""
    w2c = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    return np.concatenate([w2c.T, -w2c.T @ translation[:, None]], 1)


def take(file: BinaryIO, layout: str) -> tuple:
    """The next values of a little-endian file; struct.error at its end."""
    return struct.unpack("<" + layout, file.read(struct.calcsize("<" + layout)))


def block(file: BinaryIO, count: int, dtype: np.dtype) -> np.ndarray:
    """The next `count` records."""
    data = file.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise ValueError(f"expected {count} more records")
    return np.frombuffer(data, dtype)


def cameras_bin(file: BinaryIO) -> dict[int, ColmapCamera]:
    """cameras.bin."""
    cameras = {}
    for _ in range(take(file, "Q")[0]):
        key, number, width, height = take(file, "iiQQ")
        name, count, _ = MODELS[number]
        cameras[key] = camera(name, width, height, np.array(take(file, f"{count}d")))
    return cameras


def images_bin(file: BinaryIO) -> dict[int, ColmapImage]:
    """images.bin."""
    images = {}
    keypoint = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    for _ in range(take(file, "Q")[0]):
        key, *values, camera_id = take(file, "i7di")
        name = bytearray()
        while (byte := take(file, "c")[0]) != b"\0":
            name += byte
        seen = block(file, take(file, "Q")[0], keypoint)
        c2w = pose(np.array(values[:4]), np.array(values[4:]))
        images[key] = ColmapImage(
            name.decode(), camera_id, c2w, seen["xy"].copy(), seen["point"].copy()
        )
    return images


def points_bin(file: BinaryIO) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """points3D.bin: identities (P,), positions (P, 3), errors (P,), track lengths (P,)."""
    rows = []
    for _ in range(take(file, "Q")[0]):
        key, x, y, z, error, length = take(file, "Q3d3xdQ")
        block(file, length, np.dtype("<i4,<i4"))
        rows.append((key, x, y, z, error, length))
    return columns(rows)


def columns(rows: list[tuple]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rows (identity, x, y, z, error, length) as arrays."""
    table = np.array(rows, np.float64).reshape(-1, 6)
    return table[:, 0].astype(np.int64), table[:, 1:4], table[:, 4], table[:, 5].astype(np.int64)


def lines(file: BinaryIO) -> list[list[str]]:
    """The words of every line that is not a comment; empty lines (an image without
    keypoints) stay, but not at the end.
    """
    text = file.read().decode()
    return [line.split() for line in text.rstrip("\n").split("\n") if not line.startswith("#")]


def cameras_txt(file: BinaryIO) -> dict[int, ColmapCamera]:
    """cameras.txt."""
    return {
        int(w[0]): camera(w[1], int(w[2]), int(w[3]), np.array(w[4:], np.float64))
        for w in lines(file)
        if w
    }


def images_txt(file: BinaryIO) -> dict[int, ColmapImage]:
    """images.txt: two lines an image."""
    rows = lines(file)
    rows += [[]] * (len(rows) % 2)  # the last image may have no keypoints and no line for them
    images = {}
    for head, seen in zip(rows[::2], rows[1::2], strict=True):
        if not head:
            continue
        values = np.array(head[1:8], np.float64)
        table = np.array(seen, np.float64).reshape(-1, 3)
        name = " ".join(head[9:])
        images[int(head[0])] = ColmapImage(
            name,
            int(head[8]),
            pose(values[:4], values[4:]),
            table[:, :2],
            table[:, 2].astype(np.int64),
        )
    return images


def points_txt(file: BinaryIO) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """points3D.txt."""
    return columns(
        [(int(w[0]), *map(float, w[1:4]), float(w[7]), (len(w) - 8) // 2) for w in lines(file) if w]
    )
