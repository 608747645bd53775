"""A square at noon: somebody walks across it, arms and legs swinging, a cart rolls by,
and the camera walks along. Difficult: no single motion explains a person, she hardly
moves in the picture while everything else does, her trousers are as dark as the wall
behind them, and her shadow walks with her.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from hdr_nsff.synth import textures
from hdr_nsff.synth.scenes.base import Part, Rigid, SynthScene
from hdr_nsff.synth.scenes.cloth import sky
from hdr_nsff.synth.scenes.geometry import look_at, rotation
from hdr_nsff.synth.scenes.shapes import Builder, Mesh, cylinder, revolved, room, sphere

# Places and lengths in meters, periods in frames, all chosen by eye. The square:
LEFT, RIGHT = -4.2, 4.2
TOP, FLOOR = -4.0, 1.3
BACK = 6.8
SPEED = 0.055  # of the walker, meters per frame
STRIDE = 22.0  # period of both legs together, frames
HIP, KNEE, SHOULDER, ELBOW = 0.88, 0.46, 1.38, 1.1  # heights above the ground
ACROSS = np.array([0.0, 0.0, 1.0])  # the axis that limbs swing about; she walks along x
DARK = partial(textures.planks, base=(0.05, 0.045, 0.04))


def walker_pose(t: float) -> np.ndarray:
    """Her hips' point on the ground: she comes a little nearer while she walks."""
    pose = np.eye(4)
    bob = 0.02 * np.cos(4 * np.pi * t / STRIDE)
    pose[:3, 3] = [-1.05 + SPEED * t, FLOOR + bob, 3.5 - 0.012 * t]
    return pose


def swing(height: float, side: float, angle: float) -> np.ndarray:
    """A turn by `angle` (rad) about a joint at `height` over the ground, `side` meters
    from the middle.
    """
    joint = np.array([0.0, -height, side])
    turn = np.eye(4)
    turn[:3, :3] = rotation(ACROSS, angle)
    turn[:3, 3] = joint - turn[:3, :3] @ joint
    return turn


def stride(t: float, side: int) -> float:
    """The phase (rad) of the leg on one `side`, +1 or -1, at time `t`."""
    return 2 * np.pi * t / STRIDE + (0.0 if side > 0 else np.pi)


def thigh_pose(side: int, t: float) -> np.ndarray:
    """One thigh swings from the hip."""
    return walker_pose(t) @ swing(HIP, 0.1 * side, 0.42 * np.sin(stride(t, side)))


def shin_pose(side: int, t: float) -> np.ndarray:
    """The shin below it; the knee bends while the leg comes forward."""
    bend = 0.35 * (1 + np.cos(stride(t, side) + 0.4))
    return thigh_pose(side, t) @ swing(KNEE, 0.1 * side, bend)


def arm_pose(side: int, t: float) -> np.ndarray:
    """One upper arm swings against the leg of its side."""
    return walker_pose(t) @ swing(SHOULDER, 0.22 * side, -0.4 * np.sin(stride(t, side)))


def forearm_pose(side: int, t: float) -> np.ndarray:
    """The forearm below it, bent a little more while the arm is in front."""
    bend = -0.35 - 0.25 * np.sin(stride(t, side))
    return arm_pose(side, t) @ swing(ELBOW, 0.22 * side, bend)


def cart_pose(t: float) -> np.ndarray:
    """A cart with a box rolls the other way, behind her."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.array([0.0, 1.0, 0.0]), 0.25 + 0.01 * t)
    pose[:3, 3] = [1.5 - 0.03 * t, FLOOR, 4.7]
    return pose


def camera_pose(t: float) -> np.ndarray:
    """Camera to world, (3, 4) OpenCV, at time `t` in frames: hand-held, walking along
    with her, a little slower.
    """
    shake = 0.012 * np.array([np.sin(1.6 * t), np.sin(1.2 * t + 1), np.sin(1.3 * t + 2)])
    eye = [-0.75 + 0.8 * SPEED * t, -0.25 + 0.05 * np.sin(0.3 * t), 0.1 * np.sin(0.21 * t)]
    target = [-0.7 + 0.85 * SPEED * t, 0.25, 3.5]
    return look_at(np.array(eye) + shake, np.array(target) + 1.5 * shake[::-1])


def build(seed: int) -> list[Part]:
    """Every part of the square."""
    b = Builder(seed, per_meter=90)
    square(b)
    clutter(b)
    walker(b)
    cart(b)
    b.bulb((-7.0, -16.0, -4.0), 0.35, np.array([6000.0, 5400.0, 4500.0]))  # the sun
    return b.parts


def square(b: Builder) -> None:
    """Paving, walls with posters and doors, and a dark passage behind her path."""
    b.panel((LEFT, FLOOR, -1.5), (RIGHT - LEFT, 0, 0), (0, 0, BACK + 1.5), textures.tiles, rows=34)
    bricks = partial(textures.bricks, rows=32)
    room(b, (LEFT, RIGHT, TOP, FLOOR, -1.5, BACK), ceiling=None, sides=bricks, back=bricks)
    for x, y, w, h in [
        (-3.6, -1.2, 1.0, 2.0),
        (-2.2, -1.7, 0.8, 0.9),
        (1.6, -1.9, 1.0, 0.8),
        (2.8, -1.0, 1.0, 2.2),
    ]:
        b.panel((x, y, BACK - 0.03), (w, 0, 0), (0, h, 0), textures.poster)
    b.panel((-1.2, -1.1, BACK - 0.03), (2.4, 0, 0), (0, FLOOR + 1.1, 0), DARK, rows=10)
    for side, z in [(-1, 3.2), (-1, 5.2), (1, 3.6), (1, 5.4)]:
        b.panel((side * (RIGHT - 0.03), -1.0, z), (0, 0, 1.0), (0, 1.1, 0), textures.poster)


def clutter(b: Builder) -> None:
    """Crates and bollards, before and behind her path."""
    for x, z, size, turn in [
        (-2.6, 4.6, 0.7, 20),
        (2.6, 4.2, 0.6, -20),
        (0.4, 6.0, 0.7, 30),
        (-1.0, 5.6, 0.5, 5),
        (2.0, 6.1, 0.8, -10),
    ]:
        b.block((size, size, size), (x, FLOOR - size / 2, z), textures.poster, turn=turn)
    for x in (-1.9, 0.1, 2.1):
        stripes = textures.tiles(96, 40, b.rng, rows=10)
        b.add(cylinder(0.06, 0.8), stripes, (x, FLOOR - 0.4, 2.3))


def limb(top: float, bottom: float, radii: tuple[float, float]) -> Mesh:
    """A limb between two heights above the ground with rounded ends, about x = z = 0;
    `radii` are those of its top and bottom.
    """
    upper, lower = radii
    profile = [
        (0.01, -top - 0.6 * upper),
        (0.7 * upper, -top - 0.4 * upper),
        (upper, -top),
        (lower, -bottom),
        (0.7 * lower, -bottom + 0.4 * lower),
        (0.01, -bottom + 0.6 * lower),
    ]
    return revolved(np.array(profile))


def walker(b: Builder) -> None:
    """Jacket, head with a cap, arms and hands, dark trousers and shoes."""
    radii = [0.01, 0.13, 0.2, 0.17, 0.19, 0.01]
    heights = [-1.47, -1.45, -1.35, -1.05, -0.84, -0.8]
    jacket = textures.poster(160, 240, b.rng, figures=90)
    b.add(revolved(np.column_stack([radii, heights])), jacket, body="walker")
    skin = textures.plaster(60, 120, b.rng, base=0.55)
    b.add(sphere(0.115), skin, (0, -1.63, 0), body="walker")
    b.add(
        cylinder(0.12, 0.07), textures.planks(32, 96, b.rng, rows=4), (0, -1.73, 0), body="walker"
    )
    for side in (1, -1):
        sleeve = textures.poster(96, 80, b.rng, figures=40)
        hip, shoulder = (0, 0, 0.1 * side), (0, 0, 0.22 * side)
        b.add(limb(SHOULDER, ELBOW, (0.075, 0.055)), sleeve, shoulder, body=name("arm", side))
        b.add(limb(ELBOW, 0.84, (0.055, 0.04)), sleeve, shoulder, body=name("forearm", side))
        hand = (0, -0.8, 0.22 * side)
        b.add(sphere(0.05, 16), skin, hand, body=name("forearm", side))
        trousers = DARK(96, 80, b.rng, rows=3)
        b.add(limb(HIP, KNEE, (0.11, 0.075)), trousers, hip, body=name("thigh", side))
        b.add(limb(KNEE, 0.1, (0.075, 0.06)), trousers, hip, body=name("shin", side))
        shoe = (0.24, 0.09, 0.1)
        b.block(shoe, (0.06, -0.05, 0.1 * side), textures.poster, body=name("shin", side))


def name(part: str, side: int) -> str:
    """The name of the body of one side's limb."""
    return f"walker-{part}-{'far' if side > 0 else 'near'}"


def cart(b: Builder) -> None:
    """A board on wheels with a box."""
    b.block((0.9, 0.08, 0.6), (0, -0.22, 0), textures.planks, body="cart", rows=6)
    b.block((0.6, 0.5, 0.45), (0, -0.51, 0), textures.poster, body="cart")
    vertices, faces, uv = sphere(0.12, 16)
    wheel = (vertices * [1, 1, 0.4], faces, uv)
    for x in (-0.32, 0.32):
        for z in (-0.27, 0.27):
            b.add(wheel, textures.tiles(48, 96, b.rng, rows=6), (x, -0.12, z), body="cart")


LIMBS: dict[str, Callable[[int, float], np.ndarray]] = {
    "arm": arm_pose,
    "forearm": forearm_pose,
    "thigh": thigh_pose,
    "shin": shin_pose,
}
WALK = SynthScene(
    build=build,
    bodies=(
        Rigid("cart", cart_pose),
        Rigid("walker", walker_pose),
        *(
            Rigid(name(part, side), partial(pose, side))
            for part, pose in LIMBS.items()
            for side in (1, -1)
        ),
    ),
    camera_pose=camera_pose,
    rig=(
        *((0.32 * k, -0.28, 0.0) for k in range(-2, 3)),
        *((0.48 - 0.32 * k, 0.04, 0.0) for k in range(4)),
    ),
    rig_target=(0.0, 0.1, 3.5),
    ev="-5,-3,-1",
    max_frames=88,  # then she has reached the wall
    blur=0.08,
    sky=sky,
)
