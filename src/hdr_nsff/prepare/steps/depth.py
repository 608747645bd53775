"""The step `depth`: depth of the static scene with the movers put into it."""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.io import read_npy
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.depth.geometric import depth_range, lower_confidence_at_edges
from hdr_nsff.scene.movers import fill_mover_depth, read_movers


def find_depth(work: Work) -> StepResult:
    """Disparity of the training frames and how far it can be believed, with the movers
    where their shape and motion put them.

    Depth that was given, or is the same everywhere without parallax, stays as it is.
    """
    m = work.manifest
    record = m.steps["static_depth"]
    details = {k: v for k, v in record.details.items() if k != "attempt"}  # the source
    still = work.still()
    if still is None:
        # movers before the background where there is no parallax
        files = {
            "disparity": {f.index: f.mover_disparity or f.static_disparity for f in work.train},
            "disparity_confidence": {
                f.index: f.mover_confidence or f.static_confidence for f in work.train
            },
        }
        return StepResult(record.note, record.provenance, details, frames=files)
    disparity, confidence = depth_with_movers(work, work.training_masks() & ~still)
    near, far = depth_range(disparity, confidence)
    indices = [f.index for f in work.train]
    return StepResult(
        note=(
            f"{(confidence > 0.5).mean():.0%} of the pixels well known, "
            f"near {near:.2f}, far {far:.2f} scene units"
        ),
        details=details,
        manifest={"near": near, "far": far},
        maps={
            "disparity": dict(zip(indices, disparity, strict=True)),
            "disparity_confidence": dict(zip(indices, confidence, strict=True)),
        },
    )


def depth_with_movers(work: Work, moving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Disparity and confidence (T, H, W) of the training frames; `moving` (T, H, W)."""
    m = work.manifest
    assert m.movers is not None
    movers = read_movers(work.folder / m.movers)
    time_of = {int(index): t for t, index in enumerate(movers[0].frames)} if movers else {}
    disparity, confidence = work.static_depth()
    for k, f in enumerate(work.train):
        found = read_npy(work.folder / str(f.mover_disparity)).astype(np.float32)
        trust = read_npy(work.folder / str(f.mover_confidence)).astype(np.float32)
        disparity[k] = np.where(moving[k], found, disparity[k])
        confidence[k] = np.where(moving[k], trust, confidence[k])
        if f.index in time_of:
            c2w = work.camera(f)[1]
            disparity[k], confidence[k] = fill_mover_depth(
                movers, time_of[f.index], moving[k], c2w, disparity[k], confidence[k]
            )
        confidence[k] = lower_confidence_at_edges(disparity[k], confidence[k])
    return disparity, confidence
