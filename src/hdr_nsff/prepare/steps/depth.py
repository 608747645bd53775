"""The step `depth`: depth of the static scene with the movers put into it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hdr_nsff.core.io import read_npy
from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.depth.geometric import depth_range, lower_confidence_at_edges
from hdr_nsff.scene.movers import fill_mover_depth, read_movers

MAX_SAMPLES = 8_000_000  # pixels from which near and far are found


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
    disparity, confidence = [], []
    sampled = []
    total = len(work.train) * work.manifest.height * work.manifest.width
    step = max(1, int(np.sqrt(total / MAX_SAMPLES)))
    maps = depth_with_movers(work, still)
    for own_disparity, own_confidence in track(maps, "depth", len(work.train)):
        sampled.append((own_disparity[::step, ::step], own_confidence[::step, ::step]))
        disparity.append(halve(own_disparity))
        confidence.append(halve(own_confidence))
    sampled_disparity, sampled_confidence = (np.stack(m) for m in zip(*sampled, strict=True))
    near, far = depth_range(sampled_disparity, sampled_confidence)
    known = np.mean([(map > 0.5).mean() for _, map in sampled])
    indices = [f.index for f in work.train]
    return StepResult(
        note=f"{known:.0%} of the pixels well known, near {near:.3g}, far {far:.3g} scene units",
        details=details,
        manifest={"near": near, "far": far},
        maps={
            "disparity": dict(zip(indices, disparity, strict=True)),
            "disparity_confidence": dict(zip(indices, confidence, strict=True)),
        },
    )


def halve(values: np.ndarray) -> np.ndarray:
    """A map as it is stored: in half precision, where that holds it."""
    fits = np.abs(values).max() < np.finfo(np.float16).max
    return values.astype(np.float16) if fits else values


def depth_with_movers(work: Work, still: ArrayStack) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield disparity and confidence (H, W) of every training frame.

    `still` (T, H, W): pixels of the moving masks that stand still. Only cameras that
    take turns tell the shape of a mover that is not rigid: before others it would bend
    the depth (of a rendered walker from 5 % of error to 13 %).
    """
    m = work.manifest
    assert m.movers is not None
    movers = read_movers(work.folder / m.movers)
    time_of = {int(index): t for t, index in enumerate(movers[0].frames)} if movers else {}
    static_disparity, static_confidence = work.static_depth()
    for k, f in enumerate(work.train):
        moving = work.masks[f.index] & ~still[k]
        found = read_npy(work.folder / str(f.mover_disparity)).astype(np.float32)
        trust = read_npy(work.folder / str(f.mover_confidence)).astype(np.float32)
        disparity = np.where(moving, found, static_disparity[k])
        confidence = np.where(moving, trust, static_confidence[k])
        if f.index in time_of:
            c2w = work.camera(f)[1]
            disparity, confidence = fill_mover_depth(
                movers, time_of[f.index], moving, c2w, disparity, confidence, rigid_only=m.rig == 1
            )
        yield disparity, lower_confidence_at_edges(disparity, confidence)
