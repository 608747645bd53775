"""Meshes, and a builder that collects them into a scene. A mesh is vertices (V, 3),
faces (F, 3) counter-clockwise seen from outside, uv (V, 2) in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hdr_nsff.synth.scenes.base import STATIC_BODY, Part
from hdr_nsff.synth.scenes.geometry import rotation

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]
Paint = Callable[..., np.ndarray]  # (height, width, rng, **style) to a texture (H, W, 3)
Point = Sequence[float] | np.ndarray  # (3,) meters
MIN_TEXTURE_PX = 16  # on a side, so that small parts have a texture too


def quad(corner: Point, u: Point, v: Point) -> Mesh:
    """A parallelogram with edges `u` and `v`; its normal is u x v."""
    c = np.asarray(corner, float)
    u = np.asarray(u, float)
    v = np.asarray(v, float)
    vertices = np.stack([c, c + u, c + u + v, c + v])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    return vertices, faces, uv


def cuboid(size: tuple[float, float, float]) -> Mesh:
    """A box about the origin; its six sides show the 3 x 2 cells of the texture."""
    corners: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    uvs: list[np.ndarray] = []
    for cell in range(6):
        row, axis = divmod(cell, 3)
        side = (-1.0, 1.0)[row]
        n = np.zeros(3)
        u = np.zeros(3)
        v = np.zeros(3)
        n[axis] = side / 2
        u[(axis + 1) % 3] = side
        v[(axis + 2) % 3] = 1.0
        vertices, triangles, uv = quad(n - u / 2 - v / 2, u, v)
        corners.append(vertices * np.asarray(size))
        faces.append(triangles + 4 * cell)
        uvs.append((uv + np.array([axis, row])) / [3, 2])
    return np.concatenate(corners), np.concatenate(faces), np.concatenate(uvs)


def revolved(profile: np.ndarray, sides: int = 40) -> Mesh:
    """A surface of revolution about y; `profile` (P, 2) is radius and y, downwards."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    radius = profile[:, 0, None]
    y = np.broadcast_to(profile[:, 1, None], (len(profile), sides + 1))
    points = np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], -1)
    uv = grid_uv(len(profile) - 1, sides)
    here, right, below, opposite = cell_corners(len(profile) - 1, sides)
    first = np.stack([here, opposite, right], -1)
    second = np.stack([here, below, opposite], -1)
    return points.reshape(-1, 3), np.concatenate([first, second]), uv


def sphere(radius: float, rings: int = 32) -> Mesh:
    """A sphere about the origin."""
    polar = np.linspace(0, np.pi, rings + 1)
    return revolved(radius * np.stack([np.sin(polar), -np.cos(polar)], -1), 2 * rings)


def cylinder(radius: float, height: float) -> Mesh:
    """An upright closed cylinder about the origin."""
    h = height / 2
    return revolved(np.array([[1e-4, -h], [radius, -h], [radius, h], [1e-4, h]]))


def sheet(rows: int, columns: int) -> Mesh:
    """A grid of cells of two triangles each, for `base.Deforming`. Its vertices are its
    uv; the body's shape at a time replaces them.
    """
    uv = grid_uv(rows, columns)
    here, right, below, opposite = cell_corners(rows, columns)
    upper = np.stack([here, right, opposite], -1)
    lower = np.stack([here, opposite, below], -1)
    flat = np.column_stack([uv, np.zeros(len(uv))])
    return flat, np.concatenate([upper, lower]), uv


def grid_uv(rows: int, columns: int) -> np.ndarray:
    """Texture coordinates (V, 2) of the corners of `rows` x `columns` cells, row by
    row.
    """
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    return np.stack([u, v], -1).reshape(-1, 2)


def cell_corners(rows: int, columns: int) -> tuple[np.ndarray, ...]:
    """Indices (rows * columns,) into such a grid: each cell's upper left, upper right,
    lower left and lower right corner.
    """
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    here = (i * (columns + 1) + j).ravel()
    return here, here + 1, here + columns + 1, here + columns + 2


class Builder:
    """Collects parts; every texture is drawn from one generator, in order. Textures of
    panels and blocks have `per_meter` pixels per meter.
    """

    def __init__(self, seed: int, per_meter: int = 150):
        self.rng = np.random.default_rng(seed)
        self.per_meter = per_meter
        self.parts: list[Part] = []

    def add(
        self,
        mesh: Mesh,
        texture: np.ndarray,
        at: Point = (0, 0, 0),
        turn: float = 0.0,
        body: str = STATIC_BODY,
    ) -> None:
        """A mesh turned by `turn` degrees about the vertical and moved to `at`."""
        vertices, faces, uv = mesh
        turned = vertices @ rotation(np.array([0.0, 1.0, 0.0]), np.radians(turn)).T
        placed = turned + np.asarray(at, float)
        self.parts.append(Part(f"{body}{len(self.parts)}", placed, faces, uv, texture, body))

    def panel(self, corner: Point, u: Point, v: Point, paint: Paint, **style: Any) -> None:
        """A flat panel painted at the scene's texture resolution."""
        width = max(MIN_TEXTURE_PX, int(self.per_meter * np.linalg.norm(u)))
        height = max(MIN_TEXTURE_PX, int(self.per_meter * np.linalg.norm(v)))
        self.add(quad(corner, u, v), paint(height, width, self.rng, **style))

    def block(
        self,
        size: tuple[float, float, float],
        at: Point,
        paint: Paint,
        turn: float = 0.0,
        body: str = STATIC_BODY,
        **style: Any,
    ) -> None:
        """A box whose sides show cells of one painting."""
        side = max(MIN_TEXTURE_PX, int(self.per_meter * max(size)))
        self.add(cuboid(size), paint(2 * side, 3 * side, self.rng, **style), at, turn, body)

    def light(
        self, corner: Point, u: Point, v: Point, radiance: np.ndarray, circuit: str | None = None
    ) -> None:
        """A flat light that shines along u x v."""
        vertices, faces, uv = quad(corner, u, v)
        name = f"light{len(self.parts)}"
        part = Part(name, vertices, faces, uv, radiance, emits=True, circuit=circuit)
        self.parts.append(part)

    def bulb(
        self,
        at: Point,
        radius: float,
        radiance: np.ndarray,
        body: str = STATIC_BODY,
        circuit: str | None = None,
    ) -> None:
        """A round light of one color (3,)."""
        part = Part(
            name=f"bulb{len(self.parts)}",
            vertices=np.asarray(at, float)[None],
            faces=np.zeros((0, 3), int),
            uv=np.zeros((1, 2)),
            texture=np.reshape(radiance, (1, 1, 3)).astype(float),
            body=body,
            emits=True,
            circuit=circuit,
            radius=radius,
        )
        self.parts.append(part)


def room(
    b: Builder, bounds: tuple[float, ...], ceiling: Paint | None, sides: Paint, back: Paint
) -> None:
    """Both side walls, the back wall and, unless None, the ceiling, each with its
    painting; `bounds` are left, right, top, floor, front, back.
    """
    left, right, top, floor, front, rear = bounds
    width, height = right - left, floor - top
    depth = rear - front
    if ceiling is not None:
        b.panel((left, top, front), (width, 0, 0), (0, 0, depth), ceiling)
    for x in (left, right):
        b.panel((x, top, front), (0, 0, depth), (0, height, 0), sides)
    b.panel((left, top, rear), (width, 0, 0), (0, height, 0), back)
