"""The moving objects of a clip: tracks along flow, what moves together, how, and what
shape it has.

Tracks are chains of optical flow through moving pixels, lifted by a first depth that
may be wrong (`distance.py`). Groups of tracks that move as one rigid body
(`rigid_groups.py`, `motion_segmentation.py`) get shape and motion by bundle adjustment
(`bundle.py`).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from hdr_nsff.core.progress import say
from hdr_nsff.priors.movers.bundle import Cameras
from hdr_nsff.priors.movers.distance import steps_in_time
from hdr_nsff.priors.movers.motion_segmentation import Found, things
from hdr_nsff.priors.movers.rigid_groups import Tracks, View, follow
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.posed_video import PosedVideo

MIN_TIMES = 4  # fewer tell no shape from motion
DRIFT_SMOOTHING = 1.0  # times: sigma of the Gaussian that smooths the fallback's path


def estimate_movers(
    clip: PosedVideo,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
) -> tuple[Mover, ...]:
    """The movers of a clip with known poses, largest first; none where nothing moves.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) of `pairs` (P, 2) of frames;
    `disparity` (T, H, W) in 1 / scene units and `confidence` (T, H, W) of a first depth
    of moving pixels. Where several frames share a time, the first stands for it. Where
    flow gives too few tracks, all moving pixels together are one mover without a shape.
    """
    frames, views = views_in_time(clip, flow, valid, pairs, disparity, confidence)
    if not any(view.moving.any() for view in views):
        return ()
    tracks = follow(views)
    found: list[Found] = []
    if len(tracks.trust):
        found = things(tracks, Cameras(clip.K[frames], clip.c2w[frames]))
    if not found:
        return (mover_without_tracks(np.array(frames), views),)
    movers = tuple(mover_of(np.array(frames), tracks, group) for group in found)
    shapes = sum(mover.has_shape for mover in movers)
    say(f"movers: {len(movers)} found on {len(tracks.trust)} tracks, {shapes} with a shape")
    return movers


def mover_of(frames: np.ndarray, tracks: Tracks, found: Found) -> Mover:
    """A group of tracks, and its shape where there is one, as a mover."""
    group, shape = found
    points = np.full((len(group.members), 3), np.nan)
    motion = group
    if shape is not None:
        points, motion = shape.points, shape.group
    return Mover(
        frames=frames,
        pixels=tracks.pixels[group.members],
        trust=tracks.trust[group.members],
        points=points,
        rotations=motion.rotations,
        translations=motion.shifts,
        center=motion.center,
        known=motion.known,
        error=np.inf if shape is None else shape.error,
    )


def mover_without_tracks(frames: np.ndarray, views: list[View]) -> Mover:
    """The fallback where flow gives no tracks: all moving pixels follow the median of
    their points, without rotation.
    """
    times = np.arange(len(views))
    seen = np.array([view.moving.any() for view in views])
    medians = np.array([np.median(v.points[v.moving], 0) for v in views if v.moving.any()])
    path = np.stack([np.interp(times, times[seen], axis) for axis in medians.T], 1)
    path = ndimage.gaussian_filter1d(path, DRIFT_SMOOTHING, axis=0, mode="nearest")
    count = len(views)
    return Mover(
        frames=frames,
        pixels=np.zeros((0, count, 2)),
        trust=np.zeros((0, count)),
        points=np.zeros((0, 3)),
        rotations=np.tile(np.eye(3), (count, 1, 1)),
        translations=path - path[0],
        center=path[0],
        known=seen,
        error=np.inf,
    )


def views_in_time(
    clip: PosedVideo,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
) -> tuple[list[int], list[View]]:
    """One frame of every time, in order, and what it shows of its moving pixels; flow
    joins frames that follow each other.
    """
    _, first = np.unique(clip.times, return_index=True)
    frames = [int(f) for f in first]
    steps = {(s.start, s.end): s for s in steps_in_time(clip.times, flow, valid, pairs)}
    height, width = clip.size
    y, x = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([x, y], -1).reshape(-1, 2)
    views = []
    for k, f in enumerate(frames):
        depth = np.maximum(disparity[f].reshape(-1), 1e-9).astype(np.float64)
        points = clip.unproject(f, pixels, depth).reshape(height, width, 3)
        flows, valids = {}, {}
        onward = steps.get((f, frames[k + 1])) if k + 1 < len(frames) else None
        if onward is not None:
            flows[1], valids[1] = onward.flow, onward.valid
        before = steps.get((frames[k - 1], f)) if k else None
        if before is not None:
            flows[-1], valids[-1] = before.back, before.back_valid
        views.append(View(clip.moving[f], points, confidence[f], flows, valids))
    return frames, views
