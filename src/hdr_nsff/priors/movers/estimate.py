"""The moving objects of a clip: their tracks, their rigid motion and their shape.

Tracks are chains of optical flow through moving pixels (`tracks.py`), lifted by a first
depth that may be wrong (`distance.py`). They are grouped by rigid motion
(`rigid_groups.py`, `motion_segmentation.py`), and every group gets shape and motion by
bundle adjustment (`bundle.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from hdr_nsff.core.stack import ArrayStack, LazyMap
from hdr_nsff.maths.differences import averaged_with_neighbors
from hdr_nsff.priors.movers.bundle_problem import Cameras
from hdr_nsff.priors.movers.motion_segmentation import Segment, segment_tracks
from hdr_nsff.priors.movers.regions import flow_steps
from hdr_nsff.priors.movers.tracks import MovingView, Tracks, follow_moving_pixels
from hdr_nsff.priors.movers.tuning import MOVERS_TUNING, MoversTuning
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.posed_video import PosedVideo


def estimate_movers(
    clip: PosedVideo,
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    disparity: ArrayStack,
    confidence: ArrayStack,
    tuning: MoversTuning = MOVERS_TUNING,
) -> tuple[Mover, ...]:
    """The movers of a clip with known poses, largest first; none where nothing moves.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) of `pairs` (P, 2) of frames;
    `disparity` (T, H, W) in 1 / scene units and `confidence` (T, H, W) of a first depth
    of moving pixels. Of several frames at one time, only the first is used. Where flow
    gives too few tracks, all moving pixels together are one mover without a shape.
    """
    frames, views = views_by_time(clip, flow, valid, pairs, disparity, confidence)
    if not any(view.moving.any() for view in views):
        return ()
    times = clip.times[frames]
    tracks = follow_moving_pixels(views, times, tuning.tracks)
    segments: list[Segment] = []
    if len(tracks.trust):
        cameras = Cameras(clip.K[frames], clip.c2w[frames], times)
        segments = segment_tracks(tracks, cameras, tuning)
    if not segments:
        return (mover_without_tracks(np.array(frames), times, views, tuning),)
    return tuple(mover_of(np.array(frames), tracks, segment) for segment in segments)


def mover_of(frames: np.ndarray, tracks: Tracks, segment: Segment) -> Mover:
    """A segment of the tracks as a mover; `frames` (T,) are those of the times."""
    members = segment.members
    motion = segment.group
    points = np.full((len(members), 3), np.nan)
    error = np.inf
    if segment.shape is not None:
        motion = segment.shape.group
        points = segment.shape.points
        error = segment.shape.error
    return Mover(
        frames=frames,
        pixels=tracks.pixels[members],
        trust=tracks.trust[members],
        points=points,
        rotations=motion.rotations,
        translations=motion.translations,
        center=motion.center,
        known=motion.known,
        error=error,
        spacing=tracks.spacing,
    )


def mover_without_tracks(
    frames: np.ndarray,
    times: np.ndarray,
    views: list[MovingView],
    tuning: MoversTuning = MOVERS_TUNING,
) -> Mover:
    """The one mover of all moving pixels at `times` (T,), where flow gives no tracks.

    It follows the median of their points, without rotation.
    """
    num = len(views)
    visible = np.array([view.moving.any() for view in views])
    medians = np.array(
        [np.median(view.points[view.moving], 0) for view in views if view.moving.any()]
    )
    path = np.stack([np.interp(times, times[visible], axis) for axis in medians.T], 1)
    for _ in range(tuning.fallback_smoothing_rounds):
        path = averaged_with_neighbors(path, times)
    return Mover(
        frames=frames,
        pixels=np.zeros((0, num, 2)),
        trust=np.zeros((0, num)),
        points=np.zeros((0, 3)),
        rotations=np.tile(np.eye(3), (num, 1, 1)),
        translations=path - path[0],
        center=path[0],
        known=visible,
        error=np.inf,
    )


@dataclass(frozen=True)
class FrameMap:
    """The map (H, W) of one frame of a stack, read where it is indexed."""

    stack: ArrayStack
    frame: int

    def __getitem__(self, index: Any) -> np.ndarray:
        return self.stack[self.frame][index]


@dataclass(frozen=True)
class FramePoints:
    """The points (H, W, 3) of one frame's pixels, computed where they are asked for."""

    clip: PosedVideo
    frame: int
    disparity: ArrayStack  # (T, H, W)

    def __getitem__(self, index: Any) -> np.ndarray:
        """The points (P, 3) of pixels: rows and columns (P,) each, or a mask (H, W)."""
        y, x = np.nonzero(index) if isinstance(index, np.ndarray) else index
        disparity = np.maximum(self.disparity[self.frame][y, x], 1e-9).astype(np.float64)
        return self.clip.unproject(self.frame, np.stack([x, y], -1) + 0.5, disparity)


def views_by_time(
    clip: PosedVideo,
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    disparity: ArrayStack,
    confidence: ArrayStack,
) -> tuple[list[int], list[MovingView]]:
    """One frame of every time, in order, and its view of the moving pixels.

    The arguments are those of `estimate_movers`. Flow counts between the frames of
    consecutive times.
    """
    _, first = np.unique(clip.times, return_index=True)
    frames = [int(f) for f in first]
    steps = {(s.start, s.end): s for s in flow_steps(clip.times, flow, valid, pairs)}
    views = []
    for k, f in enumerate(frames):
        points = FramePoints(clip, f, disparity)
        flows: dict[int, Callable[[], np.ndarray]] = {}
        valids: dict[int, Callable[[], np.ndarray]] = {}
        forward = steps.get((f, frames[k + 1])) if k + 1 < len(frames) else None
        backward = steps.get((frames[k - 1], f)) if k > 0 else None
        if forward is not None:
            flows[1] = partial(flow.__getitem__, forward.forward)
            valids[1] = partial(valid.__getitem__, forward.forward)
        if backward is not None:
            flows[-1] = partial(flow.__getitem__, backward.backward)
            valids[-1] = partial(valid.__getitem__, backward.backward)
        trust = FrameMap(confidence, f)
        views.append(MovingView(clip.moving[f], points, trust, LazyMap(flows), LazyMap(valids)))
    return frames, views
