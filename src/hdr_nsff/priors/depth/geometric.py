"""Depth of every frame: inverse z-depth (disparity) of every pixel in scene units, and
how far it can be believed.

A depth prior is a function `(K, c2w, flow, valid, pairs, moving, points, video,
clipped) -> (disparity, confidence, near, far)`. `geometric_depth` is the offline
default: the static scene by a plane sweep over the frames (`sweep.py`) between the
disparities that structure from motion found, fused over all frames (`fuse.py`); moving
objects by their path (`movers.py`). `read_depth` reads maps made by any other tool.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np

from hdr_nsff.core.parallel import in_threads
from hdr_nsff.core.progress import say
from hdr_nsff.priors.depth.fuse import AGREE, carry_over, clean, vote
from hdr_nsff.priors.depth.parallax import choose_views, disparity_range, triangulate
from hdr_nsff.priors.depth.plane_sweep import sweep
from hdr_nsff.priors.movers.distance import mover_depth
from hdr_nsff.priors.movers.mover_shape import relief
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


class DepthPrior(Protocol):
    """What `prepare` calls, whatever is behind it."""

    def __call__(
        self,
        K: np.ndarray,
        c2w: np.ndarray,
        flow: np.ndarray,
        valid: np.ndarray,
        pairs: np.ndarray,
        moving: np.ndarray,
        points: np.ndarray,
        video: np.ndarray,
        clipped: np.ndarray,
        times: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """See `geometric_depth`."""
        ...


def geometric_depth(
    K: np.ndarray,
    c2w: np.ndarray,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    moving: np.ndarray,
    points: np.ndarray,
    video: np.ndarray,
    clipped: np.ndarray,
    times: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Disparity (T, H, W) in 1 / scene units, confidence (T, H, W) in [0, 1], near and
    far z-depth, from known poses.

    `K` (3, 3) or (T, 3, 3) px, `c2w` (T, 3, 4) OpenCV; `flow` (P, H, W, 2) px, `valid`
    (P, H, W) of `pairs` (P, 2), both directions of neighbors; `moving`, `clipped` (T,
    H, W) bool; `points` (N, 3) static, may be none; `video` (T, H, W, 3) equalized rgb;
    `times` (T,) in frames, 0, 1, 2, ... if not given. Without parallax all is at
    distance 1, confidence 0.
    """
    count, size = len(video), video.shape[1:3]
    times = np.arange(count, dtype=np.float64) if times is None else np.asarray(times, np.float64)
    clip = PosedVideo(
        np.broadcast_to(np.asarray(K, np.float64), (count, 3, 3)),
        np.asarray(c2w, np.float64),
        times,
        video,
        clipped,
        moving,
    )
    if sum(clip.project(i, points)[2].sum() for i in range(count)) < LEAST_POINTS * count:
        points = np.concatenate(
            [np.asarray(points).reshape(-1, 3), triangulate(clip, flow, valid, pairs)]
        )
    views, parallax = (
        choose_views(clip, points, VIEWS) if len(points) >= LEAST_POINTS else ([], 0.0)
    )
    if parallax < LEAST_PARALLAX:
        say(
            f"depth: {parallax:.1f} pixels of parallax between the frames are too few: everything is put at distance 1"
        )
        return np.ones((count, *size), np.float32), np.zeros((count, *size), np.float32), 0.5, 2.0
    disparity, confidence, still = static_depth(clip, views, *disparity_range(clip, points))
    moves = moving & ~still
    with_movers, mover_confidence = mover_depth(
        replace(clip, moving=moves), flow, valid, pairs, disparity
    )
    disparity, confidence = (
        np.where(moves, with_movers, disparity),
        np.where(moves, mover_confidence, confidence),
    )
    disparity, confidence = relief(
        replace(clip, moving=moves), flow, valid, pairs, disparity, confidence
    )
    confidence = np.stack([doubt_edges(d, c) for d, c in zip(disparity, confidence, strict=True)])
    return disparity, confidence, *depth_range(disparity, confidence)


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
