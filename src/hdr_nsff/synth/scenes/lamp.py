"""A workshop lit by one bare globe; a crate on a rail, a hammer on a rod and a ball on
an arm rush past it. Difficult: sideways motion of more than a twentieth of the picture
per frame; each mover hides the lamp and the others; their shadows sweep the room.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from hdr_nsff.synth import textures
from hdr_nsff.synth.scenes.base import Part, Rigid, SynthScene
from hdr_nsff.synth.scenes.geometry import look_at, rotation
from hdr_nsff.synth.scenes.shapes import Builder, cylinder, room, sphere

# Places and lengths in meters, periods in frames, all chosen by eye. The workshop:
LEFT, RIGHT = -1.75, 1.75
TOP, FLOOR = -1.25, 1.0
FRONT, BACK = -1.5, 3.7
GLOBE = np.array([0.05, -0.1, 2.75])  # the lamp
RAIL = np.array([0.0, -0.5, 1.95])  # the crate hangs below its middle
HINGE = np.array([-0.1, -0.98, 2.3])  # of the hammer
ROD = 0.84  # meters from the hinge to the hammer's head
ARM = 0.62  # meters from the lamp to the ball


def crate_pose(t: float) -> np.ndarray:
    """The crate runs to and fro along its rail, at an even pace between the turns."""
    pose = np.eye(4)
    swing = 0.97 * np.sin(2 * np.pi * (t - 3) / 19)
    x = 0.68 * np.arcsin(swing) / np.arcsin(0.97)
    pose[:3, 3] = RAIL + np.array([x, 0.0, 0.0])
    return pose


def hammer_pose(t: float) -> np.ndarray:
    """The hammer swings in the picture's plane, past the crate."""
    pose = np.eye(4)
    swing = np.radians(40.0) * np.sin(2 * np.pi * (t + 2) / 13)
    pose[:3, :3] = rotation(np.array([0.0, 0.12, 1.0]), swing)
    pose[:3, 3] = HINGE
    return pose


def ball_pose(t: float) -> np.ndarray:
    """The ball circles the lamp: in front of it below the line of sight, behind it
    above.
    """
    pose = np.eye(4)
    tilt = rotation(np.array([1.0, 0.0, 0.0]), 0.22)
    circle = rotation(np.array([0.0, 1.0, 0.0]), 2 * np.pi * t / 13)
    pose[:3, :3] = tilt @ circle
    pose[:3, 3] = GLOBE + np.array([0.0, 0.17, 0.0])
    return pose


def camera_pose(t: float) -> np.ndarray:
    """Camera to world, (3, 4) OpenCV, at time `t` in frames: hand-held wide arcs with
    the lamp in the middle.
    """
    a = 2 * np.pi * t / 31 + 1.1
    shake = 0.008 * np.array([np.sin(1.7 * t + 1), np.sin(1.4 * t), np.sin(1.2 * t + 2)])
    eye = [0.36 * np.sin(a), -0.1 + 0.14 * np.sin(2 * a), 0.1 * np.cos(0.83 * a)]
    target = [0.05 * np.sin(0.7 * a), -0.04 + 0.03 * np.sin(0.9 * a), 3.0]
    return look_at(np.array(eye) + shake, np.array(target) + 1.5 * shake[::-1])


def build(seed: int) -> list[Part]:
    """Every part of the workshop."""
    b = Builder(seed)
    walls(b)
    furniture(b)
    movers(b)
    lights(b)
    return b.parts


def walls(b: Builder) -> None:
    """A room of bricks and boards with prints on them."""
    width, depth = RIGHT - LEFT, BACK - FRONT
    b.panel((LEFT, FLOOR, FRONT), (width, 0, 0), (0, 0, depth), textures.planks, rows=20)
    bounds = (LEFT, RIGHT, TOP, FLOOR, FRONT, BACK)
    bricks = partial(textures.bricks, rows=24)
    room(b, bounds, ceiling=textures.plaster, sides=bricks, back=textures.plaster)
    prints = [
        (-1.5, -0.85, 0.6, 0.45),
        (-0.75, -0.95, 0.4, 0.55),
        (0.35, -0.9, 0.5, 0.4),
        (1.05, -0.6, 0.5, 0.6),
        (-1.35, -0.2, 0.5, 0.4),
    ]
    for x, y, w, h in [*prints, (0.55, -0.3, 0.35, 0.4), (-0.7, -0.2, 0.4, 0.3)]:
        b.panel((x, y, BACK - 0.015), (w, 0, 0), (0, h, 0), textures.poster)
    b.panel((RIGHT - 0.015, -0.7, 2.2), (0, 0, 0.7), (0, 0.8, 0), textures.poster)
    b.panel((LEFT + 0.015, -0.7, 2.9), (0, 0, -0.7), (0, 0.8, 0), textures.poster)


def furniture(b: Builder) -> None:
    """A bench along the back wall, shelves, barrels, boxes, the rail and the hammer's
    beam.
    """
    b.block((3.2, 0.06, 0.5), (0, 0.42, BACK - 0.25), textures.planks, rows=6)
    b.block((3.1, 0.5, 0.04), (0, 0.72, BACK - 0.1), textures.books)
    for x, size in [(-1.3, 0.3), (-0.75, 0.2), (0.7, 0.24), (1.25, 0.32)]:
        b.block((size, size, 0.24), (x, 0.39 - size / 2, BACK - 0.28), textures.poster, turn=25 * x)
    b.add(cylinder(0.2, 0.55), textures.planks(120, 200, b.rng, rows=6), (-1.15, 0.72, 2.35))
    b.add(cylinder(0.2, 0.55), textures.tiles(120, 200, b.rng, rows=8), (1.2, 0.72, 2.5))
    b.block((0.4, 0.36, 0.36), (-0.62, 0.82, 1.95), textures.poster, turn=20)
    b.block((0.34, 0.3, 0.34), (0.68, 0.85, 1.9), textures.planks, turn=-25)
    b.add(sphere(0.13), textures.poster(120, 240, b.rng), (0.68, 0.57, 1.9))
    b.block((2 * RIGHT, 0.035, 0.035), RAIL, textures.planks, rows=4)
    b.block((2 * RIGHT, 0.08, 0.08), HINGE - [HINGE[0], 0.04, 0], textures.planks, rows=4)


def movers(b: Builder) -> None:
    """The crate with its hanger, the hammer and its rod, the ball and its arm."""
    b.block((0.4, 0.32, 0.24), (0, 0.42, 0), textures.poster, body="crate", paper=0.8, figures=140)
    b.block((0.04, 0.3, 0.02), (0, 0.13, 0), textures.planks, body="crate", rows=4)
    b.block((0.44, 0.24, 0.22), (0, ROD, 0), textures.poster, body="hammer", figures=120)
    rod, arm = ROD - 0.1, ARM - 0.1
    bands = textures.tiles(256, 16, b.rng, rows=20)
    b.add(cylinder(0.014, rod), bands, (0, rod / 2, 0), body="hammer")
    b.add(sphere(0.17), textures.poster(160, 320, b.rng, figures=120), (0, 0, ARM), body="ball")
    b.block((0.025, 0.025, arm), (0, 0, arm / 2), textures.planks, body="ball", rows=4)


def lights(b: Builder) -> None:
    """The globe on its stand, and a dim panel behind the camera, without which surfaces
    seen against the light would be black.
    """
    b.bulb(GLOBE, 0.06, np.array([300.0, 250.0, 180.0]))
    b.add(cylinder(0.03, 0.1), np.full((1, 1, 3), 0.02), GLOBE + np.array([0, 0.11, 0]))
    length = FLOOR - GLOBE[1] - 0.16
    stand = textures.planks(256, 16, b.rng)
    b.add(cylinder(0.02, length), stand, GLOBE + np.array([0, 0.16 + length / 2, 0]))
    dim = np.full((1, 1, 3), 2.4) * [0.8, 0.95, 1.2]
    b.light((-1.2, -1.1, FRONT + 0.02), (2.4, 0, 0), (0, 1.0, 0), dim)


LAMP = SynthScene(
    build=build,
    bodies=(Rigid("crate", crate_pose), Rigid("hammer", hammer_pose), Rigid("ball", ball_pose)),
    camera_pose=camera_pose,
    rig=(
        *((0.3 * k, -0.22, 0.0) for k in range(-2, 3)),
        *((0.45 - 0.3 * k, 0.06, 0.0) for k in range(4)),
    ),
    rig_target=(0.0, -0.04, 3.0),
)
