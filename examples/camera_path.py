"""A camera path of one's own, from the prepared scene alone: a dolly to the side and
back while time runs at half speed.

    python examples/camera_path.py OUT/scene dolly.json
    hdr-nsff render OUT/run --path dolly.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

VIEWS_PER_FRAME = 2
REACH = 0.05  # of the nearest depth, to either side


def dolly(scene: Path, out: Path) -> int:
    """Write the path file `out`; the number of its views."""
    document = json.loads((scene / "scene.json").read_text(encoding="utf-8"))
    frames = sorted(document["frames"], key=lambda frame: frame["time"])
    middle = np.array(frames[len(frames) // 2]["c2w"])  # 3 x 4, OpenCV camera to world
    first, last = frames[0]["time"], frames[-1]["time"]
    times = np.linspace(first, last, (len(frames) - 1) * VIEWS_PER_FRAME + 1)
    views = []
    for share, time in zip(np.linspace(0, 1, len(times)), times, strict=True):
        pose = middle.copy()
        right = pose[:, 0]
        pose[:, 3] += REACH * document["near"] * np.sin(2 * np.pi * share) * right
        views.append({"time": float(time), "c2w": pose.tolist()})
    out.write_text(json.dumps(views), encoding="utf-8")
    return len(views)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print(dolly(Path(sys.argv[1]), Path(sys.argv[2])), "views")
