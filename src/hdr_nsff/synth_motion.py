"""Exact motion of what a rendered picture shows, from the depth and the body at every pixel's centre and the known poses of the bodies."""

from __future__ import annotations

import numpy as np

from hdr_nsff.io import SIDES
from hdr_nsff.synth_scene import back_project, moved, project


def exact_flow(points: np.ndarray, bodies: np.ndarray, t: float, other: float, K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """Optical flow (H, W, 2) px of the surface at pixel centres from frame `t` to time `other`, there seen by a camera `c2w` (3, 4)."""
    height, width = bodies.shape
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    return project(moved(points, bodies, t, other), K, c2w)[0] - pixels


def depth_there(channels: dict[str, np.ndarray], K: np.ndarray, c2w: list[np.ndarray], i: int, j: int) -> np.ndarray:
    """Z-depth (H, W) of what frame `i` shows, where it is at the time of frame `j` and in the camera of frame `j`."""
    points = moved(back_project(channels["Z"], K, c2w[i]), channels["body"].astype(int), i, j)
    return project(points, K, c2w[j])[1]


def view_geometry(depth: np.ndarray, bodies: np.ndarray, time: float, K: np.ndarray, c2w: np.ndarray) -> dict[str, np.ndarray]:
    """The channels of `truth.GEOMETRY` for a view at `time` with z-depth (H, W) and `bodies` (H, W): z-depth; flow over one frame in the
    view's own camera, standing still; scene flow over one frame in the world."""
    points = back_project(depth.astype(np.float64), K, c2w)
    channels = {"Z": depth}
    for side, name in SIDES.items():
        flow = exact_flow(points, bodies, time, time + side, K, c2w) * (bodies > 0)[..., None]  # rounding moves no room
        motion = moved(points, bodies, time, time + side) - points
        channels |= {f"{name}.{axis}": flow[..., k] for k, axis in enumerate("uv")}
        channels |= {f"{name}.{axis}": motion[..., k] for k, axis in enumerate("xyz")}
    return channels
