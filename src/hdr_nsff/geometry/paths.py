"""Camera paths: lists of views (camera, time, optional EV). Poses are OpenCV camera to
world in scene units, times are in frames of the clip. Nothing here knows a scene or a
field: callers hand in cameras and times.

A path file is JSON, a list with one object per view:

    [{"time": 3.5, "c2w": [[r, r, r, x], [r, r, r, y], [r, r, r, z]], "K": [[fx, 0, cx],
    [0, fy, cy], [0, 0, 1]], "ev": -2.0}, ...]

`K` (pixels of the clip's frame size) and `ev` (relative to the reference exposure) may
be left out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json
from hdr_nsff.geometry.cameras import Camera


@dataclass(frozen=True)
class View:
    """One picture to be made."""

    camera: Camera
    time: float  # in frames, may be fractional
    ev: float | None = None  # develop at this EV; None: as the caller chooses

    def resized(self, scale: float) -> View:
        """The same view with `scale` times the pixels along each side (at least 1)."""
        width, height = (max(1, round(n * scale)) for n in (self.camera.width, self.camera.height))
        return replace(self, camera=self.camera.resized(width, height))


def training_path(cameras: Sequence[Camera], times: Sequence[float]) -> list[View]:
    """The recorded viewpoints at the recorded times."""
    return [View(c, float(t)) for c, t in zip(cameras, times, strict=True)]


def fixed(camera: Camera, times: Sequence[float]) -> list[View]:
    """One camera that stands still while time goes on."""
    return [View(camera, float(t)) for t in times]


def reach(cameras: Sequence[Camera], camera: Camera) -> Tensor:
    """How far the clip's cameras spread around their middle along the axes of `camera`:
    (3,) scene units, half of the range between the 10th and the 90th percentile.
    """
    centers = (
        torch.stack([c.c2w[:, 3] for c in cameras]) @ camera.c2w[:, :3]
    )  # (T, 3) right, down, forward
    low, high = centers.quantile(torch.tensor([0.1, 0.9]).to(centers), dim=0)
    return (high - low) / 2


def look_at(position: Tensor, target: Tensor, down: Tensor) -> Tensor:
    """The pose (3, 4) at `position` (3,) that looks at `target` (3,), its y axis as
    close to `down` (3,) as it can be.
    """
    forward = torch.nn.functional.normalize(target - position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(down, forward), dim=0)
    return torch.stack([right, torch.linalg.cross(forward, right), forward, position], -1)


def bullet_time(
    camera: Camera,
    time: float,
    focus_depth: float,
    radius: Tensor,
    num_views: int = 24,
    turns: float = 2.0,
) -> list[View]:
    """Time stands still while the camera spirals out of `camera` and back into it,
    always looking at the point `focus_depth` in front of `camera`. `radius` (3,):
    largest offset right, down and forward, scene units. First view = `camera`; loops.
    """
    c2w = camera.c2w
    target = c2w[:, 3] + focus_depth * c2w[:, 2]
    views = []
    for share in torch.arange(num_views) / num_views:
        angle, envelope = 2 * math.pi * turns * float(share), math.sin(math.pi * float(share))
        spiral = (
            torch.tensor([math.cos(angle), math.sin(angle), math.sin(angle / 2)]).to(radius)
            * envelope
        )
        views.append(
            View(
                camera.moved(
                    look_at(c2w[:, 3] + c2w[:, :3] @ (radius * spiral), target, c2w[:, 1])
                ),
                float(time),
            )
        )
    return views


def slow_motion(cameras: Sequence[Camera], times: Sequence[float], factor: int) -> list[View]:
    """`factor` views per recorded frame: times between the recorded ones (which need
    not be evenly spaced), the camera gliding between its neighbors (center linearly,
    rotation along the shortest arc). `times` rise strictly.
    """
    assert (
        factor >= 1
        and len(cameras) == len(times)
        and all(a < b for a, b in itertools.pairwise(times))
    ), list(times)
    views = []
    for i in range(len(times) - 1):
        for k in range(factor):
            f = k / factor
            views.append(
                View(
                    between(cameras[i], cameras[i + 1], f), times[i] + f * (times[i + 1] - times[i])
                )
            )
    return [*views, View(cameras[-1], float(times[-1]))]


def between(a: Camera, b: Camera, fraction: float) -> Camera:
    """The camera `fraction` of the way from `a` to `b`; `a` itself at 0."""
    if fraction == 0:
        return a
    from scipy.spatial.transform import Rotation, Slerp

    turn = Slerp(
        [0, 1],
        Rotation.from_matrix(torch.stack([a.c2w[:, :3], b.c2w[:, :3]]).double().cpu().numpy()),
    )
    rotation = torch.from_numpy(turn(fraction).as_matrix()).to(a.c2w)
    center = torch.lerp(a.c2w[:, 3], b.c2w[:, 3], fraction)
    return replace(
        a, K=torch.lerp(a.K, b.K, fraction), c2w=torch.cat([rotation, center[:, None]], 1)
    )


def from_json(path: Path | str, like: Camera) -> list[View]:
    """The views of a path file (format above); `like` gives the frame size, and `K`
    where a view names none. InputError in one sentence for anything that is not such a
    file.
    """
    try:
        entries = read_json(path)
    except OSError as error:
        raise InputError(
            f"{path}: no readable camera path file ({error.strerror}); check the name"
        ) from error
    except ValueError as error:
        raise InputError(
            f"{path}: not a JSON file ({error}); write a list of {{time, c2w}} objects"
        ) from error
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{path}: a camera path is a list with at least one {{time, c2w}} object; this holds none"
        )
    return [parse(entry, f"{path}: view {i}", like) for i, entry in enumerate(entries)]


def parse(entry: Any, where: str, like: Camera) -> View:
    """One view of a path file; `where` names it in error messages."""
    if not isinstance(entry, dict):
        raise InputError(f"{where} is not an object with `time` and `c2w`")
    if unknown := set(entry) - {"time", "c2w", "K", "ev"}:
        raise InputError(
            f"{where} has the unknown key {sorted(unknown)[0]!r}; known are time, c2w, K and ev"
        )
    if missing := {"time", "c2w"} - set(entry):
        raise InputError(f"{where} has no {sorted(missing)[0]!r}; each view needs time and c2w")
    c2w = numbers(entry["c2w"], (3, 4), f"{where}: c2w")
    if (
        not np.allclose(c2w[:, :3] @ c2w[:, :3].T, np.eye(3), atol=1e-3)
        or np.linalg.det(c2w[:, :3]) < 0
    ):
        raise InputError(
            f"{where}: the left 3x3 of c2w is not a rotation; write OpenCV camera-to-world poses without scale"
        )
    K = numbers(entry["K"], (3, 3), f"{where}: K") if entry.get("K") is not None else None
    if K is not None and not (K[0, 0] > 0 and K[1, 1] > 0 and np.allclose(K[2], [0, 0, 1])):
        raise InputError(
            f"{where}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths in pixels"
        )
    camera = replace(
        like,
        c2w=torch.from_numpy(c2w).to(like.c2w),
        K=like.K if K is None else torch.from_numpy(K).to(like.K),
    )
    ev = float(numbers(entry["ev"], (), f"{where}: ev")) if entry.get("ev") is not None else None
    return View(camera, float(numbers(entry["time"], (), f"{where}: time")), ev)


def numbers(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """`value` as finite float64 of `shape`, or an InputError that says `what` is wrong."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        size = "x".join(map(str, shape)) + " finite numbers" if shape else "one finite number"
        raise InputError(f"{what} must be {size}")
    return array
