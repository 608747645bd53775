"""Cameras, poses and static points as a COLMAP model in binary, as COLMAP's
documentation describes the format.

Scenes keep no tracks: a point counts as visible where it projects into a frame and
agrees with the frame's depth, and its keypoint is its projection.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

# relative difference of depth up to which a frame sees a point (hand-chosen)
MAX_DEPTH_DIFFERENCE = 0.1
MIN_DEPTH = 1e-6  # scene units: points nearer than that are behind the camera
SIMPLE_PINHOLE = 0  # numbers of COLMAP's camera models
PINHOLE = 1
GRAY = (128, 128, 128)  # the color of points, which scenes do not store


@dataclass(frozen=True)
class VisiblePoints:
    """The static points that one frame sees."""

    index: np.ndarray  # (n,) rows of the points
    xy: np.ndarray  # (n, 2) pixels
    depth: np.ndarray  # (n,) z-depth, scene units


def visible_points(
    points: np.ndarray, K: np.ndarray, c2w: np.ndarray, disparity: np.ndarray
) -> VisiblePoints:
    """The `points` (P, 3) that a camera with K (3, 3) and c2w (3, 4) sees.

    A point is seen where the camera's `disparity` (H, W) agrees with its depth.
    """
    height, width = disparity.shape
    local = (points - c2w[:, 3]) @ c2w[:, :3]  # (P, 3) in the camera's axes
    z = np.maximum(local[:, 2], 1e-9)
    xy = local[:, :2] / z[:, None] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    in_front = local[:, 2] > MIN_DEPTH
    in_picture = (xy >= 0).all(1) & (xy < [width, height]).all(1)
    rows = np.flatnonzero(in_front & in_picture)
    columns, lines = xy[rows].astype(int).T
    agrees = np.abs(disparity[lines, columns] * z[rows] - 1) < MAX_DEPTH_DIFFERENCE
    rows = rows[agrees]
    return VisiblePoints(rows, xy[rows], z[rows])


def model_files(
    names: Sequence[str],
    K: np.ndarray,
    c2w: np.ndarray,
    size: tuple[int, int],
    points: np.ndarray,
    views: Sequence[VisiblePoints],
) -> dict[str, bytes]:
    """cameras.bin, images.bin and points3D.bin of a model, by name.

    Frames `names` (N) have K (N, 3, 3) and c2w (N, 3, 4), are of `size` (H, W), and see
    the `views` (N) of `points` (P, 3).
    """
    camera_ids: dict[bytes, int] = {}  # intrinsics -> number, in order of appearance
    cameras = []
    for k in K:
        if k.tobytes() not in camera_ids:
            camera_ids[k.tobytes()] = len(camera_ids) + 1
            cameras.append(camera_record(len(camera_ids), k, size))
    images = []
    tracks: list[list[int]] = [[] for _ in points]  # image, keypoint, image, keypoint, ...
    for number, (name, k, pose, view) in enumerate(zip(names, K, c2w, views, strict=True), 1):
        images.append(image_record(number, name, pose, camera_ids[k.tobytes()], view))
        for keypoint, row in enumerate(view.index):
            tracks[row] += [number, keypoint]
    cloud = [
        point_record(number, point, track)
        for number, (point, track) in enumerate(zip(points, tracks, strict=True), 1)
    ]
    return {
        "cameras.bin": with_count(cameras),
        "images.bin": with_count(images),
        "points3D.bin": with_count(cloud),
    }


def with_count(records: Sequence[bytes]) -> bytes:
    """A file of records: their number, then all of them."""
    return struct.pack("<Q", len(records)) + b"".join(records)


def camera_record(number: int, K: np.ndarray, size: tuple[int, int]) -> bytes:
    """One camera of cameras.bin."""
    height, width = size
    fx, fy = K[0, 0], K[1, 1]
    center = K[:2, 2]
    if fx == fy:
        return struct.pack("<iiQQ3d", number, SIMPLE_PINHOLE, width, height, fx, *center)
    return struct.pack("<iiQQ4d", number, PINHOLE, width, height, fx, fy, *center)


def image_record(
    number: int, name: str, c2w: np.ndarray, camera_id: int, view: VisiblePoints
) -> bytes:
    """One image of images.bin, with its keypoints."""
    w2c = c2w[:, :3].T
    quaternion = np.roll(Rotation.from_matrix(w2c).as_quat(), 1)  # w, x, y, z
    record = struct.pack("<i7di", number, *quaternion, *(-w2c @ c2w[:, 3]), camera_id)
    record += name.encode() + b"\0" + struct.pack("<Q", len(view.index))
    keypoints = [
        struct.pack("<ddq", x, y, row + 1) for row, (x, y) in zip(view.index, view.xy, strict=True)
    ]
    return record + b"".join(keypoints)


def point_record(number: int, point: np.ndarray, track: list[int]) -> bytes:
    """One point of points3D.bin; reprojection errors are not known."""
    error = 0.0
    head = struct.pack("<Q3d3BdQ", number, *point.astype(np.float64), *GRAY, error, len(track) // 2)
    return head + struct.pack(f"<{len(track)}i", *track)
