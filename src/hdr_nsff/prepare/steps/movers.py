"""The step `movers`: tracks, rigid motion and shape of every moving object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from hdr_nsff.core.stack import ArrayStack, by_key, map_stack, with_pixels
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import Flows, Work
from hdr_nsff.priors.depth.geometric import lower_confidence_at_edges, same_time_depth
from hdr_nsff.priors.movers.distance import mover_depth
from hdr_nsff.priors.movers.estimate import estimate_movers
from hdr_nsff.priors.movers.pixel_distance import believe_well_placed, pixel_distances
from hdr_nsff.priors.movers.rigidity import judge_rigidity
from hdr_nsff.priors.movers.synchronized import take_same_time_depth
from hdr_nsff.priors.movers.tuning import MOVERS_TUNING, MoversTuning
from hdr_nsff.scene.movers import Mover, fill_mover_depth, write_movers
from hdr_nsff.scene.posed_video import PosedVideo
from hdr_nsff.scene.scene import outline, without_outline


def find_movers(work: Work, tuning: MoversTuning = MOVERS_TUNING) -> StepResult:
    """The movers of the training frames, from flow, masks and a first depth.

    Where the depth is that of the static scene, there are two rounds, on pixels that
    parallax does not explain. The first one places the movers. The second one starts
    from the depth of their shapes, inside the outlines of the masks.
    """
    if work.manifest.depth_kind == "relative":
        return result((), {}, "not estimated: depth is known up to scale and shift only")
    flow = work.training_flows(work.refined_flows)
    disparity: ArrayStack
    confidence: ArrayStack
    disparity, confidence = work.static_depth()
    still = work.still()
    clip = work.training_clip()
    masks = clip.moving
    indices = [f.index for f in work.train]
    estimated: FirstDepth | None = None
    maps: dict[str, Mapping[int, np.ndarray]] = {}
    if without_parallax(work):
        share = np.float32(tuning.depth_share_without_parallax)
        disparity = map_stack(lambda d, k: np.where(masks[k], d / share, d), disparity)
        maps = maps_of(indices, disparity, confidence)
    elif still is not None:  # the depth is that of the static scene, without movers
        moving = masks & ~still
        clip = replace(clip, moving=moving)
        first = estimated = first_depth(work, clip, flow, tuning)
        disparity = first.disparity
        trust = trust_in(first, tuning)
        confidence = map_stack(lambda c, k: np.where(moving[k], trust[k], c), confidence)
    movers = estimate_movers(clip, *flow, disparity, confidence, tuning)
    if still is not None and any(mover.has_shape for mover in movers):
        disparity, confidence = with_shapes(movers, clip, disparity, confidence)
        if work.manifest.steps["masks"].provenance == "estimated":
            # outlines of the whole masks: static pixels along them would count twice
            clip = replace(clip, moving=within_outlines(masks) & ~still)
        movers = estimate_movers(clip, *flow, disparity, confidence, tuning)
    movers = judge_rigidity(movers, clip, *flow, disparity, tuning.rigidity)
    if estimated is not None:
        believed = estimated.confidence
        if estimated.sigmas is not None:
            seen = replace(clip, moving=estimated.moving)
            believed = believe_well_placed(believed, seen, estimated.sigmas, movers, tuning.pixels)
        maps = maps_of(indices, estimated.disparity, believed)
    movers = tuple(replace(m, frames=np.array(indices)[m.frames]) for m in movers)
    shapes = sum(mover.has_shape for mover in movers)
    rigid = sum(mover.rigid for mover in movers)
    note = "none found"
    if movers:
        note = f"{len(movers)} found, {shapes} with a shape, {rigid} rigid"
        if rigid < len(movers):
            note += "; from new viewpoints, the others are guesses beyond what a cycle shows"
    return result(movers, maps, note)


@dataclass(frozen=True)
class FirstDepth:
    """The depth of moving pixels before movers have shapes; maps are (T, H, W)."""

    moving: np.ndarray  # bool
    disparity: ArrayStack  # that of the static scene elsewhere
    confidence: ArrayStack  # 0 elsewhere
    # relative standard deviations (M,) of the pixels of each frame, where these have
    # distances of their own
    sigmas: list[np.ndarray] | None


def first_depth(work: Work, clip: PosedVideo, flow: Flows, tuning: MoversTuning) -> FirstDepth:
    """The depth of the moving pixels of `clip`: of whole regions, of those that several
    cameras see at one time, and where cameras take turns of every pixel.
    """
    behind, agreement = work.static_depth()
    found = mover_depth(clip, *flow, behind, tuning.distance)
    if work.manifest.synchronized and any(np.any(c) for c in agreement):
        seen = same_time_depth(clip, work.static_points())
        if seen is not None:
            found = take_same_time_depth(*found, *seen, clip.moving, tuning.synchronized)
    if work.manifest.rig == 1:
        return FirstDepth(clip.moving, *found, None)
    disparity, sigmas = pixel_distances(clip, *flow, *found, tuning.pixels)
    return FirstDepth(clip.moving, disparity, found[1], sigmas)


def trust_in(depth: FirstDepth, tuning: MoversTuning) -> ArrayStack:
    """How much bundle adjustment trusts a first depth, (T, H, W): its confidence, or
    what the standard deviations of its pixels deserve.
    """
    if depth.sigmas is None:
        return depth.confidence
    least = tuning.pixels.min_common_sigma
    trust = [tuning.bundle.trust_in_depth(np.maximum(s, least)) for s in depth.sigmas]
    return with_pixels(depth.confidence, depth.moving, trust)


def maps_of(
    indices: list[int], disparity: ArrayStack, confidence: ArrayStack
) -> dict[str, Mapping[int, np.ndarray]]:
    """The first depth of the frames of these `indices`, by the names of its maps."""
    return {
        "mover_disparity": by_key(indices, disparity),
        "mover_confidence": by_key(indices, confidence),
    }


def without_parallax(work: Work) -> bool:
    """Whether everything was put at one distance, as there is no parallax."""
    if work.manifest.parallax == "full":
        return False
    return work.manifest.steps["static_depth"].provenance == "estimated"


def within_outlines(moving: np.ndarray) -> np.ndarray:
    """The masks (T, H, W) without their outlines; thin and small movers stay whole."""
    masks = [torch.from_numpy(mask) for mask in moving]
    return np.stack([without_outline(mask, outline(mask)).numpy() for mask in masks])


def with_shapes(
    movers: tuple[Mover, ...], clip: PosedVideo, disparity: ArrayStack, confidence: ArrayStack
) -> tuple[ArrayStack, ArrayStack]:
    """Disparity and confidence (T, H, W) with moving pixels where the shapes are."""
    time_of = {k: t for t, k in enumerate(movers[0].frames.tolist())}
    depths, trust = [], []
    for k, moving in enumerate(clip.moving):
        filled = disparity[k], confidence[k]
        if k in time_of:
            filled = fill_mover_depth(movers, time_of[k], moving, clip.c2w[k], *filled)
            filled = filled[0], lower_confidence_at_edges(*filled)
        depths.append(filled[0][moving])
        trust.append(filled[1][moving])
    return with_pixels(disparity, clip.moving, depths), with_pixels(confidence, clip.moving, trust)


def result(
    movers: tuple[Mover, ...], maps: dict[str, Mapping[int, np.ndarray]], note: str
) -> StepResult:
    """Movers and the first depth of moving pixels, as the engine stores them."""
    sizes = [len(mover.pixels) for mover in movers]
    errors = [round(mover.error, 3) if mover.has_shape else None for mover in movers]
    return StepResult(
        note=note,
        details={
            "tracks": sizes,
            "errors": errors,
            "rigid": [mover.rigid for mover in movers],
            "flow_residuals_px": [round(mover.flow_residual, 3) for mover in movers],
            "flow_uncertainty_px": round(movers[0].flow_uncertainty, 3) if movers else None,
        },
        manifest={"movers": "movers.npz"},
        frames={"mover_disparity": {}, "mover_confidence": {}},
        maps=maps,
        files={"movers.npz": lambda path: write_movers(path, movers)},
    )
