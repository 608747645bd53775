"""Geometric depth of the static scene: inverse z-depth (disparity) of every pixel in
scene units, and a confidence.

A plane sweep over the frames (`plane_sweep.py`) between the disparities that structure
from motion found, fused over all frames (`fuse.py`); large frames are shrunk for that
(`coarse.py`). Moving objects are placed by their
path and shape afterwards (`priors/movers`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.parallel import map_in_threads
from hdr_nsff.core.progress import say
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.priors.depth.coarse import (
    CoarseTuning,
    at_pixels,
    coarseness,
    mask_at_pixels,
    shrink,
)
from hdr_nsff.priors.depth.fuse import FuseTuning, joint_median, vote, warp_disparity
from hdr_nsff.priors.depth.parallax import (
    ParallaxTuning,
    choose_views,
    disparity_range,
    triangulate,
)
from hdr_nsff.priors.depth.plane_sweep import PlaneSweepTuning, sweep
from hdr_nsff.scene.posed_video import MIN_DISPARITY, PosedVideo

NO_PARALLAX_RANGE = (0.5, 2.0)  # near and far, of the one distance of everything


@dataclass(frozen=True)
class DepthTuning:
    """Evidence that depth needs, and how far it is trusted (hand-chosen on rendered
    scenes).
    """

    num_candidates: int = 64  # disparities tried per pixel
    # movers that several cameras see at once are tried up to this many times the
    # disparity of the nearest static point
    mover_factor: float = 2.0
    max_views: int = 12  # other frames compared per frame
    # below this, between any two frames, there is no depth
    min_parallax_px: float = 1.0
    min_points: int = 30  # static points, per frame; with fewer, flow gives more
    # weight of a disparity that no view supports and only smoothness determines
    unsupported_weight: float = 0.02
    # match and fused confidence from which on a pixel in a moving mask is static after
    # all
    min_static_match: float = 0.7
    min_static_confidence: float = 0.5
    static_median_px: int = 5  # window of the median over those pixels
    # relative step of disparity, within `edge_px`, at which a pixel may be on either
    # side of an edge, and the factor on its confidence
    min_edge_step: float = 0.06
    edge_px: int = 2
    edge_confidence: float = 0.5
    # near and far: these percentiles of the depth of the pixels above this quantile of
    # confidence, with room for movers and unreliable pixels
    min_range_quantile: float = 0.25
    range_percentiles: tuple[float, float] = (0.5, 99.5)
    near_factor: float = 0.8
    far_factor: float = 1.2
    plane_sweep: PlaneSweepTuning = field(default_factory=PlaneSweepTuning)
    fuse: FuseTuning = field(default_factory=FuseTuning)
    coarse: CoarseTuning = field(default_factory=CoarseTuning)
    parallax: ParallaxTuning = field(default_factory=ParallaxTuning)


def static_geometric_depth(
    clip: PosedVideo,
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    points: np.ndarray,
    tuning: DepthTuning = DepthTuning(),
) -> tuple[ArrayStack, ArrayStack, ArrayStack]:
    """Depth of the static scene from known poses, also behind moving objects.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) of `pairs` (P, 2) of frames, both
    directions of neighbors; `points` (N, 3) static, may be none. Returns disparity (T,
    H, W) in 1 / scene units, confidence (T, H, W) in [0, 1], and the pixels (T, H, W)
    of the moving masks that are static after all. Without parallax all is at distance
    1, with confidence 0.
    """
    count = len(clip.video)
    num_visible = sum(clip.project(i, points)[2].sum() for i in range(count))
    if num_visible < tuning.min_points * count:
        from_flow = triangulate(clip, flow, valid, pairs, tuning.parallax)
        points = np.concatenate([np.asarray(points).reshape(-1, 3), from_flow])
    found = depth_from_views(clip, points, False, tuning)
    if found is not None:
        return found
    say("depth: there is too little parallax between the frames: everything is put at distance 1")
    shape = (count, *clip.size)
    flat = np.ones(shape, np.float32)
    return flat, np.zeros(shape, np.float32), np.zeros(shape, bool)


def same_time_depth(
    clip: PosedVideo, points: np.ndarray, tuning: DepthTuning = DepthTuning()
) -> tuple[ArrayStack, ArrayStack] | None:
    """Depth of everything, movers too, from what other cameras see at the same instant:
    disparity (T, H, W) in 1 / scene units and its confidence (T, H, W) in [0, 1].

    `points` (N, 3) are static. None without parallax between such frames.
    """
    found = depth_from_views(clip, points, True, tuning)
    return None if found is None else found[:2]


def depth_from_views(
    clip: PosedVideo, points: np.ndarray, same_time: bool, tuning: DepthTuning
) -> tuple[ArrayStack, ArrayStack, ArrayStack] | None:
    """Disparity, confidence and the moving pixels that are static after all, (T, H, W)
    each, from the frames that see most parallax; None where there is too little.

    `points` (N, 3) are static; `same_time`: from frames of the same instant only.
    """
    if len(points) < tuning.min_points:
        return None
    views, parallax = choose_views(clip, points, tuning.max_views, tuning.parallax, same_time)
    if parallax < tuning.min_parallax_px:
        return None
    low, high = disparity_range(clip, points, tuning.parallax)
    if same_time:  # movers may be nearer than all that is static; the spacing stays
        count = tuning.num_candidates * (tuning.mover_factor * high - low) / (high - low)
        high *= tuning.mover_factor
        tuning = replace(tuning, num_candidates=round(count))
    factor = coarseness(clip.size, tuning.coarse)
    if factor == 1:
        return static_depth(clip, views, low, high, tuning)
    small = shrink(clip, factor, tuning.coarse)
    cell_disparity, trust, static = static_depth(small, views, low, high, tuning)
    disparity, confidence = at_pixels(clip, small, cell_disparity, trust, tuning.coarse)
    return disparity, confidence, mask_at_pixels(static, clip.size)


def static_depth(
    clip: PosedVideo,
    views: list[list[int]],
    low: float,
    high: float,
    tuning: DepthTuning = DepthTuning(),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disparity of the static scene by sweep, fusion and cleaning, also behind moving
    objects; its confidence; and which moving pixels are static after all: all (T, H,
    W).

    `views`: the frames that each frame is compared with; `low` to `high`: disparities
    to try, in 1 / scene units.
    """
    frames = list(range(len(views)))
    candidates = np.linspace(low, high, tuning.num_candidates).astype(np.float32)
    swept = map_in_threads(
        lambda i: sweep(clip, i, views[i], candidates, tuning.plane_sweep),
        frames,
        "depth: plane sweep",
    )
    disparity, matched = (np.stack(maps) for maps in zip(*swept, strict=True))
    unmatched = (matched == 0).all((1, 2))  # frames
    disparity[unmatched] = np.sqrt(low * high)
    doubtful = clip.moving & (matched < tuning.min_static_match)
    unsupported = tuning.unsupported_weight
    weight = np.where(doubtful, unsupported**2, np.maximum(matched, unsupported))
    weight = weight.astype(np.float32)
    fused = map_in_threads(
        lambda i: fuse_frame(clip, i, views[i], disparity, weight, tuning.fuse),
        frames,
        "depth: fusion",
    )
    result, confidence = (np.stack(maps) for maps in zip(*fused, strict=True))
    unchanged = np.abs(disparity - result) < tuning.fuse.max_disparity_difference * result
    static = ~doubtful & unchanged & (confidence > tuning.min_static_confidence)
    smooth = [cv2.medianBlur(s.astype(np.uint8), tuning.static_median_px) > 0 for s in static]
    return result, confidence, np.stack(smooth)


def fuse_frame(
    clip: PosedVideo,
    i: int,
    views: list[int],
    disparity: np.ndarray,
    weight: np.ndarray,
    tuning: FuseTuning,
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity and confidence (H, W) of frame `i` from its own map and those of its
    `views`, warped into it. `disparity`, `weight` (T, H, W).
    """
    maps, weights = [disparity[i]], [weight[i]]
    for j in views:
        rotation, shift = clip.transfer(j, i)
        warped, warped_weight = np.empty_like(disparity[i]), np.empty_like(disparity[i])
        warp_disparity(disparity[j], weight[j], rotation, shift, warped, warped_weight)
        maps.append(warped)
        weights.append(warped_weight)
    voted, agreeing_weight, total_weight = vote(
        np.stack(maps), np.stack(weights), tuning.max_disparity_difference
    )
    confidence = agreeing_weight / (total_weight + 1)
    rgb = np.ascontiguousarray(clip.video[i], np.float32)
    cleaned = joint_median(voted, confidence, rgb, tuning.window_px, tuning.rgb_scale)
    return cleaned, confidence.astype(np.float32)


def lower_confidence_at_edges(
    disparity: np.ndarray, confidence: np.ndarray, tuning: DepthTuning = DepthTuning()
) -> np.ndarray:
    """`confidence` (H, W), lower near steps of `disparity` (H, W)."""
    side = 2 * tuning.edge_px + 1
    window = np.ones((side, side), np.uint8)
    step = cv2.dilate(disparity, window) / np.maximum(cv2.erode(disparity, window), 1e-9) - 1
    lowered = tuning.edge_confidence * confidence
    return np.where(step > tuning.min_edge_step, lowered, confidence).astype(np.float32)


def depth_range(
    disparity: np.ndarray, confidence: np.ndarray, tuning: DepthTuning = DepthTuning()
) -> tuple[float, float]:
    """Near and far z-depth that hold the confident pixels, with room: movers and other
    pixels are somewhere in between. `disparity`, `confidence` (T, H, W).

    What is endlessly far away, such as sky, does not count; InputError where all is.
    """
    finite = disparity > MIN_DISPARITY
    disparity, confidence = disparity[finite], confidence[finite]
    if not len(disparity):
        raise InputError("depth: everything is endlessly far away; check the depth maps")
    if not confidence.any():  # no parallax: everything is at one distance
        near, far = NO_PARALLAX_RANGE
        return near / float(np.median(disparity)), far / float(np.median(disparity))
    least = np.quantile(confidence, tuning.min_range_quantile)
    depth = 1 / disparity[confidence >= least]
    near, far = np.percentile(depth, tuning.range_percentiles)
    return tuning.near_factor * float(near), tuning.far_factor * float(far)
