"""The moving objects of a clip: their tracks, their rigid motion and their shape.

Tracks are chains of optical flow through moving pixels (`tracks.py`), lifted by a first
depth that may be wrong (`distance.py`). They are grouped by rigid motion
(`rigid_groups.py`, `motion_segmentation.py`), and every group gets shape and motion by
bundle adjustment (`bundle.py`).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from hdr_nsff.core.progress import say
from hdr_nsff.geometry import pinhole
from hdr_nsff.priors.movers.bundle_problem import Cameras
from hdr_nsff.priors.movers.motion_segmentation import Segment, segment_tracks
from hdr_nsff.priors.movers.regions import flow_steps
from hdr_nsff.priors.movers.tracks import MovingView, Tracks, follow_moving_pixels
from hdr_nsff.priors.movers.tuning import MOVERS_TUNING, MoversTuning
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.posed_video import PosedVideo


def estimate_movers(
    clip: PosedVideo,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
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
    tracks = follow_moving_pixels(views, tuning.tracks)
    segments: list[Segment] = []
    if len(tracks.trust):
        cameras = Cameras(clip.K[frames], clip.c2w[frames])
        segments = segment_tracks(tracks, cameras, tuning)
    if not segments:
        return (mover_without_tracks(np.array(frames), views, tuning),)
    movers = tuple(mover_of(np.array(frames), tracks, segment) for segment in segments)
    shapes = sum(mover.has_shape for mover in movers)
    say(f"movers: {len(movers)} found on {len(tracks.trust)} tracks, {shapes} with a shape")
    return movers


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
    )


def mover_without_tracks(
    frames: np.ndarray, views: list[MovingView], tuning: MoversTuning = MOVERS_TUNING
) -> Mover:
    """The one mover of all moving pixels, where flow gives no tracks.

    It follows the median of their points, without rotation.
    """
    num = len(views)
    times = np.arange(num)
    visible = np.array([view.moving.any() for view in views])
    medians = np.array(
        [np.median(view.points[view.moving], 0) for view in views if view.moving.any()]
    )
    path = np.stack([np.interp(times, times[visible], axis) for axis in medians.T], 1)
    sigma = tuning.fallback_smoothing_times
    path = ndimage.gaussian_filter1d(path, sigma, axis=0, mode="nearest")
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


def views_by_time(
    clip: PosedVideo,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
) -> tuple[list[int], list[MovingView]]:
    """One frame of every time, in order, and its view of the moving pixels.

    The arguments are those of `estimate_movers`. Flow counts between the frames of
    consecutive times.
    """
    _, first = np.unique(clip.times, return_index=True)
    frames = [int(f) for f in first]
    steps = {(s.start, s.end): s for s in flow_steps(clip.times, flow, valid, pairs)}
    height, width = clip.size
    pixels = pinhole.pixel_centers(height, width).reshape(-1, 2)
    views = []
    for k, f in enumerate(frames):
        frame_disparity = np.maximum(disparity[f].reshape(-1), 1e-9).astype(np.float64)
        points = clip.unproject(f, pixels, frame_disparity).reshape(height, width, 3)
        flows: dict[int, np.ndarray] = {}
        valids: dict[int, np.ndarray] = {}
        forward = steps.get((f, frames[k + 1])) if k + 1 < len(frames) else None
        backward = steps.get((frames[k - 1], f)) if k > 0 else None
        if forward is not None:
            flows[1], valids[1] = forward.flow, forward.valid
        if backward is not None:
            flows[-1], valids[-1] = backward.back, backward.back_valid
        views.append(MovingView(clip.moving[f], points, confidence[f], flows, valids))
    return frames, views
