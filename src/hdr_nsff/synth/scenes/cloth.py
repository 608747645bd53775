"""A courtyard on a windy day: a cloth waves on its line, an inflated tube bends and
breathes. Difficult: no mover is rigid. Both are meshes whose every vertex is a formula
of time. The soft light is an environment map (see `sky.exr` in NOTICE), the hard light
a sun.
"""

from __future__ import annotations

from functools import partial
from importlib import resources
from pathlib import Path

import numpy as np

from hdr_nsff.core.exr import read_exr
from hdr_nsff.synth import textures
from hdr_nsff.synth.scenes.base import Deforming, Part, SynthScene
from hdr_nsff.synth.scenes.geometry import look_at
from hdr_nsff.synth.scenes.shapes import Builder, cylinder, room, sheet, sphere

# Places and lengths in meters, periods in frames, all chosen by eye. The courtyard:
LEFT, RIGHT = -3.7, 3.7
TOP, FLOOR = -3.6, 1.25
BACK = 6.6
LINE = np.array([-0.98, -0.72, 2.8])  # the left end of the cloth's upper edge
WIDTH, HEIGHT = 1.6, 1.15  # of the cloth
TURN = np.radians(28.0)  # of its line out of the picture's plane
ALONG = np.array([np.cos(TURN), 0.0, np.sin(TURN)])  # the line
OUT = np.array([np.sin(TURN), 0.0, -np.cos(TURN)])  # across it
FOOT = np.array([1.02, FLOOR, 2.6])  # of the tube
TALL, THICK = 1.9, 0.19  # height and radius of the tube


def phase(t: float, period: float) -> float:
    """The phase in radians at time `t` of what repeats every `period`, in frames."""
    return 2 * np.pi * t / period


def cloth_shape(uv: np.ndarray, t: float) -> np.ndarray:
    """World points (..., 3) of the cloth: it is pinned along its upper edge, and waves
    run across it and grow downwards.
    """
    u, v = uv[..., 0], uv[..., 1]
    loose = v**0.8
    wave = phase(t, 13.0)
    ripple = phase(t, 9.0)
    sway = phase(t, 19.0)
    waves = 0.2 * np.sin(6.5 * u + 1.5 * v - wave)
    ripples = 0.06 * np.sin(11 * u - 3 * v - ripple + 1)
    out = waves + ripples + 0.2 * np.sin(sway + 0.5)
    x = WIDTH * (u - 0.05 * loose * np.sin(5 * u - wave + 0.8)) + 0.14 * v * np.sin(sway)
    rising_hem = HEIGHT * v * (1 - 0.06 * np.cos(6.5 * u - wave))
    y = rising_hem + 0.05 * np.sin(np.pi * u)  # the line sags
    down = np.array([0.0, 1.0, 0.0])
    return LINE + x[..., None] * ALONG + y[..., None] * down + (loose * out)[..., None] * OUT


def tube_shape(uv: np.ndarray, t: float) -> np.ndarray:
    """World points (..., 3) of the tube: it stands on the ground, sways more the
    higher, and bulges travel up in it.
    """
    angle, height = 2 * np.pi * uv[..., 0], 1 - uv[..., 1]
    sway = phase(t, 21.0)
    lean = phase(t, 15.0)
    breath = phase(t, 12.0)
    x = 0.36 * height**2 * np.sin(sway) - 0.14 * height**3 * np.sin(2 * sway + 1)
    z = 0.28 * height**2 * np.cos(lean)
    round_top = np.sqrt(np.clip(1 - ((height - 0.93) / 0.07).clip(0) ** 2, 0, 1))
    radius = THICK * (1 + 0.16 * np.sin(breath - 7 * height)) * round_top
    y = -TALL * (height - 0.1 * height**2 * np.sin(sway) ** 2)
    return FOOT + np.stack([x + radius * np.cos(angle), y, z + radius * np.sin(angle)], -1)


def camera_pose(t: float) -> np.ndarray:
    """Camera to world, (3, 4) OpenCV, at time `t` in frames: hand-held, around the
    cloth.
    """
    a = 2 * np.pi * t / 30 + 2.2
    shake = 0.008 * np.array([np.sin(1.6 * t), np.sin(1.2 * t + 1), np.sin(1.3 * t + 2)])
    eye = [0.42 * np.sin(a), -0.12 + 0.16 * np.sin(2 * a + 0.4), 0.16 * np.cos(0.79 * a)]
    target = [-0.02 + 0.06 * np.sin(0.6 * a), -0.08 + 0.04 * np.sin(0.9 * a), 3.4]
    return look_at(np.array(eye) + shake, np.array(target) + 1.5 * shake[::-1])


def sky() -> np.ndarray:
    """Radiance (H, W, 3) from all around."""
    with resources.as_file(resources.files("hdr_nsff.synth.scenes") / "sky.exr") as path:
        return 0.6 * read_exr(Path(path))["RGB"]


def build(seed: int) -> list[Part]:
    """Every part of the courtyard."""
    b = Builder(seed, per_meter=90)
    walls(b)
    yard(b)
    movers(b)
    b.bulb((-9.0, -16.0, -5.0), 0.35, np.array([6000.0, 5400.0, 4500.0]))  # the sun
    return b.parts


def walls(b: Builder) -> None:
    """Paving; walls with posters and windows; a gate that lets in the light of the
    street.
    """
    b.panel((LEFT, FLOOR, -1.0), (RIGHT - LEFT, 0, 0), (0, 0, BACK + 1.0), textures.tiles, rows=30)
    bricks = partial(textures.bricks, rows=30)
    room(b, (LEFT, RIGHT, TOP, FLOOR, -1.0, BACK), ceiling=None, sides=bricks, back=bricks)
    for x, y, w, h in [
        (-1.0, -1.7, 0.8, 0.9),
        (0.2, -1.9, 1.0, 0.7),
        (1.7, -2.1, 0.8, 0.8),
        (-0.7, -0.3, 0.7, 0.9),
        (0.3, -0.7, 0.6, 0.6),
    ]:
        b.panel((x, y, BACK - 0.03), (w, 0, 0), (0, h, 0), textures.poster)
    for side, z, w, h in [
        (-1, 3.4, 1.0, 0.9),
        (-1, 5.0, 1.0, 1.2),
        (1, 3.2, 0.9, 1.1),
        (1, 4.6, 1.1, 0.9),
    ]:
        b.panel((side * (RIGHT - 0.03), -1.1, z), (0, 0, w), (0, h, 0), textures.poster)
    gate(b)


def gate(b: Builder) -> None:
    """Light from the street between two posts and a beam."""
    left, right = -3.1, -2.05
    top = -1.2
    height = FLOOR - top
    street = 2.5 * textures.sky(180, 96, b.rng)[:, ::-1]
    b.light((right, top, BACK - 0.02), (left - right, 0, 0), (0, height, 0), street)
    for x in (left, right):
        b.block((0.16, height, 0.2), (x, (top + FLOOR) / 2, BACK), textures.planks, rows=4)
    beam = (right - left + 0.3, 0.16, 0.2)
    b.block(beam, ((left + right) / 2, top, BACK), textures.planks, rows=4)


def yard(b: Builder) -> None:
    """The line between its posts, a dark shed with an open front, pots, crates and
    barrels.
    """
    height = FLOOR - LINE[1] + 0.1
    for along in (-0.12, WIDTH + 0.12):
        x, z = (LINE + along * ALONG)[[0, 2]]
        bands = textures.tiles(240, 40, b.rng, rows=24)
        b.add(cylinder(0.035, height), bands, (x, FLOOR - height / 2, z))
    middle = LINE + WIDTH / 2 * ALONG - np.array([0, 0.01, 0])
    b.block((WIDTH + 0.3, 0.012, 0.012), middle, textures.planks, turn=-np.degrees(TURN), rows=4)
    shed(b)
    for x, z, size, turn in [
        (-2.3, 4.3, 0.6, 20),
        (2.4, 3.3, 0.5, -20),
        (0.35, 5.6, 0.7, 30),
        (-0.6, 5.9, 0.5, 5),
        (-1.75, 2.3, 0.35, 15),
    ]:
        b.block((size, size, size), (x, FLOOR - size / 2, z), textures.poster, turn=turn)
    b.block((0.35, 0.3, 0.35), (-2.3, FLOOR - 0.75, 4.3), textures.planks, turn=-10)
    for x, z in [(-0.9, 4.6), (1.55, 2.35), (2.6, 4.4)]:
        b.add(cylinder(0.2, 0.5), textures.planks(96, 160, b.rng, rows=6), (x, FLOOR - 0.25, z))
        b.add(sphere(0.22), textures.poster(96, 192, b.rng), (x, FLOOR - 0.62, z))


def shed(b: Builder) -> None:
    """Dark boards around a dark inside with a crate."""
    left, right = 1.15, 2.75
    top, front = -0.75, 5.0
    width, height = right - left, FLOOR - top
    middle = (front + BACK) / 2
    wood = partial(textures.planks, base=(0.16, 0.11, 0.07), rows=8)
    roof = (width + 0.2, 0.06, BACK - front + 0.5)
    b.block(roof, ((left + right) / 2, top, middle - 0.25), wood)
    for x in (left, right):
        b.block((0.06, height, BACK - front), (x, (top + FLOOR) / 2, middle), wood)
    b.panel((left, top, BACK - 0.05), (width, 0, 0), (0, height, 0), wood)
    b.block((0.5, 0.5, 0.4), (1.7, FLOOR - 0.25, BACK - 0.4), textures.poster, paper=0.2)


def movers(b: Builder) -> None:
    """The cloth and the tube."""
    for body in (WAVING, BENDING):
        print_on_cloth = textures.poster(240, 320, b.rng, paper=0.8, figures=160)
        b.add(sheet(body.rows, body.columns), print_on_cloth, body=body.name)


WAVING = Deforming("cloth", cloth_shape, rows=64, columns=88)
BENDING = Deforming("tube", tube_shape, rows=80, columns=48)
CLOTH = SynthScene(
    build=build,
    bodies=(WAVING, BENDING),
    camera_pose=camera_pose,
    rig=(
        *((0.32 * k, -0.28, 0.0) for k in range(-2, 3)),
        *((0.48 - 0.32 * k, 0.04, 0.0) for k in range(4)),
    ),
    rig_target=(0.0, -0.08, 3.4),
    blur=0.08,
    sky=sky,
)
