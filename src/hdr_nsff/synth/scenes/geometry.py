"""Pinhole cameras and rotations as plain arrays: OpenCV axes (+x right, +y down, +z
forward), meters, pixel centers at +0.5.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.geometry import pinhole

FIELD_OF_VIEW = np.radians(57)  # across the picture, of every camera (hand-chosen)


def intrinsics(width: int, height: int) -> np.ndarray:
    """K (3, 3) in pixels of a camera that sees 57 degrees across."""
    focal = width / 2 / np.tan(FIELD_OF_VIEW / 2)
    return pinhole.intrinsics(focal, width, height)


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera to world (3, 4) at `eye`, +z towards `target`, level (+y of the world is
    down).
    """
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    return np.stack([x, y, z, eye], 1)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) about `axis` by `angle` radians (Rodrigues' formula)."""
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def back_project(depth: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """World points (H, W, 3) at z-depth (H, W) behind the pixel centers."""
    return pinhole.unproject(pinhole.pixel_centers(*depth.shape), depth, K, c2w)
