"""Open a run and render one view: linear radiance as EXR, a picture as PNG.

    python examples/render_view.py OUT/run 12.5 view.exr

The view is the camera of the middle frame, moved a little to the right, at time 12.5.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.maths import color
from hdr_nsff.training.run_folder import Run

RIGHT = 0.02  # of the nearest depth


def render_view(folder: Path, time: float, out: Path) -> np.ndarray:
    """Write `out` and the PNG beside it; the radiance (H, W, 3)."""
    run = Run.open(folder, "cpu")
    frame = run.scene.train[len(run.scene.train) // 2]
    pose = frame.camera.c2w.clone()  # camera to world, OpenCV axes
    pose[:, 3] += RIGHT * run.scene.near * pose[:, 0]
    camera = frame.camera.moved(pose)
    with torch.no_grad():
        seen = run.field.render(camera, time, scene_flow=False)
    radiance = seen.radiance.reshape(camera.height, camera.width, 3).numpy()
    depth = seen.depth.reshape(camera.height, camera.width).numpy()
    write_exr(out, {"RGB": radiance, "Z": depth})
    neutral = radiance * run.tonemapper.neutral(0).detach().numpy()  # gray is gray
    write_png(out.with_suffix(".png"), color.display(neutral, color.auto_exposure(neutral)))
    return radiance


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    render_view(Path(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3]))
