"""Painted clips of known flow: a wall, a square before it, a camera that slides."""

import cv2
import numpy as np

from hdr_nsff.geometry.pinhole import pixel_centers

T, H, W, FOCAL = 8, 72, 96, 80.0
SIZE = 20  # of the square, pixels
K = np.array([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1.0]])
STEP = 0.1  # of the camera per frame, scene units
WALL = 4.0  # its depth, scene units
SPEED = FOCAL * STEP / WALL  # of the wall, 2 px per frame to the left


def cameras(step: float = STEP) -> np.ndarray:
    """A camera that moves `step` to the right per frame: c2w (T, 3, 4)."""
    c2w = np.tile(np.eye(4)[:3], (T, 1, 1))
    c2w[:, 0, 3] = step * np.arange(T)
    return c2w


def texture(seed: int, height: int = H, width: int = 3 * W) -> np.ndarray:
    """Smooth noise (height, width) in [0, 1]."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).random((height, width)), (0, 0), 1.5)
    return ((noise - noise.min()) / np.ptp(noise)).astype(np.float32)


def corners(kind: str) -> np.ndarray:
    """The square's upper left corner in each frame (T, 2) px.

    "rising" moves up; "along" moves along the epipolar lines as no depth explains;
    "near" is at rest at half the wall's depth.
    """
    t = np.arange(T)
    x = {"rising": 60 - 2.0 * t, "along": 30 + 4.0 * t, "near": 60 - 2 * SPEED * t}[kind]
    y = 40 - 3.0 * t if kind == "rising" else np.full(T, 26.0)
    return np.stack([x, y], 1).round()


def painted_clip(kind: str, speed: float = SPEED) -> tuple[np.ndarray, ...]:
    """Flow, valid, pairs, video and the square's mask (T, H, W)."""
    wall, square = texture(0), texture(1, SIZE, SIZE)
    corner = corners(kind).astype(int)
    video, truth = np.zeros((T, H, W, 3), np.float32), np.zeros((T, H, W), bool)
    for t in range(T):
        shift = np.array([[1, 0, -speed * t], [0, 1, 0]], np.float32)
        video[t] = cv2.warpAffine(wall, shift, (W, H), borderMode=cv2.BORDER_REFLECT)[..., None]
        x, y = corner[t]
        left, top = np.maximum(corner[t], 0)
        visible = square[top - y : H - y, left - x : W - x]
        video[t, top : y + SIZE, left : x + SIZE] = visible[..., None]
        truth[t, top : y + SIZE, left : x + SIZE] = True
    pairs = np.array([(i, j) for i in range(T) for j in (i - 1, i + 1) if 0 <= j < T])
    flow, valid = np.zeros((len(pairs), H, W, 2), np.float32), np.zeros((len(pairs), H, W), bool)
    for p, (i, j) in enumerate(pairs):
        flow[p, ..., 0] = -speed * (j - i)
        flow[p][truth[i]] = corner[j] - corner[i]
        end = np.floor(pixel_centers(H, W) + flow[p]).astype(int)
        inside = ((end >= 0) & (end < (W, H))).all(-1)
        end_x, end_y = end[inside].T
        valid[p] = inside
        valid[p][inside] &= truth[i][inside] == truth[j][end_y, end_x]  # not covered there
    return flow, valid, pairs, video, truth
