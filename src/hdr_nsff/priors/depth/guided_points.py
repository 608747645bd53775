"""Static points between cameras whose poses are known: SIFT keypoints, matched along
epipolar lines and triangulated.

Cameras that stand still see no parallax of their own, so flow from frame to frame
triangulates nothing. What they see in common at one instant does, also where they stand
far apart: a match need only be found along a line, not in the whole picture.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from hdr_nsff.geometry import pinhole
from hdr_nsff.priors.depth.parallax import disparity_of_flow
from hdr_nsff.priors.poses.matching import (
    Keypoints,
    MatchingTuning,
    detect_keypoints,
    mutual_neighbors,
)
from hdr_nsff.scene.posed_video import PosedVideo


@dataclass(frozen=True)
class GuidedTuning:
    """Matches along epipolar lines, hand-chosen on a rig of four cameras a quarter of a
    circle and more apart.
    """

    num_times: int = 4  # instants that are matched, spread over the clip
    max_line_px: float = 1.5  # distance of a match from its epipolar line
    max_ratio: float = 0.8  # of descriptor distances, best to second best along the line
    min_cosine: float = 0.85  # of descriptors that match
    max_error_px: float = 1.5  # reprojection error of a point
    min_parallax_px: float = 3.0  # of a point
    min_points: int = 30  # fewer are mere chance
    matching: MatchingTuning = field(default_factory=MatchingTuning)


def points_between_cameras(
    clip: PosedVideo, tuning: GuidedTuning = GuidedTuning()
) -> tuple[np.ndarray, np.ndarray]:
    """World points (P, 3) that two cameras see at the same instant, outside of moving
    and clipped pixels, and their observations (2 P, 4): frame, point, x, y in pixels.
    None for fewer than `min_points`.
    """
    instants = [np.flatnonzero(clip.times == time) for time in np.unique(clip.times)]
    shared = [frames for frames in instants if len(frames) > 1]
    spread = np.linspace(0, len(shared) - 1, min(tuning.num_times, len(shared)))
    pairs = [pair for k in spread.astype(int) for pair in itertools.combinations(shared[k], 2)]
    frames = np.unique(np.array(pairs, int))
    ignore = clip.moving[frames] | np.array(clip.clipped[frames])
    found = detect_keypoints(clip.video[frames], ignore, tuning.matching)
    keypoints = dict(zip(frames, found, strict=True))
    points, tracks, count = [np.zeros((0, 3))], [np.zeros((0, 4))], 0
    for i, j in pairs:
        p, q = match_along_lines(clip, i, j, keypoints[i], keypoints[j], tuning)
        disparity, error, parallax_px = disparity_of_flow(clip, i, j, p, q)
        kept = (disparity > 0) & (error < tuning.max_error_px)
        kept &= parallax_px > tuning.min_parallax_px
        world = clip.unproject(i, p[kept], disparity[kept])
        inside = clip.project(j, world)[2]  # in front of both
        points.append(world[inside])
        index = count + np.arange(inside.sum())
        for frame, seen in ((i, p[kept][inside]), (j, q[kept][inside])):
            tracks.append(np.column_stack([np.full(len(index), frame), index, seen]))
        count += len(index)
    if count < tuning.min_points:
        return points[0], tracks[0]
    return np.concatenate(points), np.concatenate(tracks)


def match_along_lines(
    clip: PosedVideo, i: int, j: int, a: Keypoints, b: Keypoints, tuning: GuidedTuning
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (M, 2), (M, 2) in frames i and j of mutual nearest neighbors among the
    keypoints `a` and `b` that lie on each other's epipolar lines.
    """
    there, back = line_distances(clip, i, j, a.xy, b.xy), line_distances(clip, j, i, b.xy, a.xy)
    near = np.maximum(there, back.T) < tuning.max_line_px
    cosine = np.where(near, a.descriptors @ b.descriptors.T, -1.0)
    rows, columns = mutual_neighbors(cosine, tuning.max_ratio, tuning.min_cosine)
    return a.xy[rows], b.xy[columns]


def line_distances(clip: PosedVideo, i: int, j: int, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distances (N, M) in pixels of `q` (M, 2) in frame j from the epipolar lines of
    `p` (N, 2) in frame i.
    """
    far, shift = pinhole.transfer(clip.K[i], clip.c2w[i], clip.K[j], clip.c2w[j])
    lines = np.cross(pinhole.homogeneous(p) @ far.T, shift)  # (N, 3)
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return np.abs(lines @ pinhole.homogeneous(q).T)
