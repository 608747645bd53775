"""Depth of the static scene, the offline default: inverse z-depth (disparity) of every
pixel in scene units, and how far it can be believed.

A plane sweep over the frames (`plane_sweep.py`) between the disparities that structure
from motion found, fused over all frames (`fuse.py`). Moving objects are put where
`priors/movers` finds them, afterwards.
"""

from __future__ import annotations

import cv2
import numpy as np

from hdr_nsff.core.parallel import in_threads
from hdr_nsff.core.progress import say
from hdr_nsff.priors.depth.fuse import AGREE, carry_over, clean, vote
from hdr_nsff.priors.depth.parallax import choose_views, disparity_range, triangulate
from hdr_nsff.priors.depth.plane_sweep import sweep
from hdr_nsff.scene.posed_video import PosedVideo

CANDIDATES = 64  # disparities tried per pixel
VIEWS = 12  # other frames compared per frame
LEAST_PARALLAX = 1.0  # pixels: below this, between any two frames, depth cannot be told
LEAST_POINTS = 30
GUESSED = 0.02  # weight of a disparity that no view supports: only smoothness spoke
STILL, STILL_CONFIDENCE = (
    0.7,
    0.5,
)  # match and fused confidence of a pixel in a moving mask that stands still after all
# relative step of disparity within two pixels that makes a pixel doubtful: which side
# of the edge is it on?
EDGE = 0.06
AT_EDGE = 0.5  # its confidence is multiplied by this


def static_geometric_depth(
    clip: PosedVideo,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    points: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth of the static scene from known poses, also behind what moves.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) of `pairs` (P, 2) of frames, both
    directions of neighbors; `points` (N, 3) static, may be none. Returns disparity (T,
    H, W) in 1 / scene units, confidence (T, H, W) in [0, 1], and the pixels (T, H, W)
    of the moving masks that stand still after all. Without parallax all is at distance
    1, with confidence 0.
    """
    count = len(clip.video)
    seen = sum(clip.project(i, points)[2].sum() for i in range(count))
    if seen < LEAST_POINTS * count:
        known = np.asarray(points).reshape(-1, 3)
        points = np.concatenate([known, triangulate(clip, flow, valid, pairs)])
    views: list[list[int]] = []
    parallax = 0.0
    if len(points) >= LEAST_POINTS:
        views, parallax = choose_views(clip, points, VIEWS)
    if parallax < LEAST_PARALLAX:
        say(
            f"depth: {parallax:.1f} pixels of parallax between the frames are too few: "
            "everything is put at distance 1"
        )
        shape = (count, *clip.size)
        flat = np.ones(shape, np.float32)
        return flat, np.zeros(shape, np.float32), np.zeros(shape, bool)
    return static_depth(clip, views, *disparity_range(clip, points))


def static_depth(
    clip: PosedVideo, views: list[list[int]], low: float, high: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disparity of the static scene, also behind what moves, its confidence, and which
    moving pixels stand still after all (T, H, W): by sweep, fusion and cleaning.
    """
    frames = list(range(len(views)))
    candidates = np.linspace(low, high, CANDIDATES).astype(np.float32)
    swept = in_threads(lambda i: sweep(clip, i, views[i], candidates), frames, "depth: plane sweep")
    disparity, matched = (np.stack(x) for x in zip(*swept, strict=True))
    disparity[(matched == 0).all((1, 2))] = np.sqrt(low * high)  # a frame that no view could match
    doubtful = clip.moving & (matched < STILL)
    weight = np.where(doubtful, GUESSED**2, np.maximum(matched, GUESSED)).astype(np.float32)
    fused = in_threads(
        lambda i: fuse(clip, i, views[i], disparity, weight), frames, "depth: fusion"
    )
    result, confidence = (np.stack(x) for x in zip(*fused, strict=True))
    still = (
        ~doubtful & (np.abs(disparity - result) < AGREE * result) & (confidence > STILL_CONFIDENCE)
    )
    return result, confidence, np.stack([cv2.medianBlur(s.astype(np.uint8), 5) > 0 for s in still])


def fuse(
    clip: PosedVideo, i: int, views: list[int], disparity: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity and confidence (H, W) of frame `i` from its own map and those of its
    `views`, carried over.
    """
    maps, weights = [disparity[i]], [weight[i]]
    for j in views:
        there, there_weight = np.empty_like(disparity[i]), np.empty_like(disparity[i])
        carry_over(disparity[j], weight[j], *clip.transfer(j, i), there, there_weight)
        maps.append(there)
        weights.append(there_weight)
    voted, agreeing, everything = vote(np.stack(maps), np.stack(weights))
    confidence = agreeing / (everything + 1)
    cleaned = clean(voted, confidence, np.ascontiguousarray(clip.video[i], np.float32))
    return cleaned, confidence.astype(np.float32)


def doubt_edges(disparity: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """`confidence` (H, W), lower within two pixels of a step of `disparity` (H, W)."""
    square = np.ones((5, 5), np.uint8)
    step = cv2.dilate(disparity, square) / np.maximum(cv2.erode(disparity, square), 1e-9) - 1
    return np.where(step > EDGE, AT_EDGE * confidence, confidence).astype(np.float32)


def depth_range(disparity: np.ndarray, confidence: np.ndarray) -> tuple[float, float]:
    """Near and far z-depth that hold what is believed, with room: movers and unbelieved
    pixels are somewhere in between.
    """
    z = 1 / disparity[confidence >= np.quantile(confidence, 0.25)]
    near, far = np.percentile(z, [0.5, 99.5])
    return 0.8 * float(near), 1.2 * float(far)
