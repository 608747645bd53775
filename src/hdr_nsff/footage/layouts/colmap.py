"""Cameras, poses and static points as a COLMAP model in binary, as COLMAP's
documentation describes the format. Scenes keep no tracks: a point counts as seen where
it projects into a frame and the frame's depth agrees, and its keypoint is its
projection.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.core.io import atomic

AGREE = 0.1  # relative difference of depth up to which a frame sees a point
SIMPLE_PINHOLE, PINHOLE = 0, 1


@dataclass(frozen=True)
class Seen:
    """What one frame sees of the static points."""

    index: np.ndarray  # (n,) rows of the points
    xy: np.ndarray  # (n, 2) pixels
    depth: np.ndarray  # (n,) z-depth, scene units


def seen(points: np.ndarray, K: np.ndarray, c2w: np.ndarray, disparity: np.ndarray) -> Seen:
    """The `points` (P, 3) that a camera with `disparity` (H, W) sees."""
    local = (points - c2w[:, 3]) @ c2w[:, :3]
    z = np.maximum(local[:, 2], 1e-9)
    xy = local[:, :2] / z[:, None] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    height, width = disparity.shape
    inside = (local[:, 2] > 1e-6) & (xy >= 0).all(1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    rows = np.flatnonzero(inside)
    x, y = xy[rows].astype(int).T
    agrees = np.abs(disparity[y, x] * z[rows] - 1) < AGREE
    rows = rows[agrees]
    return Seen(rows, xy[rows], z[rows])


def write_model(
    folder: Path,
    names: Sequence[str],
    K: np.ndarray,
    c2w: np.ndarray,
    size: tuple[int, int],
    points: np.ndarray,
    views: Sequence[Seen],
) -> None:
    """Write cameras.bin, images.bin and points3D.bin: frames `names` (N) with K (N, 3,
    3) and c2w (N, 3, 4) of `size` (H, W).
    """
    kinds = {k.tobytes(): i for i, k in reversed(list(enumerate(K)))}
    ids = {key: number for number, key in enumerate(sorted(kinds, key=lambda key: kinds[key]), 1)}
    cameras = struct.pack("<Q", len(ids))
    for key, number in ids.items():
        cameras += camera(number, K[kinds[key]], size)
    images = bytearray(struct.pack("<Q", len(names)))
    tracks: list[list[int]] = [[] for _ in points]
    for i, (name, pose, view) in enumerate(zip(names, c2w, views, strict=True)):
        quaternion = np.roll(Rotation.from_matrix(pose[:, :3].T).as_quat(), 1)
        images += struct.pack(
            "<i7di", i + 1, *quaternion, *(-pose[:, :3].T @ pose[:, 3]), ids[K[i].tobytes()]
        )
        images += name.encode() + b"\0" + struct.pack("<Q", len(view.index))
        for k, (row, (x, y)) in enumerate(zip(view.index, view.xy, strict=True)):
            images += struct.pack("<ddq", x, y, row + 1)
            tracks[row] += [i + 1, k]
    cloud = bytearray(struct.pack("<Q", len(points)))
    for row, (point, track) in enumerate(zip(points.astype(np.float64), tracks, strict=True)):
        cloud += struct.pack(
            f"<Q3d3BdQ{len(track)}i", row + 1, *point, 128, 128, 128, 0.0, len(track) // 2, *track
        )
    for file, data in (("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", cloud)):
        with atomic(folder / file) as temporary:
            temporary.write_bytes(data)


def camera(number: int, K: np.ndarray, size: tuple[int, int]) -> bytes:
    """One camera of cameras.bin."""
    height, width = size
    if K[0, 0] == K[1, 1]:
        return struct.pack(
            "<iiQQ3d", number, SIMPLE_PINHOLE, width, height, K[0, 0], K[0, 2], K[1, 2]
        )
    return struct.pack(
        "<iiQQ4d", number, PINHOLE, width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    )
