"""The training pictures of a public data set in any layout: footage with times,
exposures, poses and maps.

A reader turns a folder into a `Capture` and opens nothing that the set holds out for
testing; `held_out.py` does that, for `evaluate` alone. Times are in frames of the set,
axes OpenCV, depth in units of the poses unless `depth_units` is "own".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.footage import Footage
from hdr_nsff.footage.frame_files import LINEAR
from hdr_nsff.footage.pose_formats import GivenPoses

# frames: a time this near to a whole number is one, since files store rounded fractions
MAX_ROUNDING = 1e-3


@dataclass(frozen=True)
class Picture:
    """One training picture."""

    source: str  # file name relative to the root
    time: float  # in frames
    camera_id: int = 0
    ev: float | None = None  # log2 exposure, to any reference
    bracket: int | None = None  # which row of `Capture.exposures`
    mask: Path | None = None
    depth: Path | None = None
    confidence: Path | None = None  # of the depth, in [0, 1]
    # source of another picture -> flow towards it
    flow: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Exposures:
    """Exposures as a set written by `export` stores them."""

    ev: list[float | None]  # per bracket
    reference: int
    given: bool


@dataclass(frozen=True)
class SparseDepth:
    """The depth of the static points that a picture sees.

    It brings the picture's depth map to the units of the poses.
    """

    xy: np.ndarray  # (n, 2) in [0, 1], shares of width and height
    depth: np.ndarray  # (n,) z-depth, scene units
    bounds: tuple[float, float]  # 5th and 95th percentile of z-depth, scene units


@dataclass(frozen=True)
class Capture:
    """The training part of a data set."""

    layout: str  # its name for people
    root: Path
    pictures: list[Picture]  # camera by camera, in time
    poses: GivenPoses | None  # row by row those of `pictures`
    has_held_out: bool  # the set holds views out, which `prepare` writes into a truth folder
    # gray behind transparent pixels: 1 white, 0 black; None: none is expected
    over: float | None = None
    is_static: bool = False  # nothing moves: times only number the views
    white_moves: bool = True  # moving pixels are white in the masks
    depth_kind: Literal["metric", "disparity", "relative"] = "metric"
    # own: of the depth network, brought to scene units by `sparse_depth`
    depth_units: Literal["scene", "own"] = "scene"
    depth_scale: float = 1.0  # scene units per unit of a metric array (pictures hold millimeters)
    sparse_depth: Mapping[str, SparseDepth] = field(default_factory=dict)  # by source
    points: np.ndarray | None = None  # (P, 3) static, scene units
    exposures: Exposures | None = None
    fps: float = 24.0
    notes: tuple[str, ...] = ()  # sentences for people

    @cached_property
    def by_source(self) -> dict[str, Picture]:
        """The pictures by file name."""
        return {p.source: p for p in self.pictures}

    @cached_property
    def row(self) -> dict[str, int]:
        """The position in `pictures` and `poses` of a file name."""
        return {p.source: k for k, p in enumerate(self.pictures)}

    def footage(self) -> Footage:
        """The pictures as footage, one list of files per camera."""
        cameras = []
        for camera_id in sorted({p.camera_id for p in self.pictures}):
            own = [p for p in self.pictures if p.camera_id == camera_id]
            cameras.append([self.root / p.source for p in own])
        linear = {f.suffix.lower() in LINEAR for files in cameras for f in files}
        if len(linear) > 1:
            raise InputError(
                f"{self.root}: linear (EXR, DNG) and recorded pictures are mixed; keep one kind"
            )
        count = max(len(files) for files in cameras)
        return Footage(self.root, cameras, False, count, self.fps, linear.pop(), self.over)

    def parts(self) -> dict[str, bool]:
        """Whether the set gives each part of a scene for all of its pictures."""
        pictures = self.pictures
        known_exposures = all(p.ev is not None for p in pictures)
        return {
            "exposures": self.exposures is not None or known_exposures,
            "poses": self.poses is not None,
            "flow": any(p.flow for p in pictures),
            "masks": self.is_static or all(p.mask for p in pictures),
            "depth": all(p.depth for p in pictures),
        }


@dataclass(frozen=True)
class Clock:
    """Times as a set stores them, in any unit, to frames.

    The first training time is 0, the median gap between two is 1.
    """

    start: float
    step: float

    @staticmethod
    def of(times: Sequence[float]) -> Clock:
        """The clock of the training times."""
        distinct = np.unique(np.asarray(times, np.float64))
        step = 1.0
        if len(distinct) > 1:
            step = float(np.median(np.diff(distinct)))
        return Clock(float(distinct[0]), step)

    def __call__(self, time: float) -> float:
        """A time in frames."""
        value = (time - self.start) / self.step
        nearest = float(round(value))
        return nearest if abs(value - nearest) < MAX_ROUNDING else value


def number_cameras(times: Sequence[float]) -> list[int]:
    """A camera for each picture: 0, and 1, 2, ... for further pictures of one time."""
    seen: Counter[float] = Counter()
    cameras = []
    for time in times:
        cameras.append(seen[time])
        seen[time] += 1
    return cameras


def select_poses(given: GivenPoses, rows: Sequence[int]) -> GivenPoses:
    """The poses in `rows`, in that order."""
    rows = list(rows)
    names = None
    if given.names is not None:
        names = [given.names[row] for row in rows]
    distortion = None if given.distortion is None else given.distortion[rows]
    return replace(
        given,
        names=names,
        K=given.K[rows],
        c2w=given.c2w[rows],
        size=given.size[rows],
        distortion=distortion,
    )
