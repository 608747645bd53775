"""An HDR10 video of a folder of EXR files with linear Rec. 709 light.

    python examples/hdr_video.py OUT/render/training video.mp4 24 1.5

24 frames a second, 1.5 stops brighter: then radiance 1 is diffuse white, 203 nits.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.hdr_video import Planes, write_hdr_video
from hdr_nsff.maths.hdr_signal import display_light, encode, ycbcr_planes


def hdr_video(folder: Path, out: Path, fps: float, stops: float) -> int:
    """Write `out`; the number of its frames."""
    return write_hdr_video(out, planes(sorted(folder.glob("*.exr")), stops), fps, "pq")


def planes(files: list[Path], stops: float) -> Iterator[Planes]:
    """10-bit codes of every picture, cut to even sizes."""
    for file in files:
        light = read_exr(file)["RGB"]
        height, width = light.shape[0] // 2 * 2, light.shape[1] // 2 * 2
        nits = display_light(light[:height, :width], 2.0**stops, "pq")
        yield ycbcr_planes(encode(nits, "pq"))


if __name__ == "__main__":
    hdr_video(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4]))
