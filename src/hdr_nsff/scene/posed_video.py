"""Frames with known poses: pixels to world points and back, and from one frame to
another.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hdr_nsff.radiometry.common_range import recorded_range


@dataclass(frozen=True)
class PosedVideo:
    """Frames with known poses; T frames of H x W pixels."""

    K: np.ndarray  # (T, 3, 3) pixels
    c2w: np.ndarray  # (T, 3, 4) OpenCV, scene units
    times: np.ndarray  # (T,) in frames
    video: np.ndarray  # (T, H, W, 3) exposure-equalized rgb in [0, 1]
    clipped: np.ndarray  # (T, H, W) bool: no information
    moving: np.ndarray  # (T, H, W) bool

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.video.shape[1], self.video.shape[2]

    @cached_property
    def ranges(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per frame the lowest and highest equalized rgb it recorded."""
        return [
            recorded_range(frame, clip)
            for frame, clip in zip(self.video, self.clipped, strict=True)
        ]

    def project(self, i: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """World `points` (P, 3) in frame `i`: pixels (P, 2) with centers at +0.5,
        z-depth (P,), which are inside the frame (P,).
        """
        local = (points - self.c2w[i, :, 3]) @ self.c2w[i, :, :3]
        z = local[:, 2]
        homogeneous = local @ self.K[i].T
        pixels = homogeneous[:, :2] / np.where(np.abs(z) < 1e-9, 1e-9, z)[:, None]
        inside = (z > 1e-6) & (pixels >= 0).all(-1) & (pixels <= self.size[::-1]).all(-1)
        return pixels, z, inside

    def unproject(self, i: int, pixels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        """World points (P, 3) of `pixels` (P, 2) of frame `i` at `disparity` (P,)."""
        local = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(self.K[i]).T
        return local / disparity[:, None] @ self.c2w[i, :, :3].T + self.c2w[i, :, 3]

    def transfer(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """`A` (3, 3) and `b` (3,) float32: pixel (x, y) of frame `i` at disparity d
        falls on the homogeneous `A (x, y, 1) + d b` of frame `j`, whose third entry is
        z-depth in `j` times d.
        """
        to_j = self.K[j] @ self.c2w[j, :, :3].T
        turn = to_j @ self.c2w[i, :, :3] @ np.linalg.inv(self.K[i])
        return turn.astype(np.float32), (to_j @ (self.c2w[i, :, 3] - self.c2w[j, :, 3])).astype(
            np.float32
        )
