"""The synthetic room: meshes, lights, the motion of its two movers, its cameras, as plain arrays of a time in frames.

World axes are the camera's at rest (OpenCV: +x right, +y down, +z forward), metres. Every part belongs to a rigid body;
`body_pose(body, t)` carries body coordinates to the world, so a surface point's motion is known exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hdr_nsff import synth_textures as textures

BODIES = ("room", "box", "ball")  # the first stands still
PER_METRE = 150  # texture pixels
LEFT, RIGHT, TOP, FLOOR, FRONT, BACK = -1.45, 1.45, -1.15, 0.95, -1.6, 3.4  # the room
WINDOW = (-1.0, -0.25, -0.72, 0.12)  # left, right, top, bottom in the back wall
PIVOT = np.array([0.26, TOP, 2.65])  # of the pendulum
CORD = 0.98  # metres from the pivot to the ball's centre
RIG = [*((0.3 * k, -0.2, 0.0) for k in range(-2, 3)), *((0.45 - 0.3 * k, 0.08, 0.0) for k in range(4))]  # cameras, once around
RIG_TARGET = (0.0, 0.02, 3.0)


@dataclass(frozen=True)
class Part:
    """A textured triangle mesh in its body's coordinates."""

    name: str
    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3) counter-clockwise seen from outside
    uv: np.ndarray  # (V, 2) in [0, 1], v down the texture
    texture: np.ndarray  # (H, W, 3) albedo, radiance where it emits; (1, 1, 3) for one colour
    body: str = "room"
    emits: bool = False
    radius: float | None = None  # an exact sphere about the first vertex: lights of that shape are sampled without noise


def body_pose(body: str, t: float) -> np.ndarray:
    """Body to world, (4, 4), at time `t` in frames."""
    pose = np.eye(4)
    if body == "box":  # tumbles about a skew axis while it crosses the room and back
        pose[:3, :3] = rotation(np.array([0.55, 0.75, 0.35]), np.radians(7.0) * t)
        angle = 2 * np.pi * (t + 1) / 78
        pose[:3, 3] = [-0.12 - 0.42 * np.cos(angle), 0.2 - 0.16 * np.sin(angle), 1.9 + 0.12 * np.sin(2 * angle)]
    elif body == "ball":  # swings on its cord, in a plane turned 20 degrees out of the picture, the ball's pattern with it
        swing = np.radians(18.0) * np.sin(2 * np.pi * (t + 4) / 30)
        pose[:3, :3] = rotation(np.array([np.sin(0.35), 0.0, np.cos(0.35)]), swing)
        pose[:3, 3] = PIVOT
    return pose


def camera_pose(t: float) -> np.ndarray:
    """Camera to world, (3, 4) OpenCV, at time `t` in frames: a figure of eight by hand, looking at the middle of the room.

    One loop takes 28 frames, so that places recur at other times."""
    a = 2 * np.pi * t / 28 + 0.4
    shake = 0.008 * np.array([np.sin(1.9 * t), np.sin(1.3 * t + 1), np.sin(1.1 * t + 2)])
    eye = np.array([0.34 * np.sin(a), -0.06 + 0.13 * np.sin(2 * a + 0.5), 0.14 * np.cos(0.77 * a)]) + shake
    target = np.array([0.05 * np.sin(0.61 * a + 1), 0.02 + 0.04 * np.sin(0.9 * a), 3.0]) + 1.5 * shake[::-1]
    return look_at(eye, target)


def rig_pose(t: float) -> np.ndarray:
    """Camera to world, (3, 4) OpenCV, of the rig's camera `t` modulo nine, which records frame `t`.

    Two rows of cameras that stand still, 1.2 metres from end to end, numbered around: whoever records next stands beside."""
    return look_at(np.array(RIG[round(t) % len(RIG)]), np.array(RIG_TARGET))


POSES: dict[str, Callable[[float], np.ndarray]] = {"mono": camera_pose, "rig": rig_pose}  # of the clip's frames


def intrinsics(width: int, height: int) -> np.ndarray:
    """K (3, 3) in pixels of a camera that sees 57 degrees across."""
    focal = width / 2 / np.tan(np.radians(57 / 2))
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera to world (3, 4) at `eye`, +z towards `target`, level (+y of the world is down)."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z, eye], 1)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) by Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def project(points: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2), centres at +0.5, and z-depth (...) of world points (..., 3)."""
    local = (points - c2w[:, 3]) @ c2w[:, :3]
    depth = local[..., 2]
    return local[..., :2] / depth[..., None] * K[[0, 1], [0, 1]] + K[:2, 2], depth


def back_project(depth: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """World points (H, W, 3) at z-depth (H, W) on the rays through the pixel centres."""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    return c2w[:, 3] + depth[..., None] * (rays @ c2w[:, :3].T)


def moved(points: np.ndarray, bodies: np.ndarray, t: float, other: float) -> np.ndarray:
    """Where world points (..., 3) on `bodies` (...), indices into BODIES, at time `t` are at time `other`."""
    result = points.copy()
    for index, body in enumerate(BODIES[1:], 1):
        carry = body_pose(body, other) @ np.linalg.inv(body_pose(body, t))
        mine = bodies == index
        result[mine] = points[mine] @ carry[:3, :3].T + carry[:3, 3]
    return result


# Shapes


def quad(corner: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A parallelogram: vertices (4, 3), faces (2, 3), uv (4, 2). Its normal is u x v."""
    c, u, v = (np.asarray(a, float) for a in (corner, u, v))
    return np.stack([c, c + u, c + u + v, c + v]), np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])


def cuboid(size: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def revolved(profile: np.ndarray, sides: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A surface of revolution about y; `profile` (P, 2) holds radius and y, downwards."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    points = np.stack([np.column_stack([r * ring[:, 0], np.full(sides + 1, y), r * ring[:, 1]]) for r, y in profile])
    uv = np.stack(np.meshgrid(np.linspace(0, 1, sides + 1), np.linspace(0, 1, len(profile))), -1)
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(sides), indexing="ij")
    a = (i * (sides + 1) + j).ravel()
    faces = np.concatenate([np.stack([a, a + sides + 2, a + 1], -1), np.stack([a, a + sides + 1, a + sides + 2], -1)])
    return points.reshape(-1, 3), faces, uv.reshape(-1, 2)


def sphere(radius: float, rings: int = 32) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sphere about the origin."""
    polar = np.linspace(0, np.pi, rings + 1)
    return revolved(radius * np.stack([np.sin(polar), -np.cos(polar)], -1), 2 * rings)


def cylinder(radius: float, height: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An upright closed cylinder about the origin."""
    h = height / 2
    return revolved(np.array([[1e-4, -h], [radius, -h], [radius, h], [1e-4, h]]))


# The room


class Builder:
    """Collects parts; every texture is drawn from one generator, in order."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)
        self.parts: list[Part] = []

    def add(self, mesh: tuple[np.ndarray, np.ndarray, np.ndarray], texture: np.ndarray, at=(0, 0, 0), turn=0.0, body="room"):
        """A mesh turned by `turn` degrees about the vertical and moved to `at`."""
        vertices = mesh[0] @ rotation(np.array([0.0, 1.0, 0.0]), np.radians(turn)).T + np.asarray(at, float)
        self.parts.append(Part(f"{body}{len(self.parts)}", vertices, mesh[1], mesh[2], texture, body))

    def panel(self, corner, u, v, paint: Callable[..., np.ndarray], **style) -> None:
        """A flat panel painted at the room's texture resolution."""
        w, h = (max(16, int(PER_METRE * np.linalg.norm(e))) for e in (u, v))
        self.add(quad(corner, u, v), paint(h, w, self.rng, **style))

    def block(self, size, at, paint: Callable[..., np.ndarray], turn=0.0, body="room", **style) -> None:
        """A box whose sides show cells of one painting."""
        side = max(16, int(PER_METRE * max(size)))
        self.add(cuboid(size), paint(2 * side, 3 * side, self.rng, **style), at, turn, body)

    def light(self, corner, u, v, radiance: np.ndarray) -> None:
        """A flat light that shines along u x v."""
        vertices, faces, uv = quad(corner, u, v)
        self.parts.append(Part(f"light{len(self.parts)}", vertices, faces, uv, radiance, emits=True))


def build(seed: int) -> list[Part]:
    """Every part of the room."""
    b = Builder(seed)
    walls(b)
    furniture(b)
    movers(b)
    lights(b)
    return b.parts


def walls(b: Builder) -> None:
    """Floor, ceiling and walls; the back wall has a hole for the window; posters hang a finger's breadth before them."""
    width, depth, height = RIGHT - LEFT, BACK - FRONT, FLOOR - TOP
    b.panel((LEFT, FLOOR, FRONT), (width, 0, 0), (0, 0, depth), textures.tiles, rows=26)
    b.panel((LEFT, TOP, FRONT), (width, 0, 0), (0, 0, depth), textures.planks, rows=24, base=(0.5, 0.42, 0.32))
    b.panel((LEFT, TOP, FRONT), (0, 0, depth), (0, height, 0), textures.plaster)
    b.panel((RIGHT, TOP, FRONT), (0, 0, depth), (0, height, 0), textures.bricks, rows=24)
    b.panel((LEFT, TOP, FRONT), (width, 0, 0), (0, height, 0), textures.plaster)
    left, right, top, bottom = WINDOW
    wall = textures.bricks(int(PER_METRE * height), int(PER_METRE * width), b.rng, rows=26, base=(0.34, 0.3, 0.24))
    for x0, x1, y0, y1 in [
        (LEFT, left, TOP, FLOOR),
        (right, RIGHT, TOP, FLOOR),
        (left, right, TOP, top),
        (left, right, bottom, FLOOR),
    ]:
        ys, ye, xs, xe = (int(PER_METRE * v) for v in (y0 - TOP, y1 - TOP, x0 - LEFT, x1 - LEFT))
        b.add(
            quad(np.array([x0, y0, BACK]), np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0])),
            np.ascontiguousarray(wall[ys:ye, xs:xe]),
        )
    for x, y, w, h in [(0.05, -0.8, 0.42, 0.55), (0.62, -0.6, 0.55, 0.4), (0.1, -0.12, 0.36, 0.3), (-0.9, 0.3, 0.5, 0.34)]:
        b.panel((x, y, BACK - 0.015), (w, 0, 0), (0, h, 0), textures.poster)
    b.panel((RIGHT - 0.015, -0.55, 2.55), (0, 0, 0.7), (0, 0.75, 0), textures.poster)
    b.panel((LEFT + 0.015, -0.85, 2.2), (0, 0, 0.5), (0, 0.42, 0), textures.poster)
    for x in (left, (left + right) / 2, right):
        b.block((0.045, bottom - top, 0.06), (x, (top + bottom) / 2, BACK), textures.planks, rows=4)
    for y in (top, top + 0.55 * (bottom - top), bottom):
        b.block((right - left, 0.045, 0.06), ((left + right) / 2, y, BACK), textures.planks, rows=4)


def furniture(b: Builder) -> None:
    """A table with things on it, a bookcase, a dark open cupboard, crates near the camera."""
    b.block((1.05, 0.04, 0.6), (0.2, 0.55, 2.7), textures.planks, turn=8)
    for x, z in [(-0.22, 2.5), (0.62, 2.38), (-0.12, 3.0), (0.7, 2.9)]:
        b.block((0.05, 0.38, 0.05), (x, 0.76, z), textures.planks, rows=4)
    b.block((0.2, 0.14, 0.16), (-0.1, 0.46, 2.75), textures.poster, turn=25)
    b.block((0.13, 0.24, 0.13), (0.17, 0.41, 2.86), textures.poster, turn=-20)
    b.add(cylinder(0.075, 0.2), textures.poster(64, 128, b.rng), (0.55, 0.43, 2.75))
    b.add(sphere(0.09), textures.tiles(96, 192, b.rng, rows=8), (0.36, 0.44, 2.55))
    for shelf in range(3):  # against the left wall: spines on boards
        y = -0.2 + 0.4 * shelf
        b.panel((LEFT + 0.24, y - 0.31, 2.0), (0, 0, 1.05), (0, 0.31, 0), textures.books)
        b.block((0.28, 0.03, 1.12), (LEFT + 0.14, y + 0.015, 2.52), textures.planks, rows=4)
    cupboard(b)
    b.block((0.34, 0.34, 0.34), (-0.72, 0.78, 1.75), textures.poster, turn=28)
    b.block((0.24, 0.2, 0.24), (-0.7, 0.51, 1.75), textures.planks, turn=-15)
    b.add(cylinder(0.085, 0.9), textures.tiles(300, 180, b.rng, rows=15), (0.78, 0.5, 1.75))
    b.add(sphere(0.13), textures.poster(120, 240, b.rng), (0.78, -0.05, 1.75))


def cupboard(b: Builder) -> None:
    """An open cupboard of dark wood in the far right corner, below the lamp: hardly any light finds its way into it."""
    x0, x1, y0, y1, z0 = 0.85, 1.42, 0.3, FLOOR, 2.95
    wood = {"base": (0.13, 0.09, 0.06), "rows": 6}
    b.block((x1 - x0, 0.03, BACK - z0), ((x0 + x1) / 2, y0, (z0 + BACK) / 2), textures.planks, **wood)
    b.block((0.03, y1 - y0, BACK - z0), (x0, (y0 + y1) / 2, (z0 + BACK) / 2), textures.planks, **wood)
    b.panel((x0, y0, BACK - 0.02), (x1 - x0, 0, 0), (0, y1 - y0, 0), textures.planks, **wood)
    b.block((0.2, 0.2, 0.1), (1.05, y1 - 0.12, BACK - 0.15), textures.poster, paper=0.15)


def movers(b: Builder) -> None:
    """The tumbling box; the ball on its cord."""
    b.block((0.33, 0.28, 0.3), (0, 0, 0), textures.poster, body="box", figures=140)
    b.add(sphere(0.165), textures.poster(160, 320, b.rng, figures=120), (0, CORD, 0), body="ball")
    b.add(cylinder(0.012, CORD - 0.16), textures.tiles(256, 16, b.rng, rows=20), (0, (CORD - 0.16) / 2, 0), body="ball")


def lights(b: Builder) -> None:
    """The window's view, a little behind the back wall; a window behind the camera; a bare bulb on a stand."""
    left, right, top, bottom = WINDOW
    w, h = right - left + 0.3, bottom - top + 0.3
    b.light((left - 0.15 + w, top - 0.15, BACK + 0.2), (-w, 0, 0), (0, h, 0), textures.sky(192, 176, b.rng)[:, ::-1])
    b.light((-0.9, -0.9, FRONT + 0.02), (1.8, 0, 0), (0, 1.2, 0), np.full((1, 1, 3), 5.0) * [0.85, 0.95, 1.1])
    at = np.array([1.1, -0.6, 2.5])
    glow = np.full((1, 1, 3), 700.0) * [1.0, 0.78, 0.52]
    b.parts.append(Part("bulb", at[None], np.zeros((0, 3), int), np.zeros((1, 2)), glow, emits=True, radius=0.03))
    stand = FLOOR - at[1] - 0.1
    b.add(cylinder(0.018, 0.08), np.full((1, 1, 3), 0.02), at + np.array([0, 0.078, 0]))  # black, or it sparkles
    b.add(cylinder(0.012, stand), textures.planks(256, 16, b.rng), at + np.array([0, 0.1 + stand / 2, 0]))
