"""Textured planes before cameras that look along +z, in closed form.

Video, depth and flow of a clip are computed from its poses.
"""

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.scene.posed_video import PosedVideo

H, W, F = 48, 64, 60.0
K = np.array([[F, 0, W / 2], [0, F, H / 2], [0, 0, 1.0]])
Y, X = np.mgrid[:H, :W] + 0.5
RAYS = np.stack([(X - W / 2) / F, (Y - H / 2) / F], -1)  # (H, W, 2): x / z, y / z


def cameras_at(*eyes: tuple[float, float, float]) -> np.ndarray:
    """Cameras (T, 3, 4) at `eyes` that all look along +z."""
    return np.stack([np.concatenate([np.eye(3), np.array(e, float)[:, None]], 1) for e in eyes])


SWEEPING = cameras_at(*[(0.16 * (t - 3), 0.06 * np.sin(t), 0) for t in range(7)])


def oblique(count: int) -> PosedVideo:
    """Gray frames of cameras of unlike focal lengths, turned each in its own way."""
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(0.08 * rng.normal(size=(count, 3))).as_matrix()
    c2w = np.concatenate([turns, 0.15 * rng.normal(size=(count, 3, 1))], 2)
    own_K = K + np.array([[4.0, 0, -3], [0, -6, 2], [0, 0, 0]]) * rng.random((count, 1, 1))
    return replace(posed_video(c2w), K=own_K)


def texture(seed: int = 0) -> np.ndarray:
    """Smooth noise in [0.1, 0.9], 512 x 512."""
    noise = np.random.default_rng(seed).random((512, 512, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 2)
    return 0.1 + 0.8 * (noise - noise.min()) / np.ptp(noise)


def plane(c2w: np.ndarray, z0: float, slope: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Video (T, H, W, 3) and z-depth (T, H, W) of the plane z = z0 + slope x."""
    video, depth = [], []
    for ex, ey, ez in c2w[:, :, 3]:
        z = (z0 + slope * ex - ez) / (1 - slope * RAYS[..., 0])
        u = ((RAYS[..., 0] * z + ex) * 60 + 256).astype(np.float32)
        v = ((RAYS[..., 1] * z + ey) * 60 + 256).astype(np.float32)
        video.append(cv2.remap(texture(seed), u, v, cv2.INTER_CUBIC))
        depth.append(z)
    return np.stack(video), np.stack(depth)


def exact_flow(c2w: np.ndarray, depth: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Flow (P, H, W, 2) px of a static scene seen by untilted cameras."""
    flow = []
    for i, j in pairs:
        z = depth[i][..., None]
        local = np.concatenate([RAYS * z, z], -1) + c2w[i, :, 3] - c2w[j, :, 3]
        target = local[..., :2] / local[..., 2:] * F + [W / 2, H / 2]
        flow.append(target - np.stack([X, Y], -1))
    return np.stack(flow).astype(np.float32)


def neighbors(count: int) -> np.ndarray:
    """Pairs (P, 2) of neighbors, both ways."""
    return np.array([p for i in range(count - 1) for p in ((i, i + 1), (i + 1, i))])


def posed_video(c2w, moving=None, video=None) -> PosedVideo:
    """Frames with poses, gray unless given."""
    size = (len(c2w), H, W)
    video = np.full((*size, 3), 0.5, np.float32) if video is None else video
    moving = np.zeros(size, bool) if moving is None else moving
    return PosedVideo(
        np.broadcast_to(K, (len(c2w), 3, 3)),
        c2w,
        np.arange(len(c2w), dtype=float),
        video,
        np.zeros(size, bool),
        moving,
    )
