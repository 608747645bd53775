"""A room with a bright window and a bare bulb; a box tumbles through it and a ball
swings on a cord. Difficult: five decades of radiance.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from hdr_nsff.synth import textures
from hdr_nsff.synth.scenes.base import Part, Rigid, SynthScene
from hdr_nsff.synth.scenes.geometry import look_at, rotation
from hdr_nsff.synth.scenes.shapes import Builder, cylinder, quad, sphere

# Places and lengths in meters, periods in frames, all chosen by eye. The room:
LEFT, RIGHT = -1.45, 1.45
TOP, FLOOR = -1.15, 0.95
FRONT, BACK = -1.6, 3.4
WINDOW = (-1.0, -0.25, -0.72, 0.12)  # left, right, top, bottom in the back wall
PIVOT = np.array([0.26, TOP, 2.65])  # of the pendulum
CORD = 0.98  # meters from the pivot to the ball's center


def box_pose(t: float) -> np.ndarray:
    """The box tumbles about a skew axis while it crosses the room and back."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.array([0.55, 0.75, 0.35]), np.radians(7.0) * t)
    angle = 2 * np.pi * (t + 1) / 78
    x = -0.12 - 0.42 * np.cos(angle)
    y = 0.2 - 0.16 * np.sin(angle)
    z = 1.9 + 0.12 * np.sin(2 * angle)
    pose[:3, 3] = [x, y, z]
    return pose


def ball_pose(t: float) -> np.ndarray:
    """The ball swings on its cord, and its pattern with it, in a plane turned 20
    degrees out of the picture.
    """
    pose = np.eye(4)
    swing = np.radians(18.0) * np.sin(2 * np.pi * (t + 4) / 30)
    pose[:3, :3] = rotation(np.array([np.sin(0.35), 0.0, np.cos(0.35)]), swing)
    pose[:3, 3] = PIVOT
    return pose


def camera_pose(t: float) -> np.ndarray:
    """Camera to world, (3, 4) OpenCV, at time `t` in frames: a hand-held figure of
    eight, looking at the middle of the room.

    One loop takes 28 frames, so places recur at other times.
    """
    a = 2 * np.pi * t / 28 + 0.4
    shake = 0.008 * np.array([np.sin(1.9 * t), np.sin(1.3 * t + 1), np.sin(1.1 * t + 2)])
    eye = [0.34 * np.sin(a), -0.06 + 0.13 * np.sin(2 * a + 0.5), 0.14 * np.cos(0.77 * a)]
    target = [0.05 * np.sin(0.61 * a + 1), 0.02 + 0.04 * np.sin(0.9 * a), 3.0]
    return look_at(np.array(eye) + shake, np.array(target) + 1.5 * shake[::-1])


def build(seed: int) -> list[Part]:
    """Every part of the room."""
    b = Builder(seed)
    walls(b)
    furniture(b)
    movers(b)
    lights(b)
    return b.parts


def walls(b: Builder) -> None:
    """Floor, ceiling and walls, with posters 15 mm before them."""
    width, depth = RIGHT - LEFT, BACK - FRONT
    height = FLOOR - TOP
    b.panel((LEFT, FLOOR, FRONT), (width, 0, 0), (0, 0, depth), textures.tiles, rows=26)
    b.panel(
        (LEFT, TOP, FRONT),
        (width, 0, 0),
        (0, 0, depth),
        textures.planks,
        rows=24,
        base=(0.5, 0.42, 0.32),
    )
    b.panel((LEFT, TOP, FRONT), (0, 0, depth), (0, height, 0), textures.plaster)
    b.panel((RIGHT, TOP, FRONT), (0, 0, depth), (0, height, 0), textures.bricks, rows=24)
    b.panel((LEFT, TOP, FRONT), (width, 0, 0), (0, height, 0), textures.plaster)
    back_wall(b)
    for x, y, w, h in [
        (0.05, -0.8, 0.42, 0.55),
        (0.62, -0.6, 0.55, 0.4),
        (0.1, -0.12, 0.36, 0.3),
        (-0.9, 0.3, 0.5, 0.34),
    ]:
        b.panel((x, y, BACK - 0.015), (w, 0, 0), (0, h, 0), textures.poster)
    b.panel((RIGHT - 0.015, -0.55, 2.55), (0, 0, 0.7), (0, 0.75, 0), textures.poster)
    b.panel((LEFT + 0.015, -0.85, 2.2), (0, 0, 0.5), (0, 0.42, 0), textures.poster)
    window_bars(b)


def back_wall(b: Builder) -> None:
    """One painting of bricks on four panels around the window's hole."""
    left, right, top, bottom = WINDOW
    height, width = int(b.per_meter * (FLOOR - TOP)), int(b.per_meter * (RIGHT - LEFT))
    wall = textures.bricks(height, width, b.rng, rows=26, base=(0.34, 0.3, 0.24))
    panels = [
        (LEFT, left, TOP, FLOOR),
        (right, RIGHT, TOP, FLOOR),
        (left, right, TOP, top),
        (left, right, bottom, FLOOR),
    ]
    for x0, x1, y0, y1 in panels:
        rows = slice(int(b.per_meter * (y0 - TOP)), int(b.per_meter * (y1 - TOP)))
        columns = slice(int(b.per_meter * (x0 - LEFT)), int(b.per_meter * (x1 - LEFT)))
        panel = quad((x0, y0, BACK), (x1 - x0, 0, 0), (0, y1 - y0, 0))
        b.add(panel, np.ascontiguousarray(wall[rows, columns]))


def window_bars(b: Builder) -> None:
    """The window's frame and cross."""
    left, right, top, bottom = WINDOW
    for x in (left, (left + right) / 2, right):
        b.block((0.045, bottom - top, 0.06), (x, (top + bottom) / 2, BACK), textures.planks, rows=4)
    for y in (top, top + 0.55 * (bottom - top), bottom):
        b.block((right - left, 0.045, 0.06), ((left + right) / 2, y, BACK), textures.planks, rows=4)


def furniture(b: Builder) -> None:
    """A table with objects on it, a bookcase, a dark open cupboard, crates near the
    camera.
    """
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
    """An open cupboard of dark wood in the far right corner, below the lamp: hardly any
    light gets into it.
    """
    left, right = 0.85, 1.42
    top, front = 0.3, 2.95
    depth, height = BACK - front, FLOOR - top
    middle = (front + BACK) / 2
    wood = partial(textures.planks, base=(0.13, 0.09, 0.06), rows=6)
    b.block((right - left, 0.03, depth), ((left + right) / 2, top, middle), wood)
    b.block((0.03, height, depth), (left, (top + FLOOR) / 2, middle), wood)
    b.panel((left, top, BACK - 0.02), (right - left, 0, 0), (0, height, 0), wood)
    b.block((0.2, 0.2, 0.1), (1.05, FLOOR - 0.12, BACK - 0.15), textures.poster, paper=0.15)


def movers(b: Builder) -> None:
    """The tumbling box; the ball on its cord."""
    b.block((0.33, 0.28, 0.3), (0, 0, 0), textures.poster, body="box", figures=140)
    b.add(sphere(0.165), textures.poster(160, 320, b.rng, figures=120), (0, CORD, 0), body="ball")
    length = CORD - 0.16
    cord = textures.tiles(256, 16, b.rng, rows=20)
    b.add(cylinder(0.012, length), cord, (0, length / 2, 0), body="ball")


def lights(b: Builder) -> None:
    """The window's view, a little behind the back wall; a window behind the camera; a
    bare bulb on a stand.
    """
    left, right, top, bottom = WINDOW
    width, height = right - left + 0.3, bottom - top + 0.3
    outside = textures.sky(192, 176, b.rng)[:, ::-1]
    b.light((left - 0.15 + width, top - 0.15, BACK + 0.2), (-width, 0, 0), (0, height, 0), outside)
    dim = np.full((1, 1, 3), 5.0) * [0.85, 0.95, 1.1]
    b.light((-0.9, -0.9, FRONT + 0.02), (1.8, 0, 0), (0, 1.2, 0), dim)
    bulb = np.array([1.1, -0.6, 2.5])
    b.bulb(bulb, 0.03, 700.0 * np.array([1.0, 0.78, 0.52]))
    black = np.full((1, 1, 3), 0.02)  # a brighter socket would sparkle
    b.add(cylinder(0.018, 0.08), black, bulb + np.array([0, 0.078, 0]))
    length = FLOOR - bulb[1] - 0.1
    stand = textures.planks(256, 16, b.rng)
    b.add(cylinder(0.012, length), stand, bulb + np.array([0, 0.1 + length / 2, 0]))


INTERIOR = SynthScene(
    build=build,
    bodies=(Rigid("box", box_pose), Rigid("ball", ball_pose)),
    camera_pose=camera_pose,
    rig=(
        *((0.3 * k, -0.2, 0.0) for k in range(-2, 3)),
        *((0.45 - 0.3 * k, 0.08, 0.0) for k in range(4)),
    ),
    rig_target=(0.0, 0.02, 3.0),
    spp=256,
    truth_spp=768,
)
