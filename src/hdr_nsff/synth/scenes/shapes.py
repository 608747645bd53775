"""Meshes, and what collects them into a scene: vertices (V, 3), faces (F, 3)
counter-clockwise seen from outside, uv (V, 2) in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hdr_nsff.synth.scenes.base import STILL, Part
from hdr_nsff.synth.scenes.geometry import rotation

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]


def quad(corner: np.ndarray, u: np.ndarray, v: np.ndarray) -> Mesh:
    """A parallelogram: vertices (4, 3), faces (2, 3), uv (4, 2). Its normal is u x v."""
    c, u, v = (np.asarray(a, float) for a in (corner, u, v))
    return (
        np.stack([c, c + u, c + u + v, c + v]),
        np.array([[0, 1, 2], [0, 2, 3]]),
        np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),
    )


def cuboid(size: tuple[float, float, float]) -> Mesh:
    """A box about the origin; its six sides show the 3 x 2 cells of the texture."""
    corners: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    uvs: list[np.ndarray] = []
    for cell, (axis, side) in enumerate((a, s) for s in (-1.0, 1.0) for a in range(3)):
        n, u, v = np.zeros(3), np.zeros(3), np.zeros(3)
        n[axis], u[(axis + 1) % 3], v[(axis + 2) % 3] = side / 2, side, 1.0
        vertices, triangles, uv = quad(n - u / 2 - v / 2, u, v)
        corners.append(vertices * np.asarray(size))
        faces.append(triangles + 4 * cell)
        uvs.append((uv + np.array([cell % 3, cell // 3])) / [3, 2])
    return np.concatenate(corners), np.concatenate(faces), np.concatenate(uvs)


def revolved(profile: np.ndarray, sides: int = 40) -> Mesh:
    """A surface of revolution about y; `profile` (P, 2) holds radius and y, downwards."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    points = np.stack(
        [
            np.column_stack([r * ring[:, 0], np.full(sides + 1, y), r * ring[:, 1]])
            for r, y in profile
        ]
    )
    uv = np.stack(np.meshgrid(np.linspace(0, 1, sides + 1), np.linspace(0, 1, len(profile))), -1)
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(sides), indexing="ij")
    a = (i * (sides + 1) + j).ravel()
    faces = np.concatenate(
        [np.stack([a, a + sides + 2, a + 1], -1), np.stack([a, a + sides + 1, a + sides + 2], -1)]
    )
    return points.reshape(-1, 3), faces, uv.reshape(-1, 2)


def sphere(radius: float, rings: int = 32) -> Mesh:
    """A sphere about the origin."""
    polar = np.linspace(0, np.pi, rings + 1)
    return revolved(radius * np.stack([np.sin(polar), -np.cos(polar)], -1), 2 * rings)


def cylinder(radius: float, height: float) -> Mesh:
    """An upright closed cylinder about the origin."""
    h = height / 2
    return revolved(np.array([[1e-4, -h], [radius, -h], [radius, h], [1e-4, h]]))


def sheet(rows: int, columns: int) -> Mesh:
    """A grid of cells of two triangles each, for `base.Deforming`; its vertices are its
    uv until a time says where they are.
    """
    uv = np.stack(
        np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1)), -1
    ).reshape(-1, 2)
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (i * (columns + 1) + j).ravel()
    right, below, opposite = a + 1, a + columns + 1, a + columns + 2
    faces = np.concatenate([np.stack([a, right, opposite], -1), np.stack([a, opposite, below], -1)])
    return np.column_stack([uv, np.zeros(len(uv))]), faces, uv


class Builder:
    """Collects parts; every texture is drawn from one generator, in order."""

    def __init__(self, seed: int, per_meter: int = 150):
        self.rng = np.random.default_rng(seed)
        self.per_meter = per_meter  # texture pixels
        self.parts: list[Part] = []

    def add(self, mesh: Mesh, texture: np.ndarray, at=(0, 0, 0), turn=0.0, body=STILL):
        """A mesh turned by `turn` degrees about the vertical and moved to `at`."""
        vertices = mesh[0] @ rotation(np.array([0.0, 1.0, 0.0]), np.radians(turn)).T + np.asarray(
            at, float
        )
        self.parts.append(
            Part(f"{body}{len(self.parts)}", vertices, mesh[1], mesh[2], texture, body)
        )

    def panel(self, corner, u, v, paint: Callable[..., np.ndarray], **style) -> None:
        """A flat panel painted at the scene's texture resolution."""
        w, h = (max(16, int(self.per_meter * np.linalg.norm(e))) for e in (u, v))
        self.add(quad(corner, u, v), paint(h, w, self.rng, **style))

    def block(
        self, size, at, paint: Callable[..., np.ndarray], turn=0.0, body=STILL, **style
    ) -> None:
        """A box whose sides show cells of one painting."""
        side = max(16, int(self.per_meter * max(size)))
        self.add(cuboid(size), paint(2 * side, 3 * side, self.rng, **style), at, turn, body)

    def light(self, corner, u, v, radiance: np.ndarray, circuit: str | None = None) -> None:
        """A flat light that shines along u x v."""
        vertices, faces, uv = quad(corner, u, v)
        self.parts.append(
            Part(
                f"light{len(self.parts)}",
                vertices,
                faces,
                uv,
                radiance,
                emits=True,
                circuit=circuit,
            )
        )

    def bulb(
        self, at, radius: float, radiance: np.ndarray, body=STILL, circuit: str | None = None
    ) -> None:
        """A round light of one color (3,)."""
        none, glow = np.zeros((0, 3), int), np.reshape(radiance, (1, 1, 3)).astype(float)
        name, center = f"bulb{len(self.parts)}", np.asarray(at, float)[None]
        self.parts.append(
            Part(
                name,
                center,
                none,
                np.zeros((1, 2)),
                glow,
                body,
                emits=True,
                circuit=circuit,
                radius=radius,
            )
        )


def room(
    b: Builder, bounds: tuple[float, ...], ceiling: Callable | None, sides: Callable, back: Callable
) -> None:
    """Both side walls, the back wall and, unless None, the ceiling, each with its
    painting; `bounds` are left, right, top, floor, front, back.
    """
    left, right, top, floor, front, rear = bounds
    depth, height, width = rear - front, floor - top, right - left
    if ceiling is not None:
        b.panel((left, top, front), (width, 0, 0), (0, 0, depth), ceiling)
    for x in (left, right):
        b.panel((x, top, front), (0, 0, depth), (0, height, 0), sides)
    b.panel((left, top, rear), (width, 0, 0), (0, height, 0), back)
