"""What a synthetic scene is: parts on bodies, how the bodies move, what lights them,
and the cameras that film them.

World axes are OpenCV's (+x right, +y down, +z forward), meters; time is in frames. Body
0 stands still. Of every other body the place of each point of its surface is known at
any time: a rigid one by its pose, a deforming one by its mesh of that time and the
point's triangle and barycentric coordinates. So depth and motion of what a picture
shows are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from hdr_nsff.synth.scenes.geometry import look_at

STILL = "room"  # the body that stands still
Views = Literal["mono", "rig"]


@dataclass(frozen=True)
class Part:
    """A textured triangle mesh in its body's coordinates."""

    name: str
    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3) counter-clockwise seen from outside
    uv: np.ndarray  # (V, 2) in [0, 1], v down the texture
    texture: np.ndarray  # (H, W, 3) albedo, radiance where it emits; (1, 1, 3) for one color
    body: str = STILL
    emits: bool = False
    circuit: str | None = (
        # lamps on one circuit are traced together: less time, and more noise where one
        # outshines another
        None
    )
    radius: float | None = (
        # an exact sphere about the first vertex: lights of that shape are sampled
        # without noise
        None
    )


class Body(Protocol):
    """Something that moves."""

    @property
    def name(self) -> str:
        """How its parts refer to it."""
        ...

    def vertices(self, part: Part, t: float) -> np.ndarray:
        """World vertices (V, 3) of one of its parts at time `t`."""
        ...

    def moved(self, points: np.ndarray, uv: np.ndarray, t: float, other: float) -> np.ndarray:
        """Where its points (N, 3) of time `t`, with texture coordinates (N, 2), are at
        time `other`, (N, 3).
        """
        ...


@dataclass(frozen=True)
class Rigid:
    """A body that keeps its shape."""

    name: str
    pose: Callable[[float], np.ndarray]  # body to world, (4, 4), at a time in frames

    def vertices(self, part: Part, t: float) -> np.ndarray:
        """Carried by the pose."""
        pose = self.pose(t)
        return part.vertices @ pose[:3, :3].T + pose[:3, 3]

    def moved(self, points: np.ndarray, uv: np.ndarray, t: float, other: float) -> np.ndarray:
        """Carried from one pose to the other, whatever its texture coordinates."""
        carry = self.pose(other) @ np.linalg.inv(self.pose(t))
        return points @ carry[:3, :3].T + carry[:3, 3]


@dataclass(frozen=True)
class Deforming:
    """A body of one part, a sheet of `rows` x `columns` cells (see `shapes.sheet`),
    that has another shape at every time.
    """

    name: str
    shape: Callable[
        [np.ndarray, float], np.ndarray
    ]  # world points (..., 3) of texture coordinates (..., 2) at a time in frames
    rows: int
    columns: int

    def vertices(self, part: Part, t: float) -> np.ndarray:
        """The sheet's corners of cells."""
        return self.shape(part.uv, t)

    def moved(self, points: np.ndarray, uv: np.ndarray, t: float, other: float) -> np.ndarray:
        """Carried by the triangle they are on."""
        return points + self.on_mesh(uv, other) - self.on_mesh(uv, t)

    def on_mesh(self, uv: np.ndarray, t: float) -> np.ndarray:
        """Points (N, 3) of the mesh of time `t` at texture coordinates (N, 2):
        barycentric in one of the two triangles of a cell.
        """
        scaled = uv * [self.columns, self.rows]
        cell = np.minimum(np.floor(scaled), [self.columns - 1, self.rows - 1])
        across, down = (scaled - cell).T[..., None]
        here, right, below, opposite = (
            self.shape((cell + step) / [self.columns, self.rows], t)
            for step in ([0, 0], [1, 0], [0, 1], [1, 1])
        )
        upper = here + across * (right - here) + down * (opposite - right)
        lower = here + down * (below - here) + across * (opposite - below)
        return np.where(across >= down, upper, lower)


@dataclass(frozen=True)
class SynthScene:
    """A scene to be filmed."""

    build: Callable[[int], list[Part]]  # every part, of a seed
    bodies: tuple[Body, ...]  # what moves; body k of a picture is the k-th of these, counted from 1
    camera_pose: Callable[
        [float], np.ndarray
    ]  # camera to world (3, 4) of the one moving camera, at a time in frames
    rig: tuple[
        tuple[float, float, float], ...
    ]  # where the nine cameras of the rig stand, once around two rows
    rig_target: tuple[float, float, float]  # what they are aimed at
    ev: str = "-4,-2,0"  # exposures that suit it
    spp: int = 128  # paths per pixel that suit it
    truth_spp: int = 384  # the same of the held-out views
    blur: float = 0.05  # meters of a surface over which bounced light is averaged
    # radiance (H, W, 3) from all around: latitude down, longitude across
    sky: Callable[[], np.ndarray] | None = None

    @property
    def deforms(self) -> bool:
        """Whether something has another shape at every time."""
        return any(isinstance(body, Deforming) for body in self.bodies)

    def pose(self, views: Views, t: float) -> np.ndarray:
        """Camera to world, (3, 4) OpenCV, of what records frame `t`: the moving camera,
        or the rig's camera `t` modulo nine.

        The rig's cameras are numbered around: whoever records next stands beside.
        """
        if views == "mono":
            return self.camera_pose(t)
        return look_at(np.array(self.rig[round(t) % len(self.rig)]), np.array(self.rig_target))

    def index(self, body: str) -> int:
        """The number of a body in pictures."""
        return [STILL, *(b.name for b in self.bodies)].index(body)

    def vertices(self, part: Part, t: float) -> np.ndarray:
        """World vertices (V, 3) of a part at time `t`."""
        index = self.index(part.body)
        return self.bodies[index - 1].vertices(part, t) if index else part.vertices

    def moved(
        self, points: np.ndarray, bodies: np.ndarray, uv: np.ndarray, t: float, other: float
    ) -> np.ndarray:
        """Where world points (..., 3) on `bodies` (...), with texture coordinates (...,
        2), at time `t` are at time `other`.
        """
        result = points.copy()
        for index, body in enumerate(self.bodies, 1):
            mine = bodies == index
            if mine.any():
                result[mine] = body.moved(points[mine], uv[mine], t, other)
        return result
