"""Which movers are rigid: those whose motion explains believed flow as well as the
cameras explain that of the static scene.

Flow is uncertain, and so are the cameras. How far both together are off shows in the
static scene, so the test asks for nothing that the clip cannot give: the median
distance between flow and motion in the mover's pixels may be a small multiple of the
same in pixels that stand still. Flow spans one step: what deforms slowly shows in long
tracks, which its shape has to explain too. A mover that always touches one that is not
rigid is a part of it, as a wrist is of an arm.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.geometry import pinhole
from hdr_nsff.priors.movers.regions import FlowStep, flow_steps
from hdr_nsff.priors.movers.tuning import RIGIDITY_TUNING, RigidityTuning
from hdr_nsff.scene.movers import Mover, fill_mover_depth, nearest_mover, tracks_in_picture
from hdr_nsff.scene.posed_video import PosedVideo

STATIC_STRIDE = 4  # pixels, in x and in y, of the static samples


def judge_rigidity(
    movers: Sequence[Mover],
    clip: PosedVideo,
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    disparity: ArrayStack,
    tuning: RigidityTuning = RIGIDITY_TUNING,
) -> tuple[Mover, ...]:
    """The movers with the residuals of their flow, and whether each is rigid.

    `movers` have frames that are positions in the clip; the other arguments are those
    of `estimate_movers`. A mover without believed flow stays as it is.
    """
    if not movers:
        return ()
    frames = movers[0].frames.tolist()
    steps = {(s.start, s.end): s for s in flow_steps(clip.times, flow, valid, pairs)}
    residuals: list[list[np.ndarray]] = [[] for _ in movers]
    static: list[np.ndarray] = []
    for t, (start, end) in enumerate(itertools.pairwise(frames)):
        step = steps.get((start, end))
        if step is None:
            continue
        static.append(static_residuals(clip, step, disparity[start]))
        y, x = np.nonzero(clip.moving[start] & step.valid)
        pixels = np.stack([x, y], -1) + 0.5
        c2w, first = clip.c2w[start], disparity[start]
        owner = nearest_mover(movers, t, pixels, (clip.K[start], c2w))
        shown, _ = fill_mover_depth(movers, t, clip.moving[start], c2w, first, np.zeros_like(first))
        points = clip.unproject(start, pixels, shown[y, x].astype(np.float64))
        for k, mover in enumerate(movers):
            if not (mover.known[t] and mover.known[t + 1]):
                continue
            own = owner == k
            moved = mover.world(mover.canonical(points[own], t), t + 1)
            found = step.flow[y[own], x[own]]
            residuals[k].append(flow_residuals(clip, end, pixels[own], moved, found))
    uncertainty = median(static)
    allowed = tuning.max_residual_ratio * max(uncertainty, tuning.min_uncertainty_px)
    result = []
    for mover, own in zip(movers, residuals, strict=True):
        residual = median(own)
        bends = mover.has_shape and mover.error > tuning.max_shape_error
        result.append(
            replace(
                mover,
                flow_residual=residual,
                flow_uncertainty=uncertainty,
                rigid=residual <= allowed and not bends,
            )
        )
    soft = [mover for mover in result if not mover.rigid]
    return tuple(
        replace(m, rigid=m.rigid and not any(is_part_of(m, other, tuning) for other in soft))
        for m in result
    )


def is_part_of(mover: Mover, other: Mover, tuning: RigidityTuning = RIGIDITY_TUNING) -> bool:
    """Whether a mover touches another one nearly whenever it is seen."""
    reach = tuning.touching_px * max(mover.sparseness, other.sparseness)
    seen = touches = 0
    for t in range(len(mover.frames)):
        own, others = tracks_in_picture(mover, t), tracks_in_picture(other, t)
        if len(own):
            seen += 1
        if len(own) and len(others):
            touches += float(cKDTree(others).query(own)[0].min()) <= reach
    return touches > tuning.min_touching_share * seen


def static_residuals(clip: PosedVideo, step: FlowStep, disparity: np.ndarray) -> np.ndarray:
    """Distances (P,) px between flow and the cameras' motion, in static samples.

    `disparity` (H, W) is that of the step's first frame.
    """
    samples = np.zeros(clip.size, bool)
    samples[::STATIC_STRIDE, ::STATIC_STRIDE] = True
    y, x = np.nonzero(samples & step.valid & ~clip.moving[step.start])
    pixels = np.stack([x, y], -1) + 0.5
    points = clip.unproject(step.start, pixels, disparity[y, x].astype(np.float64))
    return flow_residuals(clip, step.end, pixels, points, step.flow[y, x])


def flow_residuals(
    clip: PosedVideo, end: int, pixels: np.ndarray, points: np.ndarray, flow: np.ndarray
) -> np.ndarray:
    """Distances (P,) px between where `flow` (P, 2) leads `pixels` (P, 2), and where
    frame `end` sees the `points` (P, 3).
    """
    seen, depth = pinhole.project(points, clip.K[end], clip.c2w[end])
    distances = np.linalg.norm(seen - pixels - flow, axis=-1)
    return distances[np.isfinite(distances) & (depth > pinhole.MIN_DEPTH)]


def median(parts: list[np.ndarray]) -> float:
    """The median of all values; 0 where there are none."""
    values = np.concatenate([np.zeros(0), *parts])
    return float(np.median(values)) if len(values) else 0.0
