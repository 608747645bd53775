"""Pinhole cameras as numpy arrays: projection, unprojection, and transfer of pixels
from one view to another.

Conventions: OpenCV axes (+x right, +y down, +z forward); pixels are (x, y) with centers
at +0.5; depth is z-depth and disparity is 1 / z-depth. A camera is `K` (..., 3, 3) in
pixels and `c2w` (..., 3, 4), camera to world in scene units, without lens distortion.
Leading shapes of points, `K` and `c2w` broadcast. The relations are those of Hartley
and Zisserman 2004, chapters 6 and 13. `geometry.cameras.Camera` is the torch twin.
"""

from __future__ import annotations

import numpy as np

# scene units: points nearer than this, or behind the camera, project from this depth
MIN_DEPTH = 1e-6


def intrinsics(focal: float, width: int, height: int) -> np.ndarray:
    """K (3, 3) of a focal length in pixels, the principal point in the middle."""
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def pixel_centers(height: int, width: int) -> np.ndarray:
    """The center of every pixel, (H, W, 2)."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], -1)


def homogeneous(pixels: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) as (x, y, 1): (..., 3)."""
    return np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1)


def to_camera(points: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """World `points` (..., 3) in camera coordinates (..., 3)."""
    return np.einsum("...ji,...j->...i", c2w[..., :3], points - c2w[..., 3])


def to_world(local: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """Points `local` (..., 3) in camera coordinates as world points (..., 3)."""
    return np.einsum("...ij,...j->...i", c2w[..., :3], local) + c2w[..., 3]


def to_pixels(local: np.ndarray, K: np.ndarray, min_depth: float = MIN_DEPTH) -> np.ndarray:
    """Pixels (..., 2) of points `local` (..., 3) in camera coordinates. Points nearer
    than `min_depth` or behind the camera project through `min_depth`.
    """
    image_plane = local[..., :2] / np.maximum(local[..., 2:], min_depth)
    return np.einsum("...ij,...j->...i", K[..., :2, :], homogeneous(image_plane))


def camera_rays(pixels: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Directions (..., 3) through `pixels` (..., 2) in camera coordinates, one unit of
    z-depth long.
    """
    return np.einsum("...ij,...j->...i", np.linalg.inv(K), homogeneous(pixels))


def world_rays(pixels: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """Directions (..., 3) through `pixels` (..., 2) in world coordinates, one unit of
    z-depth long.
    """
    return np.einsum("...ij,...j->...i", c2w[..., :3], camera_rays(pixels, K))


def project(
    points: np.ndarray, K: np.ndarray, c2w: np.ndarray, min_depth: float = MIN_DEPTH
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) and z-depths (...) of world `points` (..., 3).

    Points behind the camera project through `min_depth`; test the returned depth before
    using their pixels.
    """
    local = to_camera(points, c2w)
    return to_pixels(local, K, min_depth), local[..., 2]


def unproject(pixels: np.ndarray, depth: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """World points (..., 3) at z-depth (...) behind `pixels` (..., 2)."""
    return to_world(camera_rays(pixels, K) * depth[..., None], c2w)


def transfer(
    K_from: np.ndarray, c2w_from: np.ndarray, K_to: np.ndarray, c2w_to: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How pixels of one view fall into another: `A` (..., 3, 3) and `b` (..., 3).

    Pixel (x, y) at disparity d falls on the homogeneous `A (x, y, 1) + d b`, whose
    third entry is the z-depth in the other view times d (the plane-induced homography
    of Hartley and Zisserman 2004, eq. 13.2, written per disparity).
    """
    to_image = K_to @ np.swapaxes(c2w_to[..., :3], -1, -2)
    rotation = to_image @ c2w_from[..., :3] @ np.linalg.inv(K_from)
    baseline = c2w_from[..., 3] - c2w_to[..., 3]
    shift = np.einsum("...ij,...j->...i", to_image, baseline)
    return rotation, shift
