"""Camera paths: lists of views (camera, time, optional EV).

Poses are OpenCV camera to world in scene units, times are in frames of the clip.
Nothing here knows a scene or a field: callers pass cameras and times.

A path file is JSON, a list with one object per view:

    [{"time": 3.5, "c2w": [[r, r, r, x], [r, r, r, y], [r, r, r, z]],
      "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "ev": -2.0}, ...]

`K` (pixels of the clip's frame size) and `ev` (relative to the reference exposure) may
be left out.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.geometry.cameras import Camera

REQUIRED_KEYS = {"time", "c2w"}
KNOWN_KEYS = REQUIRED_KEYS | {"K", "ev"}
MAX_NUMBER = 1e9  # of a path file: beyond it single precision has nothing to render
MAX_EV = 60.0  # stops: beyond this float32 radiance is 0 or Inf
REACH_QUANTILES = (0.1, 0.9)  # hand-chosen: single outliers among the poses do not count
TIME_TOLERANCE = 1e-6  # of the usual gap: even times this close to the last one are it
ROTATION_TOLERANCE = 1e-3  # per entry of R R^T: poses may be written with few digits


@dataclass(frozen=True)
class PathView:
    """One picture to be rendered."""

    camera: Camera
    time: float  # in frames, may be fractional
    ev: float | None = None  # develop at this EV; None: the caller chooses

    def resized(self, scale: float) -> PathView:
        """The same view with `scale` times the pixels along each side (at least 1)."""
        width = max(1, round(self.camera.width * scale))
        height = max(1, round(self.camera.height * scale))
        return replace(self, camera=self.camera.resized(width, height))


def training_path(cameras: Sequence[Camera], times: Sequence[float]) -> list[PathView]:
    """The recorded viewpoints at the recorded times."""
    return [PathView(c, float(t)) for c, t in zip(cameras, times, strict=True)]


def usual_gap(times: Sequence[float]) -> float:
    """From a time to the next one, where none is missing: the (lower) median gap."""
    gaps = [b - a for a, b in itertools.pairwise(times)]
    return float(statistics.median_low(gaps)) if gaps else 1.0


def fixed_path(camera: Camera, times: Sequence[float]) -> list[PathView]:
    """One camera that stands still while time goes on evenly, by the usual gap.

    Where `times` are further apart, frames are held out or missing; there are views at
    these, too.
    """
    first, last, step = float(times[0]), float(times[-1]), usual_gap(times)
    count = math.ceil((last - first) / step - TIME_TOLERANCE)
    return [PathView(camera, t) for t in [*(first + k * step for k in range(count)), last]]


def center_spread(cameras: Sequence[Camera], camera: Camera) -> Tensor:
    """How far the clip's cameras spread around their middle along the axes of `camera`.

    (3,) scene units right, down and forward: half of the range between the 10th and the
    90th percentile.
    """
    centers = torch.stack([c.c2w[:, 3] for c in cameras])
    local = centers @ camera.c2w[:, :3]  # (T, 3)
    low, high = local.quantile(torch.tensor(REACH_QUANTILES).to(local), dim=0)
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
) -> list[PathView]:
    """Time stands still while the camera spirals out of `camera` and back into it.

    It always looks at the point `focus_depth` in front of `camera`. `radius` (3,):
    largest offset right, down and forward, scene units. The first view is `camera`, and
    the path is a loop.
    """
    rotation, center = camera.c2w[:, :3], camera.c2w[:, 3]
    down, forward = rotation[:, 1], rotation[:, 2]
    target = center + focus_depth * forward
    views = []
    for share in (torch.arange(num_views) / num_views).tolist():
        angle = 2 * math.pi * turns * share
        envelope = math.sin(math.pi * share)
        circle = torch.tensor([math.cos(angle), math.sin(angle), math.sin(angle / 2)])
        offset = radius * (circle.to(radius) * envelope)
        pose = look_at(center + rotation @ offset, target, down)
        views.append(PathView(camera.moved(pose), float(time)))
    return views


def slow_motion(cameras: Sequence[Camera], times: Sequence[float], factor: int) -> list[PathView]:
    """`factor` views per recorded frame, the camera interpolated between its neighbors.

    `times` rise strictly; where frames are held out or missing, there are as many more
    views. Centers are interpolated linearly, rotations along the shortest arc.
    """
    assert factor >= 1, factor
    assert len(cameras) == len(times), (len(cameras), len(times))
    assert all(a < b for a, b in itertools.pairwise(times)), list(times)
    views = []
    for i, count in enumerate(views_per_interval(times, factor)):
        interval = times[i + 1] - times[i]
        for k in range(count):
            fraction = k / count
            camera = interpolate_camera(cameras[i], cameras[i + 1], fraction)
            views.append(PathView(camera, times[i] + fraction * interval))
    return [*views, PathView(cameras[-1], float(times[-1]))]


def views_per_interval(times: Sequence[float], factor: int) -> list[int]:
    """How many views of slow motion there are from each time until before the next:
    `factor` where they are one usual gap apart.
    """
    usual = usual_gap(times)
    # exact, because a factor may be larger than any float
    gaps = [Fraction((b - a) / usual) for a, b in itertools.pairwise(times)]
    return [max(1, round(factor * gap)) for gap in gaps]


def interpolate_camera(a: Camera, b: Camera, fraction: float) -> Camera:
    """The camera `fraction` of the way from `a` to `b`; `a` itself at 0."""
    if fraction == 0:
        return a
    ends = torch.stack([a.c2w[:, :3], b.c2w[:, :3]]).double().cpu().numpy()
    shortest_arc = Slerp([0, 1], Rotation.from_matrix(ends))
    rotation = torch.from_numpy(shortest_arc(fraction).as_matrix()).to(a.c2w)
    center = torch.lerp(a.c2w[:, 3], b.c2w[:, 3], fraction)
    c2w = torch.cat([rotation, center[:, None]], 1)
    return replace(a, K=torch.lerp(a.K, b.K, fraction), c2w=c2w)


def read_path(path: Path | str, like: Camera) -> list[PathView]:
    """The views of a path file (format above).

    `like` gives the frame size, and `K` for views without one. InputError in one
    sentence for anything that is not such a file.
    """
    try:
        entries = read_json(path)
    except OSError as error:
        raise InputError(
            f"--path {path}: no readable camera path file ({error.strerror}); correct the name"
        ) from error
    except ValueError as error:
        raise InputError(
            f"{path}: not a JSON file ({shorten(error)}); write a list of {{time, c2w}} objects"
        ) from error
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{path}: a camera path is a list with at least one {{time, c2w}} object; "
            "this file holds none"
        )
    return [parse_view(entry, f"{path}: view {i}", like) for i, entry in enumerate(entries)]


def parse_view(entry: Any, where: str, like: Camera) -> PathView:
    """One view of a path file; `where` names it in error messages."""
    if not isinstance(entry, dict):
        raise InputError(f"{where} is not an object with `time` and `c2w`")
    unknown = sorted(set(entry) - KNOWN_KEYS)
    if unknown:
        raise InputError(
            f"{where} has the unknown key {shorten(unknown[0])!r}; known are time, c2w, K and ev"
        )
    missing = sorted(REQUIRED_KEYS - set(entry))
    if missing:
        raise InputError(f"{where} has no {missing[0]!r}; each view needs time and c2w")
    c2w = parse_pose(entry["c2w"], where)
    K = like.K
    if entry.get("K") is not None:
        K = torch.from_numpy(parse_intrinsics(entry["K"], where)).to(like.K)
    ev = None
    if entry.get("ev") is not None:
        ev = float(parse_numbers(entry["ev"], (), f"{where}: ev"))
        if abs(ev) > MAX_EV:
            meaning = "an exposure in stops relative to the reference, like -2 or 1.5"
            raise InputError(f"{where}: ev {ev:g} must be {meaning}, up to {MAX_EV:g}")
    time = float(parse_numbers(entry["time"], (), f"{where}: time"))
    return PathView(replace(like, c2w=torch.from_numpy(c2w).to(like.c2w), K=K), time, ev)


def parse_pose(value: Any, where: str) -> np.ndarray:
    """A pose (3, 4) with a proper rotation, or an InputError."""
    c2w = parse_numbers(value, (3, 4), f"{where}: c2w")
    rotation = c2w[:, :3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
    if not orthonormal or np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where}: the left 3x3 of c2w is not a rotation; "
            "write OpenCV camera-to-world poses without scale"
        )
    return c2w


def parse_intrinsics(value: Any, where: str) -> np.ndarray:
    """A matrix K (3, 3) of a pinhole camera, or an InputError."""
    K = parse_numbers(value, (3, 3), f"{where}: K")
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.allclose(K[2], [0, 0, 1])):
        raise InputError(
            f"{where}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] "
            "with positive focal lengths in pixels"
        )
    return K


def parse_numbers(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """`value` as float64 of `shape`, or an InputError that `what` is wrong."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.full(1, np.nan)
    if array.shape != shape or not (np.abs(array) <= MAX_NUMBER).all():
        size = "x".join(map(str, shape)) + " finite numbers" if shape else "one finite number"
        raise InputError(f"{what} must be {size} up to {MAX_NUMBER:g}")
    return array
