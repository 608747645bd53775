"""A COLMAP model on disk: cameras, images and points3D, binary or text, as COLMAP's
documentation describes the format.

Poses in these files are world to camera, quaternions (w, x, y, z), OpenCV axes; pixel
centers are at +0.5, as everywhere here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.core.errors import InputError, shorten


class CameraModel(NamedTuple):
    """One of COLMAP's camera models."""

    name: str
    num_params: int
    single_focal: bool  # fx and fy are one number


MODELS = {  # by the number that binary files have
    0: CameraModel("SIMPLE_PINHOLE", 3, True),
    1: CameraModel("PINHOLE", 4, False),
    2: CameraModel("SIMPLE_RADIAL", 4, True),
    3: CameraModel("RADIAL", 5, True),
    4: CameraModel("OPENCV", 8, False),
    5: CameraModel("OPENCV_FISHEYE", 8, False),
    6: CameraModel("FULL_OPENCV", 12, False),
    7: CameraModel("FOV", 5, False),
    8: CameraModel("SIMPLE_RADIAL_FISHEYE", 4, True),
    9: CameraModel("RADIAL_FISHEYE", 5, True),
    10: CameraModel("THIN_PRISM_FISHEYE", 12, False),
}
MODELS_BY_NAME = {model.name: model for model in MODELS.values()}
# what the readers below raise for a file that is damaged or cut short
UNREADABLE = (struct.error, ValueError, IndexError, KeyError, MemoryError, OverflowError)
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
TRACK_ELEMENT = np.dtype("<i4,<i4")  # image, keypoint


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics of one camera."""

    model: str
    width: int
    height: int
    K: np.ndarray  # (3, 3) pixels
    distortion: np.ndarray  # the parameters of the model beyond the pinhole


@dataclass(frozen=True)
class ColmapImage:
    """One registered image."""

    name: str
    camera_id: int
    c2w: np.ndarray  # (3, 4) OpenCV
    xy: np.ndarray  # (N, 2) keypoints, pixels
    point_ids: np.ndarray  # (N,) the 3D point of each keypoint, -1 for none


@dataclass(frozen=True)
class ColmapModel:
    """One reconstruction."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    point_ids: np.ndarray  # (P,)
    points: np.ndarray  # (P, 3) world
    errors: np.ndarray  # (P,) mean reprojection error, pixels
    track_lengths: np.ndarray  # (P,) number of keypoints that saw the point


# id, x, y, z, error, track length
PointRow = tuple[int, float, float, float, float, int]


def read_model(folder: Path | str) -> ColmapModel:
    """The COLMAP model in `folder`: cameras, images, points3D; .bin before .txt.

    InputError where a file is missing, damaged or cut short.
    """
    folder = Path(folder)
    cameras = read_part(folder, "cameras", cameras_bin, cameras_txt)
    images = read_part(folder, "images", images_bin, images_txt)
    rows = read_part(folder, "points3D", points_bin, points_txt)
    table = np.array(rows, np.float64).reshape(-1, 6)
    if not np.isfinite(table).all():
        raise InputError(f"{folder}: points3D holds NaN or Inf; export the model again")
    lost = next((i for i in images.values() if i.camera_id not in cameras), None)
    if lost is not None:
        raise InputError(
            f"{folder}: image {shorten(lost.name)} names camera {lost.camera_id}, "
            "which the model does not have; export it again"
        )
    return ColmapModel(
        cameras,
        images,
        point_ids=table[:, 0].astype(np.int64),
        points=table[:, 1:4],
        errors=table[:, 4],
        track_lengths=table[:, 5].astype(np.int64),
    )


def read_part(
    folder: Path,
    name: str,
    read_bin: Callable[[BinaryIO], Any],
    read_txt: Callable[[BinaryIO], Any],
) -> Any:
    """One of the three files of a model; InputError where that is not possible."""
    path = folder / f"{name}.bin"
    read = read_bin
    if not path.is_file():
        path = folder / f"{name}.txt"
        read = read_txt
    if not path.is_file():
        raise InputError(
            f"{folder}: no {name}.bin or {name}.txt here; "
            "name the folder that COLMAP wrote (often sparse/0)"
        )
    try:
        with open(path, "rb") as file:
            return read(file)
    except UNREADABLE as error:
        raise InputError(
            f"{path}: not a readable COLMAP file, or cut short ({shorten(error)}); "
            "export the model again"
        ) from error


def make_camera(model: CameraModel, width: int, height: int, params: np.ndarray) -> ColmapCamera:
    """A camera from its parameters in COLMAP's order.

    These are focal length(s), principal point, distortion. ValueError where their
    number is wrong.
    """
    if len(params) != model.num_params:
        raise ValueError(f"{model.name} has {model.num_params} parameters, found {len(params)}")
    if model.single_focal:
        params = np.concatenate([params[:1], params])  # fx, fy, cx, cy, distortion
    fx, fy, cx, cy = params[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return ColmapCamera(model.name, width, height, K, distortion=params[4:])


def make_pose(quaternion: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """c2w (3, 4) from a world-to-camera quaternion (w, x, y, z) and translation."""
    w2c = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    return np.concatenate([w2c.T, -w2c.T @ translation[:, None]], 1)


# Binary


def unpack(file: BinaryIO, layout: str) -> tuple:
    """The next values of a little-endian file; struct.error at its end."""
    layout = "<" + layout
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def read_records(file: BinaryIO, count: int, dtype: np.dtype) -> np.ndarray:
    """The next `count` records; ValueError where the file ends before."""
    data = file.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise ValueError(f"expected {count} more records")
    return np.frombuffer(data, dtype)


def cameras_bin(file: BinaryIO) -> dict[int, ColmapCamera]:
    """The cameras of cameras.bin."""
    cameras = {}
    (count,) = unpack(file, "Q")
    for _ in range(count):
        key, number, width, height = unpack(file, "iiQQ")
        model = MODELS[number]
        params = np.array(unpack(file, f"{model.num_params}d"))
        cameras[key] = make_camera(model, width, height, params)
    return cameras


def images_bin(file: BinaryIO) -> dict[int, ColmapImage]:
    """The images of images.bin."""
    images = {}
    (count,) = unpack(file, "Q")
    for _ in range(count):
        key, *values, camera_id = unpack(file, "i7di")
        name = read_name(file)
        (keypoint_count,) = unpack(file, "Q")
        keypoints = read_records(file, keypoint_count, KEYPOINT)
        c2w = make_pose(np.array(values[:4]), np.array(values[4:]))
        images[key] = ColmapImage(
            name, camera_id, c2w, keypoints["xy"].copy(), keypoints["point"].copy()
        )
    return images


def read_name(file: BinaryIO) -> str:
    """The next text that ends with a zero byte."""
    name = bytearray()
    while True:
        (byte,) = unpack(file, "c")
        if byte == b"\0":
            return name.decode()
        name += byte


def points_bin(file: BinaryIO) -> list[PointRow]:
    """The points of points3D.bin."""
    rows = []
    (count,) = unpack(file, "Q")
    for _ in range(count):
        key, x, y, z, error, length = unpack(file, "Q3d3xdQ")  # 3x: the color
        read_records(file, length, TRACK_ELEMENT)
        rows.append((key, x, y, z, error, length))
    return rows


# Text


def read_lines(file: BinaryIO) -> list[list[str]]:
    """The words of every line that is not a comment.

    Empty lines (an image without keypoints) stay, but not at the end.
    """
    text = file.read().decode().rstrip("\n")
    return [line.split() for line in text.split("\n") if not line.startswith("#")]


def cameras_txt(file: BinaryIO) -> dict[int, ColmapCamera]:
    """The cameras of cameras.txt."""
    cameras = {}
    for words in read_lines(file):
        if words:
            model = MODELS_BY_NAME[words[1]]
            width = int(words[2])
            height = int(words[3])
            params = np.array(words[4:], np.float64)
            cameras[int(words[0])] = make_camera(model, width, height, params)
    return cameras


def images_txt(file: BinaryIO) -> dict[int, ColmapImage]:
    """The images of images.txt: two lines an image."""
    rows = read_lines(file)
    if len(rows) % 2:
        rows.append([])  # the last image may have no keypoints and no line for them
    images = {}
    for head, keypoints in zip(rows[::2], rows[1::2], strict=True):
        if not head:
            continue
        values = np.array(head[1:8], np.float64)
        table = np.array(keypoints, np.float64).reshape(-1, 3)
        images[int(head[0])] = ColmapImage(
            name=" ".join(head[9:]),
            camera_id=int(head[8]),
            c2w=make_pose(values[:4], values[4:]),
            xy=table[:, :2],
            point_ids=table[:, 2].astype(np.int64),
        )
    return images


def points_txt(file: BinaryIO) -> list[PointRow]:
    """The points of points3D.txt."""
    rows = []
    for words in read_lines(file):
        if words:
            x, y, z = (float(word) for word in words[1:4])
            track_length = (len(words) - 8) // 2
            rows.append((int(words[0]), x, y, z, float(words[7]), track_length))
    return rows


def views_of_images(model: ColmapModel) -> dict[int, ColmapImage]:
    """The registered image of each view, whose number is in its file name."""
    return {int(image.name[:5]): image for image in model.images.values()}
