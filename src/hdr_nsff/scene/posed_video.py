"""Frames with known poses in numpy: what the priors of depth and of movers work on.
Points and pixels go from frame to frame by `geometry/pinhole.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.geometry import pinhole
from hdr_nsff.radiometry.common_range import recorded_range

MIN_DISPARITY = 1e-9  # 1 / scene units; less is endlessly far away


@dataclass(frozen=True)
class PosedVideo:
    """Frames with known poses; T frames of H x W pixels."""

    K: np.ndarray  # (T, 3, 3) pixels
    c2w: np.ndarray  # (T, 3, 4) OpenCV, scene units
    times: np.ndarray  # (T,) in frames
    video: ArrayStack  # (T, H, W, 3) exposure-equalized rgb in [0, 1]
    clipped: ArrayStack  # (T, H, W) bool: no information
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
        z-depth (P,), and whether they lie inside the frame (P,).
        """
        pixels, depth = pinhole.project(points, self.K[i], self.c2w[i])
        in_front = depth > pinhole.MIN_DEPTH
        in_frame = (pixels >= 0).all(-1) & (pixels <= self.size[::-1]).all(-1)
        return pixels, depth, in_front & in_frame

    def unproject(self, i: int, pixels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        """World points (P, 3) of `pixels` (P, 2) of frame `i` at `disparity` (P,)."""
        depth = 1 / np.maximum(disparity, MIN_DISPARITY)
        return pinhole.unproject(pixels, depth, self.K[i], self.c2w[i])

    def transfer(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """`A` (3, 3) and `b` (3,) float32: pixel (x, y) of frame `i` at disparity d
        falls on the homogeneous `A (x, y, 1) + d b` of frame `j`, whose third entry is
        the z-depth in `j` times d.
        """
        rotation, shift = pinhole.transfer(self.K[i], self.c2w[i], self.K[j], self.c2w[j])
        return rotation.astype(np.float32), shift.astype(np.float32)
