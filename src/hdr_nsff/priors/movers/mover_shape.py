"""The relief of moving things: depth of moving pixels from the shape and motion that
their tracks tell (`groups.py`, `bundle.py`), where `movers.py` knew one distance per
region only.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from hdr_nsff.core.progress import say
from hdr_nsff.priors.movers.bundle import Cameras, Shape
from hdr_nsff.priors.movers.distance import steps_in_time
from hdr_nsff.priors.movers.motion_segmentation import LEAST_TRACKS, things
from hdr_nsff.priors.movers.rigid_groups import Tracks, View, follow
from hdr_nsff.scene.posed_video import PosedVideo

NEIGHBORS = 4  # tracks that a pixel's depth is taken from
REACH = 8.0  # pixels to the nearest of them
SURE = 0.5  # confidence right at a track: its distance as a whole is the prior's
CHANGE = 2.0  # a pixel's depth may change by this factor


def relief(
    clip: PosedVideo,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """`disparity` and `confidence` (T, H, W) with relief inside the moving masks of
    `clip`, where tracks tell it.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) of `pairs` (P, 2). Several frames of
    one time: the first of them speaks.
    """
    frames, views = views_in_time(clip, flow, valid, pairs, disparity, confidence)
    if len(frames) < 4 or not any(v.moving.any() for v in views):
        return disparity, confidence
    tracks = follow(views)
    if len(tracks.trust) < LEAST_TRACKS:
        return disparity, confidence
    cameras = Cameras(clip.K[frames], clip.c2w[frames])
    found = things(tracks, cameras)
    shapes = [shape for _, shape in found if shape]
    say(
        f"depth: the shape of {len(shapes)} of {len(found)} moving things found from {len(tracks.trust)} tracks"
    )
    disparity, confidence = disparity.copy(), confidence.copy()
    for t, f in enumerate(frames):
        apply(clip.moving[f], clip.c2w[f], t, tracks, shapes, disparity[f], confidence[f])
    return disparity, confidence


def views_in_time(
    clip: PosedVideo,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
) -> tuple[list[int], list[View]]:
    """One frame of every time, in order, and what it knows of its moving pixels; flow
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
        points = clip.unproject(
            f, pixels, np.maximum(disparity[f].reshape(-1), 1e-9).astype(np.float64)
        ).reshape(height, width, 3)
        flows, valids = {}, {}
        if k + 1 < len(frames) and (s := steps.get((f, frames[k + 1]))):
            flows[1], valids[1] = s.flow, s.valid
        if k and (s := steps.get((frames[k - 1], f))):
            flows[-1], valids[-1] = s.back, s.back_valid
        views.append(View(clip.moving[f], points, confidence[f], flows, valids))
    return frames, views


def apply(
    moving: np.ndarray,
    c2w: np.ndarray,
    t: int,
    tracks: Tracks,
    shapes: list[Shape],
    disparity: np.ndarray,
    confidence: np.ndarray,
) -> None:
    """Put the shapes' depth into the maps (H, W) of time `t`, in place: every `moving`
    pixel near a track, from the tracks of its thing, as the camera at `c2w` (3, 4) sees
    it.
    """
    at, inverse, owner = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0, int)]
    for k, shape in enumerate(shapes):
        pixels, points = tracks.pixels[shape.group.members, t], shape.at(t)
        depth = (points - c2w[:, 3]) @ c2w[:, 2]
        told = np.isfinite(pixels[:, 0]) & np.isfinite(depth) & (depth > 1e-6)
        at.append(pixels[told])
        inverse.append(1 / depth[told])
        owner.append(np.full(int(told.sum()), k))
    place, value, label = np.concatenate(at), np.concatenate(inverse), np.concatenate(owner)
    y, x = np.nonzero(moving)
    if not len(place) or not len(y):
        return
    distance, nearest = cKDTree(place).query(np.stack([x, y], -1) + 0.5, min(NEIGHBORS, len(place)))
    distance, nearest = distance.reshape(len(y), -1), nearest.reshape(len(y), -1)
    weight = (label[nearest] == label[nearest[:, :1]]) / (distance + 0.5) ** 2
    found = (weight * value[nearest]).sum(1) / weight.sum(1)
    near = (distance[:, 0] < REACH) & (
        np.abs(np.log(found / np.maximum(disparity[y, x], 1e-9))) < np.log(CHANGE)
    )
    y, x = y[near], x[near]
    disparity[y, x] = found[near]
    confidence[y, x] = np.maximum(
        confidence[y, x], SURE * np.exp(-((distance[near, 0] / REACH) ** 2))
    )
