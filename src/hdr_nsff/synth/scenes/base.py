"""A synthetic scene: parts on bodies, how the bodies move, what lights them, and the
cameras that film them.

World axes are OpenCV's (+x right, +y down, +z forward), in meters; time is in frames.
Body 0 is static. Of every other body the place of each point of its surface is known at
any time: of a rigid one by its pose, of a deforming one by its mesh at that time and
the point's triangle and barycentric coordinates. So the depth and motion of a picture
are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from hdr_nsff.synth.scenes.geometry import look_at

STATIC_BODY = "room"  # the body that never moves
Views = Literal["mono", "rig"]


@dataclass(frozen=True)
class Part:
    """A textured triangle mesh in its body's coordinates."""

    name: str
    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3) counter-clockwise seen from outside
    uv: np.ndarray  # (V, 2) in [0, 1], v down the texture
    texture: np.ndarray  # (H, W, 3) albedo, radiance where it emits; (1, 1, 3) for one color
    body: str = STATIC_BODY
    emits: bool = False
    circuit: str | None = None
    """Lamps of one circuit are traced together: less time, and more noise where one
    outshines another.
    """
    radius: float | None = None
    """Of an exact sphere about the first vertex: lights of that shape are sampled
    without noise.
    """


class Body(Protocol):
    """A moving body."""

    @property
    def name(self) -> str:
        """The name by which its parts refer to it."""
        ...

    def vertices(self, part: Part, t: float) -> np.ndarray:
        """World vertices (V, 3) of one of its parts at time `t`."""
        ...

    def moved(self, points: np.ndarray, uv: np.ndarray, t: float, other: float) -> np.ndarray:
        """The places (N, 3) at time `other` of its points (N, 3) of time `t` with
        texture coordinates (N, 2).
        """
        ...


@dataclass(frozen=True)
class Rigid:
    """A body that keeps its shape."""

    name: str
    pose: Callable[[float], np.ndarray]  # body to world, (4, 4), at a time in frames

    def vertices(self, part: Part, t: float) -> np.ndarray:
        """The part's vertices, transformed by the pose."""
        pose = self.pose(t)
        return part.vertices @ pose[:3, :3].T + pose[:3, 3]

    def moved(self, points: np.ndarray, uv: np.ndarray, t: float, other: float) -> np.ndarray:
        """Points transformed from one pose to the other; texture coordinates play no
        part.
        """
        carry = self.pose(other) @ np.linalg.inv(self.pose(t))
        return points @ carry[:3, :3].T + carry[:3, 3]


@dataclass(frozen=True)
class Deforming:
    """A body of one part, a sheet of `rows` x `columns` cells (see `shapes.sheet`),
    that has another shape at every time.

    `shape` gives world points (..., 3) of texture coordinates (..., 2) at a time in
    frames.
    """

    name: str
    shape: Callable[[np.ndarray, float], np.ndarray]
    rows: int
    columns: int

    def vertices(self, part: Part, t: float) -> np.ndarray:
        """The corners of the sheet's cells."""
        return self.shape(part.uv, t)

    def moved(self, points: np.ndarray, uv: np.ndarray, t: float, other: float) -> np.ndarray:
        """Points moved along with the triangle they are on."""
        return points + self.mesh_points(uv, other) - self.mesh_points(uv, t)

    def mesh_points(self, uv: np.ndarray, t: float) -> np.ndarray:
        """Points (N, 3) of the mesh of time `t` at texture coordinates (N, 2):
        barycentric in one of the two triangles of a cell.
        """
        cells = np.array([self.columns, self.rows])
        scaled = uv * cells
        cell = np.minimum(np.floor(scaled), cells - 1)
        across, down = (scaled - cell).T[..., None]
        here = self.shape(cell / cells, t)
        right = self.shape((cell + np.array([1, 0])) / cells, t)
        below = self.shape((cell + np.array([0, 1])) / cells, t)
        opposite = self.shape((cell + np.array([1, 1])) / cells, t)
        upper = here + across * (right - here) + down * (opposite - right)
        lower = here + down * (below - here) + across * (opposite - below)
        return np.where(across >= down, upper, lower)


@dataclass(frozen=True)
class SynthScene:
    """A scene to be filmed."""

    build: Callable[[int], list[Part]]
    """Every part, from a seed."""
    bodies: tuple[Body, ...]
    """The movers; body k of a picture is the k-th of these, counted from 1. One whose
    name is MOVER-PART is a limb of that mover.
    """
    camera_pose: Callable[[float], np.ndarray]
    """Camera to world (3, 4) of the one moving camera, at a time in frames."""
    rig: tuple[tuple[float, float, float], ...]
    """The places of the rig's nine cameras, once around two rows."""
    rig_target: tuple[float, float, float]
    """The point that they are aimed at."""
    ev: str = "-4,-2,0"  # exposures that suit it
    spp: int = 128  # paths per pixel that suit it
    truth_spp: int = 384  # paths per pixel of the held-out views
    max_frames: int = 400  # of a clip: later, a mover would leave the scene
    blur: float = 0.05  # meters of a surface over which bounced light is averaged
    sky: Callable[[], np.ndarray] | None = None
    """Radiance (H, W, 3) from all around: latitude down, longitude across."""

    @property
    def deforms(self) -> bool:
        """Whether any body has another shape at every time."""
        return any(isinstance(body, Deforming) for body in self.bodies)

    def pose(self, views: Views, t: float) -> np.ndarray:
        """Camera to world, (3, 4) OpenCV, of the camera that records frame `t`: the
        moving one, or the rig's camera `t` modulo nine.

        The rig's cameras are numbered around, so the next to record stands beside.
        """
        if views == "mono":
            return self.camera_pose(t)
        eye = self.rig[round(t) % len(self.rig)]
        return look_at(np.array(eye), np.array(self.rig_target))

    def index(self, body: str) -> int:
        """The number of a body in pictures; 0 is the static one."""
        names = [STATIC_BODY, *(b.name for b in self.bodies)]
        return names.index(body)

    def vertices(self, part: Part, t: float) -> np.ndarray:
        """World vertices (V, 3) of a part at time `t`."""
        index = self.index(part.body)
        if index == 0:
            return part.vertices
        return self.bodies[index - 1].vertices(part, t)

    def moved(
        self, points: np.ndarray, bodies: np.ndarray, uv: np.ndarray, t: float, other: float
    ) -> np.ndarray:
        """The places (..., 3) at time `other` of world points (..., 3) of time `t`, on
        `bodies` (...) int at texture coordinates (..., 2).
        """
        result = points.copy()
        for index, body in enumerate(self.bodies, 1):
            on_body = bodies == index
            if on_body.any():
                result[on_body] = body.moved(points[on_body], uv[on_body], t, other)
        return result
