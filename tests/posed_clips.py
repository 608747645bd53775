"""Painted clips whose cameras are known: a pan along a wall, a slide past boards."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

W, H, FOCAL = 160, 96, 150.0
K = np.array([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1.0]])
HALF = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # array index -> pixel center
# of the sliding camera, in scene units
PLACES = np.stack(
    [np.linspace(-0.5, 0.5, 8), 0.15 * np.sin(np.arange(8)), 0.1 * np.cos(np.arange(8))], 1
)
# depth, (x, y, width, height) in scene units, seed: a wall and three boards before it
BOARDS = [
    (6.0, (-5, -3, 10, 6), 0),
    (4.5, (0.4, -1.2, 1.5, 0.8), 3),
    (3.5, (-1.6, -0.9, 1.1, 0.8), 1),
    (2.6, (0.3, -0.3, 0.6, 0.9), 2),
]
BOARD_SCALE = 60.0  # texture pixels per scene unit


def texture(seed: int, width: int, height: int) -> np.ndarray:
    """Blotches of several sizes, rgb (height, width, 3) in [0, 1]."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.random((height, width, 3)), (0, 0), s) for s in (1.2, 2.5, 5.0)]
    total = sum((x - x.mean()) / x.std() for x in layers)
    return np.clip(0.5 + 0.15 * total, 0, 1).astype(np.float32)


def seen(texture: np.ndarray, to_pixels: np.ndarray) -> np.ndarray:
    """A frame (H, W, 3) from a texture whose index coordinates map to pixels by a
    homography; NaN outside.
    """
    matrix = np.linalg.inv(HALF) @ to_pixels @ HALF
    return cv2.warpPerspective(
        texture, matrix, (W, H), flags=cv2.INTER_AREA, borderValue=(np.nan,) * 3
    )


def panning(angles: np.ndarray) -> np.ndarray:
    """A clip (T, H, W, 3) of a camera that turns by `angles` (T) degrees about the
    vertical, before a far wall.
    """
    wall = texture(0, 400, 240)
    # one pixel of the wall per pixel straight ahead
    wall_to_world = np.array([[1, 0, -200], [0, 1, -120], [0, 0, FOCAL]])
    turns = Rotation.from_euler("y", angles[:, None], degrees=True).as_matrix().reshape(-1, 3, 3)
    to_pixels = [K @ turn.T @ wall_to_world for turn in turns]
    return np.stack([np.nan_to_num(seen(wall, matrix)) for matrix in to_pixels])


def sliding(places: np.ndarray) -> np.ndarray:
    """A clip (T, H, W, 3) of a camera at `places` (T, 3) looking along +z at a wall and
    three boards before it.
    """
    clip = []
    for eye in places:
        frame = np.zeros((H, W, 3), np.float32)
        for depth, (x, y, width, height), seed in BOARDS:  # from far to near
            image = texture(seed, int(width * BOARD_SCALE), int(height * BOARD_SCALE))
            step = 1 / BOARD_SCALE
            plane = np.array([[step, 0, x - eye[0]], [0, step, y - eye[1]], [0, 0, depth - eye[2]]])
            layer = seen(image, K @ plane)
            frame = np.where(np.isnan(layer), frame, layer)
        clip.append(frame)
    return np.stack(clip)
