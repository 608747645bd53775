"""How steady the radiance is along the clip's own path: flicker that no single held-out
view shows. Consecutive training frames are rendered and compared along the clip's
optical flow, which every method trained on one scene folder shares.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hdr_nsff.evaluation.predictions import predict, radiance_of
from hdr_nsff.geometry.paths import View
from hdr_nsff.maths import metrics
from hdr_nsff.scene.scene import Frame
from hdr_nsff.training.run_folder import Run

MOST_PAIRS = 12


def chosen_pairs(run: Run) -> list[tuple[Frame, Frame]]:
    """Training frames with flow to their neighbor, and that neighbor: all, or
    `MOST_PAIRS` spread evenly over the clip.
    """
    frames = run.scene.train
    pairs = [
        (f, frames[f.neighbors[1]])
        for f in frames
        if 1 in f.neighbors and 1 in f.flow and 1 in f.flow_valid
    ]
    return [pairs[round(k)] for k in np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_PAIRS))]


def stability(run: Run, folder: Path) -> dict[str, float]:
    """`hdr_tae` (see `metrics.hdr_tae`) of the run along its training path, mean over
    all pixels where forward and backward flow agree, over moving ones `hdr_tae_moving`,
    and the number of `pairs`; empty where the scene has no flow. Renders are kept in
    `folder`.
    """
    pairs = chosen_pairs(run)
    frames = {f"{f.index:05d}": f for pair in pairs for f in pair}
    views = {name: View(f.camera, f.time) for name, f in sorted(frames.items())}
    files = (
        dict(
            zip(
                views,
                predict(run, views, folder, "rendering the training path", motion=False),
                strict=True,
            )
        )
        if pairs
        else {}
    )
    sums = {"hdr_tae": [0.0, 0.0], "hdr_tae_moving": [0.0, 0.0]}
    for a, b in pairs:
        here, there = (radiance_of(files[f"{f.index:05d}"]) for f in (a, b))
        regions = {"hdr_tae": a.flow_valid[1].cpu()} | (
            {} if a.moving is None else {"hdr_tae_moving": (a.flow_valid[1] & a.moving).cpu()}
        )
        for name, region in regions.items():
            error, pixels = metrics.hdr_tae(here, there, a.flow[1].cpu(), region)
            if pixels:
                sums[name][0] += error * pixels
                sums[name][1] += pixels
    found: dict[str, float] = {
        name: total / pixels for name, (total, pixels) in sums.items() if pixels
    }
    return found | {"pairs": len(pairs)} if found else {}
