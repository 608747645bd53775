"""A camera path as `.chan` text, as Nuke's Camera node imports it.

One line per picture: its number, position, rotation in degrees, vertical field of view
in degrees. Rotations are of Nuke's default order ZXY: R = Ry Rx Rz. +y is up, and the
camera looks along -z.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from scipy.spatial.transform import Rotation

from hdr_nsff.core.io import write_text
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.rendering.usd import FLIP

LINE = re.compile(r"(\d+)(?: -?\d+\.\d{8}){7}", re.ASCII)  # as it is written here


def write_chan(path: Path, cameras: Sequence[Camera]) -> None:
    """Write the cameras of numbered pictures, the first of which is 0."""
    lines = []
    for number, camera in enumerate(cameras):
        pose = camera.c2w.double().cpu().numpy()
        place = FLIP @ pose[:, 3]
        rotation = Rotation.from_matrix(FLIP @ pose[:, :3] @ FLIP)
        ry, rx, rz = rotation.as_euler("YXZ", degrees=True)
        fov = 2 * math.degrees(math.atan(camera.height / 2 / float(camera.K[1, 1])))
        numbers = " ".join(f"{value:.8f}" for value in (*place, rx, ry, rz, fov))
        lines.append(f"{number} {numbers}")
    write_text(path, "\n".join(lines) + "\n")


def is_chan(path: Path) -> bool:
    """Whether a file is such a text as it is written here, so that it may be replaced:
    cameras of other programs have other decimals, or numbers that do not start at 0.
    """
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeError):
        return False
    found = [LINE.fullmatch(line) for line in lines]
    return bool(found) and all(m and m[1] == str(number) for number, m in enumerate(found))
