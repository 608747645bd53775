"""Stability of the radiance along the clip's own path.

That is flicker, which no single held-out view shows. Consecutive training frames are
rendered and compared along the clip's optical flow, which every method trained on one
scene folder shares.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from hdr_nsff.evaluation.predictions import predict, radiance_of
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.maths import metrics
from hdr_nsff.scene.scene import Frame
from hdr_nsff.training.run_folder import Run

MAX_PAIRS = 12  # of frames: enough for a mean, seconds to render (hand-chosen)


def stability(run: Run, folder: Path) -> dict[str, float]:
    """HDR-TAE of the run along its training path; empty where the scene has no flow.

    `hdr_tae` (see `metrics.hdr_tae`) is the mean over all pixels where forward and
    backward flow agree, `hdr_tae_moving` over those that move; `pairs` is the number of
    pairs of frames. Renders are kept in `folder`.
    """
    pairs = choose_pairs(run)
    if not pairs:
        return {}
    files = render_pairs(run, pairs, folder)
    errors: dict[str, list[float]] = {"hdr_tae": [], "hdr_tae_moving": []}
    counts: dict[str, list[int]] = {"hdr_tae": [], "hdr_tae_moving": []}
    for first, second in pairs:
        here, there = radiance_of(files[first.index]), radiance_of(files[second.index])
        flow = first.flow[1].cpu()
        for name, region in regions_of(first).items():
            error, pixels = metrics.hdr_tae(here, there, flow, region)
            if pixels:
                errors[name].append(error * pixels)
                counts[name].append(pixels)
    found: dict[str, float] = {}
    for name, values in errors.items():
        if values:
            found[name] = sum(values) / sum(counts[name])
    return found | {"pairs": len(pairs)} if found else {}


def choose_pairs(run: Run) -> list[tuple[Frame, Frame]]:
    """Training frames with flow to the next frame, each with that frame.

    All, or `MAX_PAIRS` spread evenly over the clip.
    """
    frames = run.scene.train
    pairs = []
    for frame in frames:
        if 1 in frame.neighbors and 1 in frame.flow and 1 in frame.flow_valid:
            pairs.append((frame, frames[frame.neighbors[1]]))
    positions = np.linspace(0, len(pairs) - 1, min(len(pairs), MAX_PAIRS))
    return [pairs[round(position)] for position in positions]


def render_pairs(run: Run, pairs: Sequence[tuple[Frame, Frame]], folder: Path) -> dict[int, Path]:
    """Predictions of all frames of the pairs, {index of the frame: EXR}."""
    frames = {frame.index: frame for pair in pairs for frame in pair}
    indices = sorted(frames)
    views = {f"{i:05d}": PathView(frames[i].camera, frames[i].time) for i in indices}
    files = predict(run, views, folder, "rendering the training path", motion=False)
    return dict(zip(indices, files, strict=True))


def regions_of(frame: Frame) -> dict[str, Tensor]:
    """Pixels (H, W) whose flow to the next frame passes the round trip, by score."""
    valid = frame.flow_valid[1]
    regions = {"hdr_tae": valid.cpu()}
    if frame.moving is not None:
        regions["hdr_tae_moving"] = (valid & frame.moving).cpu()
    return regions
