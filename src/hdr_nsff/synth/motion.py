"""Exact motion of what a rendered picture shows, from the depth, the body and the place
on it at every pixel's center, and how the bodies move.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.exr import SIDES
from hdr_nsff.synth.scenes.base import SynthScene
from hdr_nsff.synth.scenes.geometry import back_project, project

UV = (
    "surface.u",
    "surface.v",
)  # channels: texture coordinates, where the scene has bodies that deform


def place(channels: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The body (H, W) int and the texture coordinates (H, W, 2) at every pixel's
    center, from the channels of a rendered picture.
    """
    bodies = channels["body"].astype(int)
    return bodies, np.stack([channels.get(name, np.zeros(bodies.shape)) for name in UV], -1).astype(
        np.float64
    )


def exact_flow(there: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """Optical flow (H, W, 2) px of pixel centers whose surface is at world points
    `there` (H, W, 3) at another time, seen then by a camera `c2w` (3, 4).
    """
    height, width = there.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    return project(there, K, c2w)[0] - pixels


def depth_there(
    scene: SynthScene,
    channels: dict[str, np.ndarray],
    K: np.ndarray,
    c2w: list[np.ndarray],
    i: int,
    j: int,
) -> np.ndarray:
    """Z-depth (H, W) of what frame `i` shows, where it is at the time of frame `j` and
    in the camera of frame `j`.
    """
    points = scene.moved(back_project(channels["Z"], K, c2w[i]), *place(channels), i, j)
    return project(points, K, c2w[j])[1]


def view_geometry(
    scene: SynthScene, channels: dict[str, np.ndarray], time: float, K: np.ndarray, c2w: np.ndarray
) -> dict[str, np.ndarray]:
    """The channels of `truth.GEOMETRY` for a rendered view at `time`: z-depth; flow
    over one frame in the view's own camera, standing still; scene flow over one frame
    in the world.
    """
    points = back_project(channels["Z"].astype(np.float64), K, c2w)
    bodies, uv = place(channels)
    geometry = {"Z": channels["Z"]}
    for side, name in SIDES.items():
        there = scene.moved(points, bodies, uv, time, time + side)
        flow = (
            exact_flow(there, K, c2w) * (bodies > 0)[..., None]
        )  # rounding moves nothing that stands still
        geometry |= {f"{name}.{axis}": flow[..., k] for k, axis in enumerate("uv")}
        geometry |= {f"{name}.{axis}": (there - points)[..., k] for k, axis in enumerate("xyz")}
    return geometry
