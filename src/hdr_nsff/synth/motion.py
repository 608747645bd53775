"""Exact motion of a rendered picture, from the depth, the body and the texture
coordinates at every pixel's center, and from how the bodies move.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.exr import MOTION_DIRECTIONS
from hdr_nsff.geometry import pinhole
from hdr_nsff.synth.scenes.base import SynthScene
from hdr_nsff.synth.scenes.geometry import back_project

# Channels of the texture coordinates, in scenes with bodies that deform.
UV = ("surface.u", "surface.v")


def surface_points(channels: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The body (H, W) int and the texture coordinates (H, W, 2) at every pixel's
    center, from the channels of a rendered picture.
    """
    bodies = channels["body"].astype(int)
    nowhere = np.zeros(bodies.shape)
    uv = np.stack([channels.get(name, nowhere) for name in UV], -1)
    return bodies, uv.astype(np.float64)


def exact_flow(there: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """Optical flow (H, W, 2) px of pixel centers whose surface is at world points
    `there` (H, W, 3) at another time, seen then by a camera `c2w` (3, 4).
    """
    height, width = there.shape[:2]
    seen_at, _ = pinhole.project(there, K, c2w)
    return seen_at - pinhole.pixel_centers(height, width)


def depth_there(
    scene: SynthScene,
    channels: dict[str, np.ndarray],
    K: np.ndarray,
    c2w: list[np.ndarray],
    i: int,
    j: int,
) -> np.ndarray:
    """Z-depth (H, W) in the camera of frame `j` of the surface that frame `i` shows,
    moved to the time of frame `j`.
    """
    here = back_project(channels["Z"], K, c2w[i])
    bodies, uv = surface_points(channels)
    _, depth = pinhole.project(scene.moved(here, bodies, uv, i, j), K, c2w[j])
    return depth


def view_geometry(
    scene: SynthScene, channels: dict[str, np.ndarray], time: float, K: np.ndarray, c2w: np.ndarray
) -> dict[str, np.ndarray]:
    """The channels of `truth.GEOMETRY` for a rendered view at `time`: z-depth; flow
    over one frame in the view's own camera, held still; scene flow over one frame in
    the world. The sky, of depth 0, stands still.
    """
    points = back_project(channels["Z"].astype(np.float64), K, c2w)
    bodies, uv = surface_points(channels)
    moving = (bodies > 0)[..., None]
    geometry = {"Z": channels["Z"]}
    for side, name in MOTION_DIRECTIONS.items():
        there = scene.moved(points, bodies, uv, time, time + side)
        flow = exact_flow(there, K, c2w) * moving  # exactly zero where nothing moves
        scene_flow = there - points
        for k, axis in enumerate("uv"):
            geometry[f"{name}.{axis}"] = flow[..., k]
        for k, axis in enumerate("xyz"):
            geometry[f"{name}.{axis}"] = scene_flow[..., k]
    return geometry
