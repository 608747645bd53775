"""Static points between cameras whose poses are known: SIFT keypoints, matched along
epipolar lines and triangulated.

Cameras that stand still see no parallax of their own, so flow from frame to frame
triangulates nothing. What they see in common at one instant does, also where they stand
far apart: a match need only be found along a line, not in the whole picture.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.poses import Poses, project
from hdr_nsff.priors.poses.matching import Keypoints, MatchingTuning, detect_keypoints


@dataclass(frozen=True)
class GuidedTuning:
    """Matches along epipolar lines, hand-chosen on a rig of four cameras a quarter of a
    circle and more apart.
    """

    num_times: int = 4  # instants that are matched, spread over the clip
    max_line_px: float = 1.5  # distance of a match from its epipolar line
    # of descriptor distances, best to second best along the line
    max_ratio: float = 0.8
    min_cosine: float = 0.85  # of descriptors that match
    max_error_px: float = 1.5  # reprojection error of a point
    min_parallax_degrees: float = 1.0  # between its two rays
    min_points: int = 30  # fewer are mere chance
    matching: MatchingTuning = field(default_factory=MatchingTuning)


def points_between_cameras(
    poses: Poses,
    video: ArrayStack,
    ignore: np.ndarray,
    times: np.ndarray,
    tuning: GuidedTuning = GuidedTuning(),
) -> Poses:
    """`poses` with the static points that two cameras see at the same instant; as they
    are for fewer than `min_points`.

    `video` (T, H, W, 3) in [0, 1] at `times` (T,), without the pixels `ignore` (T, H,
    W) bool.
    """
    instants = [np.flatnonzero(times == time) for time in np.unique(times)]
    shared = [frames for frames in instants if len(frames) > 1]
    spread = np.linspace(0, len(shared) - 1, min(tuning.num_times, len(shared)))
    pairs = [pair for k in spread.astype(int) for pair in itertools.combinations(shared[k], 2)]
    frames = np.unique(np.array(pairs, int))
    found = detect_keypoints(video[frames], ignore[frames], tuning.matching)
    keypoints = dict(zip(frames, found, strict=True))
    points, errors, tracks = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros((0, 4))]
    count = 0
    for i, j in pairs:
        p, q = match_along_lines(poses, i, j, keypoints[i], keypoints[j], tuning)
        world, error = triangulate_pair(poses, i, j, p, q)
        kept = error < tuning.max_error_px
        kept &= parallax_degrees(poses, i, j, world) > tuning.min_parallax_degrees
        points.append(world[kept])
        errors.append(error[kept])
        index = np.arange(count, count + len(points[-1]))
        for frame, seen in ((i, p[kept]), (j, q[kept])):
            tracks.append(np.column_stack([np.full(len(index), frame), index, seen]))
        count += len(index)
    if count < tuning.min_points:
        return poses
    return replace(
        poses,
        points=np.concatenate(points),
        point_errors=np.concatenate(errors),
        tracks=np.concatenate(tracks),
    )


def match_along_lines(
    poses: Poses, i: int, j: int, a: Keypoints, b: Keypoints, tuning: GuidedTuning
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (M, 2), (M, 2) in frames i and j of mutual nearest neighbors among the
    keypoints `a` and `b` that lie on each other's epipolar lines.
    """
    if len(a.xy) < 2 or len(b.xy) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    there, back = line_distances(poses, i, j, a.xy, b.xy), line_distances(poses, j, i, b.xy, a.xy)
    off = np.maximum(there, back.T)
    cosine = np.where(off < tuning.max_line_px, a.descriptors @ b.descriptors.T, -1.0)
    rows, best = np.arange(len(a.xy)), np.argmax(cosine, 1)
    mutual = np.argmax(cosine, 0)[best] == rows
    best_cosine = cosine[rows, best]
    cosine[rows, best] = -1
    # squared distances of unit vectors are 2 (1 - cosine)
    distinct = 1 - best_cosine < tuning.max_ratio**2 * (1 - cosine.max(1))
    kept = mutual & distinct & (best_cosine > tuning.min_cosine)
    return a.xy[kept], b.xy[best[kept]]


def line_distances(poses: Poses, i: int, j: int, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distances (N, M) in pixels of `q` (M, 2) in frame j from the epipolar lines of
    `p` (N, 2) in frame i.
    """
    far, shift = pinhole.transfer(poses.K[i], poses.c2w[i], poses.K[j], poses.c2w[j])
    lines = np.cross(pinhole.homogeneous(p) @ far.T, shift)  # (N, 3)
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return np.abs(lines @ pinhole.homogeneous(q).T)


def triangulate_pair(
    poses: Poses, i: int, j: int, p: np.ndarray, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """World points (M, 3) midway between the rays of pixels `p` and `q` (M, 2) of
    frames i and j, and their mean reprojection errors (M,) in pixels; Inf behind a
    camera.
    """
    rays = [pinhole.world_rays(x, poses.K[t], poses.c2w[t]) for x, t in ((p, i), (q, j))]
    eyes = [poses.c2w[t, :, 3] for t in (i, j)]
    # least squares of eye_i + s ray_i = eye_j + t ray_j
    system = np.stack([rays[0], -rays[1]], -1)  # (M, 3, 2)
    depths = np.einsum("mkn,n->mk", np.linalg.pinv(system), eyes[1] - eyes[0])
    points = (eyes[0] + depths[:, :1] * rays[0] + eyes[1] + depths[:, 1:] * rays[1]) / 2
    error = np.zeros(len(points))
    for t, seen in ((i, p), (j, q)):
        pixels, depth = project(poses, np.full(len(points), t), points)
        residual = np.linalg.norm(pixels - seen, axis=1) / 2
        error += np.where(depth > pinhole.MIN_DEPTH, residual, np.inf)
    return points, error


def parallax_degrees(poses: Poses, i: int, j: int, points: np.ndarray) -> np.ndarray:
    """The angles (M,) at which the cameras of frames i and j stand, seen from `points`
    (M, 3).
    """
    to_i, to_j = (points - poses.c2w[t, :, 3] for t in (i, j))
    lengths = np.linalg.norm(to_i, axis=1) * np.linalg.norm(to_j, axis=1)
    cosine = (to_i * to_j).sum(1) / np.maximum(lengths, 1e-12)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
