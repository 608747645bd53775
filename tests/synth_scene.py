"""A scene without Mitsuba for the tests of `synth`."""

from dataclasses import replace

import numpy as np

from hdr_nsff.synth.pathtracer import PASS_SPP, Surface

ROOM, BOX, BALL = 0, 1, 2  # bodies of the interior


def plane(height: int = 12, width: int = 16, depth: float = 2.0, bodies: int = ROOM) -> Surface:
    """A wall at z = `depth` seen from the origin, pixels 1 cm apart."""
    y, x = np.mgrid[:height, :width] * 0.01
    points = np.stack([x, y, np.full_like(x, depth)], -1)
    normals = np.broadcast_to([0.0, 0, -1], points.shape)
    return Surface(
        points,
        normals,
        np.full((height, width), depth),
        np.full((height, width), bodies),
        points[..., :2],
    )


class Flat:
    """Replaces Mitsuba: every camera sees an even wall 3 m away."""

    rendered = 0

    def __init__(self, *_: object) -> None:
        pass

    def surface(self, t: float, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int]) -> Surface:
        width, height = size
        row = np.where(np.arange(width) < 4, BOX, ROOM)
        return replace(plane(height, width, 3.0), bodies=np.tile(row, (height, 1)))

    def radiance(
        self, t: float, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int], spp: int, seed: int
    ) -> np.ndarray:
        Flat.rendered += spp > PASS_SPP  # the estimate of time is not counted
        return np.full((size[1], size[0], 3), 0.25, np.float32)
