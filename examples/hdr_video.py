"""An HDR10 video of a folder of EXR files with linear Rec. 709 light.

    python examples/hdr_video.py OUT/render/training video.mp4 24 1.5

24 frames a second, 1.5 stops brighter than with radiance 1 as diffuse white, 203 nits.
Gray becomes neutral by the gains in the headers of files that `render` wrote.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR

from hdr_nsff.core.exr import read_exr
from hdr_nsff.radiometry.hdr_footage import write_radiance_video


def hdr_video(folder: Path, out: Path, fps: float, stops: float) -> int:
    """Write `out`; the number of its frames."""
    files = sorted(folder.glob("*.exr"))

    def radiance() -> Iterator[np.ndarray]:
        return (read_exr(file)["RGB"] * neutral_gains(file) for file in files)

    write_radiance_video(out, radiance, "pq", "hevc", fps, 2.0**stops)
    return len(files)


def neutral_gains(file: Path) -> np.ndarray:
    """Gains (3,) that make gray neutral, by the header; 1 where it has none."""
    with OpenEXR.File(str(file), header_only=True) as exr:
        text = exr.header().get("neutralWhiteBalance", "1 1 1")
    return np.array(text.split(), np.float32)


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit(__doc__)
    hdr_video(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4]))
