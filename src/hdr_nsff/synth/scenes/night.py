"""An alley at night: a car turns round with its head lights on, somebody walks by with
a lantern, a lamp swings on a cable. Difficult: small, very bright lights move, and with
them the light on everything else; deep shadow; more than five decades of radiance.
"""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np

from hdr_nsff.synth import textures
from hdr_nsff.synth.scenes.base import Part, Rigid, SynthScene
from hdr_nsff.synth.scenes.geometry import look_at, rotation
from hdr_nsff.synth.scenes.shapes import Builder, cylinder, revolved, room, sphere

# Places and lengths in meters, periods in frames, all chosen by eye. The alley:
LEFT, RIGHT = -3.3, 3.3
TOP, FLOOR = -5.5, 1.5
FRONT, BACK = -4.0, 12.5
CABLE = np.array([0.9, -2.9, 6.4])  # where the swinging lamp hangs from
DROP = 1.9  # meters from there to the lamp
DIM = "dim lights"
BLACK = np.full((1, 1, 3), 0.02)  # close to lamps, where a brighter albedo would sparkle
HAND = np.array([0.44, -1.02, -0.12])  # of the walker, above the ground


def car_pose(t: float) -> np.ndarray:
    """The car, which looks along its -z, drives around an ellipse."""
    a = 2 * np.pi * t / 104 + 0.5
    across, along = 1.15 * np.cos(a), -2.4 * np.sin(a)  # its direction
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.array([0.0, 1.0, 0.0]), np.arctan2(-across, -along))
    pose[:3, 3] = [-0.2 + 1.15 * np.sin(a), FLOOR, 8.3 + 2.4 * np.cos(a)]
    return pose


def walker_pose(t: float) -> np.ndarray:
    """The walker crosses the alley and comes back, rocking."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.array([0.0, 0.3, 1.0]), 0.05 * np.sin(0.9 * t))
    x = -0.15 + 1.2 * np.sin(2 * np.pi * (t - 17) / 80)
    y = FLOOR - 0.04 * abs(np.sin(0.45 * t))
    z = 4.1 + 0.3 * np.cos(0.07 * t)
    pose[:3, 3] = [x, y, z]
    return pose


def lantern_pose(t: float) -> np.ndarray:
    """The lantern swings from the walker's hand."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.array([0.3, 0.0, 1.0]), 0.35 * np.sin(0.55 * t + 0.6))
    pose[:3, 3] = (walker_pose(t) @ [*HAND, 1.0])[:3]
    return pose


def bulb_pose(t: float) -> np.ndarray:
    """The lamp swings in the wind on its cable."""
    pose = np.eye(4)
    swing = np.radians(20.0) * np.sin(2 * np.pi * (t + 3) / 27)
    pose[:3, :3] = rotation(np.array([0.45, 0.0, 1.0]), swing)
    pose[:3, 3] = CABLE
    return pose


def camera_pose(t: float) -> np.ndarray:
    """Camera to world, (3, 4) OpenCV, at time `t` in frames: strolling from side to
    side, looking down the alley.
    """
    a = 2 * np.pi * t / 29 + 0.9
    shake = 0.016 * np.array([np.sin(1.8 * t), np.sin(1.3 * t + 1), np.sin(1.1 * t + 2)])
    eye = [0.62 * np.sin(a), -0.05 + 0.24 * np.sin(2 * a + 0.3), 0.3 * np.cos(0.8 * a)]
    target = [0.15 * np.sin(0.6 * a), 0.12 + 0.08 * np.sin(0.9 * a), 6.0]
    return look_at(np.array(eye) + shake, np.array(target) + 1.5 * shake[::-1])


def build(seed: int) -> list[Part]:
    """Every part of the alley."""
    b = Builder(seed, per_meter=70)
    houses(b)
    clutter(b)
    car(b)
    walker(b)
    lights(b)
    return b.parts


def houses(b: Builder) -> None:
    """Cobbles, and fronts of houses with doors, posters and a dark gateway."""
    width, depth = RIGHT - LEFT, BACK - FRONT
    b.panel((LEFT, FLOOR, FRONT), (width, 0, 0), (0, 0, depth), textures.tiles, rows=44)
    bricks = partial(textures.bricks, rows=36)
    room(b, (LEFT, RIGHT, TOP, FLOOR, FRONT, BACK), ceiling=None, sides=bricks, back=bricks)
    for x, y, w, h in [
        (-2.9, -0.7, 1.2, 2.2),
        (1.9, -0.6, 1.1, 2.1),
        (-1.2, -1.6, 1.3, 0.9),
        (0.5, -0.4, 0.9, 1.0),
    ]:
        b.panel((x, y, BACK - 0.03), (w, 0, 0), (0, h, 0), textures.poster)
    for side, z, w, h in [
        (-1, 5.2, 1.2, 1.3),
        (-1, 8.6, 1.6, 1.5),
        (1, 4.6, 1.1, 1.6),
        (1, 7.2, 1.5, 1.2),
        (1, 10.2, 1.2, 1.6),
    ]:
        x = side * (RIGHT - 0.03)
        b.panel((x, -0.9, z), (0, 0, w), (0, h, 0), textures.poster)
    for side, z in [(-1, 4.0), (-1, 7.4), (1, 6.3), (1, 9.4)]:  # buttresses
        b.block((0.5, 6.0, 0.35), (side * (RIGHT - 0.25), FLOOR - 3.0, z), textures.bricks, rows=60)


def clutter(b: Builder) -> None:
    """Crates, barrels and bins along the walls; posts near the camera."""
    for x, z, size, turn in [
        (-2.2, 4.6, 0.7, 20),
        (2.3, 5.2, 0.8, -15),
        (2.5, 8.4, 0.9, 30),
        (-2.5, 10.6, 0.9, 10),
        (-2.0, 3.6, 0.5, -30),
    ]:
        b.block((size, size, size), (x, FLOOR - size / 2, z), textures.poster, turn=turn)
    b.block((0.5, 0.45, 0.5), (-2.2, FLOOR - 0.92, 4.6), textures.planks, turn=-10)
    for x, z in [(2.0, 3.7), (-2.6, 6.2), (1.6, 11.4)]:
        b.add(cylinder(0.33, 0.95), textures.planks(96, 160, b.rng, rows=6), (x, FLOOR - 0.475, z))
    post = textures.tiles(320, 40, b.rng, rows=32)  # of the street lamp
    b.add(cylinder(0.06, 3.9), post, (-1.5, FLOOR - 1.95, 5.6))
    b.add(cylinder(0.05, 1.0), textures.tiles(120, 40, b.rng, rows=12), (1.45, FLOOR - 0.5, 2.9))
    b.add(cylinder(0.05, 1.0), textures.tiles(120, 40, b.rng, rows=12), (-1.5, FLOOR - 0.5, 2.7))


def car(b: Builder) -> None:
    """A boxy car; its head lights shine from hoods, so that they are two beams."""
    b.block((1.6, 0.55, 3.3), (0, -0.55, 0), textures.poster, body="car", paper=0.35)
    b.block((1.4, 0.5, 1.7), (0, -1.07, 0.2), textures.books, body="car")
    vertices, faces, uv = sphere(0.32, 16)
    wheel = (vertices * [0.4, 1, 1], faces, uv)
    for x, z in itertools.product((-0.72, 0.72), (-1.05, 1.05)):
        b.add(wheel, textures.tiles(48, 96, b.rng, rows=6), (x, -0.32, z), body="car")
    vertices, faces, uv = revolved(np.array([[0.11, -0.19], [0.11, 0.0], [0.01, 0.0]]))
    hood = (vertices[:, [0, 2, 1]], faces, uv)
    for x in (-0.58, 0.58):
        b.add(hood, BLACK, (x, -0.56, -1.65), body="car")
        b.bulb((x, -0.56, -1.74), 0.07, np.array([1800.0, 1740.0, 1560.0]), body="car")


def walker(b: Builder) -> None:
    """A wide coat, a head with a hat, an arm and the lantern."""
    radii = [0.01, 0.2, 0.27, 0.25, 0.36, 0.34, 0.01]
    heights = [-1.42, -1.36, -1.1, -0.75, -0.15, 0.0, 0.0]
    coat = revolved(np.column_stack([radii, heights]))
    b.add(coat, textures.poster(160, 240, b.rng, figures=90), body="walker")
    b.add(sphere(0.14), textures.plaster(60, 120, b.rng, base=0.6), (0, -1.55, 0), body="walker")
    hat = textures.planks(32, 96, b.rng, rows=4)
    b.add(cylinder(0.24, 0.05), hat, (0, -1.66, 0), body="walker")
    b.block((0.42, 0.1, 0.1), (0.24, -1.1, -0.1), textures.poster, body="walker")
    b.add(cylinder(0.008, 0.24), BLACK, (0, 0.12, 0), body="lantern")
    for y in (0.24, 0.46):
        b.add(cylinder(0.1, 0.03), BLACK, (0, y, 0), body="lantern")
    b.bulb((0, 0.35, 0), 0.055, np.array([450.0, 310.0, 165.0]), body="lantern")


def lights(b: Builder) -> None:
    """The lamp on the cable, a street lamp, a sign, lit windows, and hardly any sky."""
    cable = DROP - 0.06
    b.add(cylinder(0.01, cable), BLACK, (0, cable / 2, 0), body="bulb")
    b.add(cylinder(0.16, 0.05), BLACK, (0, DROP - 0.1, 0), body="bulb")
    b.bulb((0, DROP, 0), 0.06, np.array([750.0, 670.0, 500.0]), body="bulb")
    b.block((6.6, 0.02, 0.02), CABLE - [CABLE[0], 0.01, 0], textures.planks, rows=4)
    b.bulb((-1.5, FLOOR - 4.3, 5.6), 0.1, np.array([170.0, 105.0, 45.0]))
    sign = textures.poster(40, 80, b.rng) * np.array([6.0, 1.2, 3.0], np.float32)
    b.light((RIGHT - 0.1, -1.9, 7.0), (0, 0, 1.1), (0, 0.55, 0), sign, DIM)
    window = textures.books(64, 48, b.rng) * np.array([3.0, 2.0, 0.9], np.float32)
    b.light((-2.35, -2.3, BACK - 0.04), (0, 1.1, 0), (0.8, 0, 0), window, DIM)
    sky = np.full((1, 1, 3), 0.004) * [0.6, 0.8, 1.5]
    b.light((LEFT, TOP + 0.01, FRONT), (0, 0, BACK - FRONT), (RIGHT - LEFT, 0, 0), sky, DIM)


NIGHT = SynthScene(
    build=build,
    bodies=(
        Rigid("car", car_pose),
        Rigid("walker", walker_pose),
        Rigid("lantern", lantern_pose),
        Rigid("bulb", bulb_pose),
    ),
    camera_pose=camera_pose,
    rig=(
        *((0.5 * k, -0.3, 0.0) for k in range(-2, 3)),
        *((0.75 - 0.5 * k, 0.2, 0.0) for k in range(4)),
    ),
    rig_target=(0.0, 0.12, 6.0),
    ev="-6,-3,0",
    blur=0.12,
)
