"""One rendered view, and its EXR file.

Motion is stored twice. `content.*` is what the content moves in a camera at rest, until
one training interval later and earlier. The other vectors are motion on the screen from
this picture of a shot to its neighbors, the camera's motion included: what motion blur
and retiming take.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from hdr_nsff.core import cryptomatte
from hdr_nsff.core.exr import MOTION_DIRECTIONS, write_exr
from hdr_nsff.core.process import limit_torch_threads
from hdr_nsff.core.tensors import to_device
from hdr_nsff.fields.base import Render
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.interpolate import Mode, flow_duration, render_at
from hdr_nsff.training.run_folder import Run

Vectors = Literal["nuke", "blender"]

MATTE_LAYER = "CryptoObject"
MAX_MOTION = 4.0  # picture widths: keeps motion of points near the camera finite


@dataclass(frozen=True)
class Still:
    """One rendered view, numpy float32."""

    radiance: np.ndarray  # (H, W, 3) linear HDR
    opacity: np.ndarray  # (H, W) in [0, 1]; the field's background fills the rest
    depth: np.ndarray  # (H, W) z-depth, scene units
    motion: np.ndarray  # (H, W) in [0, 1]: share of dynamic content
    # {+-1: (H, W, 2)} pixels: motion of the content until one training interval later /
    # earlier, in a camera at rest; y down
    flow: dict[int, np.ndarray]
    # the same from this picture of a shot to its neighbors, seen by their cameras
    screen_motion: dict[int, np.ndarray] = field(default_factory=dict)


def device_of(run: Run) -> torch.device:
    """The device of the run's field and tone mapper."""
    return run.tonemapper.knots.device


def render_still(
    run: Run,
    view: PathView,
    between: Mode = "auto",
    motion: bool = True,
    neighbors: Mapping[int, PathView] | None = None,
) -> Still:
    """Render one view; without `motion` vectors it takes less time.

    `neighbors` are the next (1) and the previous (-1) view of the shot.
    """
    limit_torch_threads(run.config.torch_threads)
    camera = to_device(view.camera, device_of(run))
    times = run.scene.times.tolist()
    with torch.no_grad():
        seen = render_at(run.field, camera, view.time, times, between, motion)
        flow = motion_vectors(seen, camera)
        steps = screen_motion(seen, view, neighbors or {}, times, device_of(run))

    def image(values: torch.Tensor) -> np.ndarray:
        return values.reshape(camera.height, camera.width, *values.shape[1:]).float().cpu().numpy()

    return Still(
        radiance=image(seen.radiance),
        opacity=image(seen.opacity).clip(0, 1),
        depth=image(seen.depth),
        motion=image(seen.motion),
        flow={offset: image(vectors) for offset, vectors in flow.items()},
        screen_motion={side: image(vectors) for side, vectors in steps.items()},
    )


def surface_points(seen: Render, camera: Camera) -> torch.Tensor:
    """World points (S, 3) that the pixels of a whole picture show."""
    rays = camera.rays(camera.pixel_grid())
    return rays.origins + seen.depth[:, None] * rays.directions


def motion_vectors(seen: Render, camera: Camera) -> dict[int, torch.Tensor]:
    """The scene flow of a picture as pixels (S, 2) in the same camera.

    It is the motion of the content, not of the camera.
    """
    points = surface_points(seen, camera)
    pixels = camera.pixel_grid()
    return {
        offset: camera.project(points + flow)[0] - pixels
        for offset, flow in seen.scene_flow.items()
    }


def screen_motion(
    seen: Render,
    view: PathView,
    neighbors: Mapping[int, PathView],
    times: list[float],
    device: torch.device,
) -> dict[int, torch.Tensor]:
    """Motion (S, 2) in pixels, y down, to the next (1) and previous (-1) picture.

    Content moves along its scene flow by the share of its time that the pictures are
    apart. Where a picture has one neighbor, motion continues in a straight line;
    without any, the camera rests and the neighbors are one training interval away.
    Empty for fields without scene flow.
    """
    if not seen.scene_flow:
        return {}
    camera = to_device(view.camera, device)
    if not neighbors:
        return motion_vectors(seen, camera)
    points = surface_points(seen, camera)
    pixels = camera.pixel_grid()
    limit = MAX_MOTION * max(camera.width, camera.height)
    steps = {}
    for side, neighbor in neighbors.items():
        apart = neighbor.time - view.time
        moved = points
        if apart:
            direction = 1 if apart > 0 else -1
            share = abs(apart) / flow_duration(view.time, direction, times)
            moved = points + share * seen.scene_flow[direction]
        landing = to_device(neighbor.camera, device).project(moved)[0]
        steps[side] = (landing - pixels).clamp(-limit, limit)
    for side in (1, -1):
        if side not in steps:
            steps[side] = -steps[-side]
    return steps


def write_still(
    path: Path,
    still: Still,
    view: PathView,
    half: bool,
    header: dict[str, Any],
    vectors: Vectors = "nuke",
    objects: Mapping[str, np.ndarray] | None = None,
) -> None:
    """One EXR: RGBA, `Z`, `motion`, motion vectors where known, mattes of `objects`.

    `objects` {name: (H, W)} are coverages in [0, 1]. docs/formats.md#exr.
    """
    # Radiance has the field's background in it, so the picture hides what is behind it
    channels = {"RGB": still.radiance, "A": np.ones_like(still.depth), "Z": still.depth}
    channels |= {"opacity": still.opacity, "motion": still.motion}
    for offset, flow in still.flow.items():
        channels[f"content.{MOTION_DIRECTIONS[offset]}.u"] = flow[..., 0]
        channels[f"content.{MOTION_DIRECTIONS[offset]}.v"] = flow[..., 1]
    channels |= vector_channels(still.screen_motion, vectors)
    header = {**header, "time": float(view.time)}
    header["cameraToWorld"] = json.dumps(
        [[round(float(x), 6) for x in row] for row in view.camera.c2w]
    )
    if objects:
        channels |= cryptomatte.channels(MATTE_LAYER, objects)
        header |= cryptomatte.header(MATTE_LAYER, list(objects))
    write_exr(path, channels, header, half)


def vector_channels(steps: Mapping[int, np.ndarray], vectors: Vectors) -> dict[str, np.ndarray]:
    """Motion on the screen {+-1: (H, W, 2)}, y down, as channels, y up.

    Nuke: pixels from here to the neighbor. Blender: x and y to the previous picture,
    then x and y from the next one to here (Cycles' `primitive_motion_vector`).
    """
    if not steps:
        return {}
    up = {side: motion * np.array([1, -1], np.float32) for side, motion in steps.items()}
    if vectors == "blender":
        numbers = np.concatenate([up[-1], -up[1]], -1)
        return {f"Vector.{name}": numbers[..., i] for i, name in enumerate("XYZW")}
    return {
        f"{name}.{axis}": up[side][..., i]
        for side, name in MOTION_DIRECTIONS.items()
        for i, axis in enumerate("uv")
    }
