"""Cameras without parallax: a tripod or a pan. Recognizes such footage and estimates
its rotations.

A camera that only turns moves every static point by the homography `K R_j^T R_i K^-1`
(R camera to world; Hartley and Zisserman 2004, section 8.4). First rotations along a
tree of pairs are adjusted to all matches at once (`rotation_adjustment.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.geometry.alignment import nearest_rotation
from hdr_nsff.priors.poses.matching import (
    MatchingTuning,
    PairMatches,
    detect_keypoints,
    match_pairs,
    spread_pairs,
)
from hdr_nsff.priors.poses.rotation_adjustment import (
    RotationMatches,
    refine,
    robust_cost,
    rotate_pixels,
)

MAX_RANSAC_STEPS = 2000
RANSAC_CONFIDENCE = 0.999
MIN_AHEAD = 0.1  # cosine: what is 84 degrees off the axis or more is in no picture
ROOT_CANDIDATES = 8  # frames tried as the root of the tree of pairs


@dataclass(frozen=True)
class RotationTuning:
    """When matches support a homography, and when a turn fixes the focal length.

    Hand-chosen on painted and rendered clips if no other origin is given.
    """

    # fields of view are across the longer side of the image, however the camera is held
    default_fov_degrees: float = 60.0  # where the footage does not fix it
    homography_error_px: float = 1.5  # of inliers
    epipolar_error_px: float = 1.0  # of inliers
    min_pair_matches: int = 20  # of inliers of a pair's homography ...
    min_inlier_share: float = 1 / 3  # ... and their share of the pair's matches
    max_pair_matches: int = 60  # of a pair that enter the adjustment
    # the focal length is taken from the turn when its logarithm is this certain and the
    # field of view within these limits
    max_log_focal_deviation: float = 0.05
    min_fov_degrees: float = 25.0
    max_fov_degrees: float = 120.0
    # a lens is long where one of this field of view explains the matches better than
    # the default by this factor (a painted slide past a wall: 100; a pan of 20 degrees,
    # cut from the middle of a wider one: 4; clips with parallax: up to 1.1)
    long_fov_degrees: float = 10.0
    min_long_cost_ratio: float = 1.5
    explained_error_px: float = 2.0  # of matches that count as explained by the rotations
    min_explained: float = 0.8  # share of the matches, for footage that is only rotations
    max_tripod_motion_px: float = 0.75  # farthest displacement of a camera that stands still
    # pairs count as far apart from this share of the largest gap on
    min_gap_share: float = 1 / 6
    min_far_matches: int = 30  # static matches of such a pair
    min_static_matches: int = 150  # of all such pairs
    # a rotation explains a static match to this error, or to this share of the longer
    # side
    rotation_error_px: float = 1.5
    rotation_error_share: float = 0.004


@dataclass(frozen=True)
class Panorama:
    """The rotations of a camera that stands still."""

    rotations: np.ndarray  # (T, 3, 3) camera to world; the middle frame looks along +z
    linked: np.ndarray  # (T,) bool: enough matches link this frame to the others
    focal: float  # pixels
    focal_known: bool  # else it is that of the default field of view, or of a long lens
    # behind a long lens, a camera that turns sees what one that slides past something
    # flat does
    long_lens: bool
    explained: float  # share of the matches that these rotations explain
    frame_errors: np.ndarray  # (T,) median residual in pixels, NaN where not linked
    # pixels: the farthest that the image center or a corner moves away from its
    # position in the middle frame
    max_displacement: float


def default_focal(longer_side: int, tuning: RotationTuning = RotationTuning()) -> float:
    """The focal length in pixels of a camera with the default field of view across the
    `longer_side` of the image, in pixels.
    """
    return focal_length(tuning.default_fov_degrees, longer_side)


def focal_length(fov_degrees: float, longer_side: int) -> float:
    """The focal length in pixels of a field of view across the `longer_side` of an
    image, in pixels.
    """
    return longer_side / 2 / float(np.tan(np.radians(fov_degrees) / 2))


def field_of_view(focal: float, width: int, height: int) -> float:
    """The field of view in degrees across the longer side of an image, which is the
    same however the camera is held. All arguments are in pixels.
    """
    return float(np.degrees(2 * np.arctan(max(width, height) / 2 / focal)))


def epipolar(
    p: np.ndarray, q: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """The fundamental matrix (3, 3) that most of the matches p, q (M, 2) obey, and
    which (M,) bool do, to `threshold` pixels. None where no model fits.
    """
    try:
        matrix, inliers = cv2.findFundamentalMat(
            p, q, cv2.USAC_MAGSAC, threshold, RANSAC_CONFIDENCE, MAX_RANSAC_STEPS
        )
    except cv2.error:  # raised for matches so degenerate that no model fits at all
        matrix = None
    if matrix is None:
        return None, np.zeros(len(p), bool)
    return matrix, inliers.ravel() > 0


def homography(
    p: np.ndarray, q: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """The homography (3, 3) that most of the matches p, q (M, 2) obey, and which (M,)
    bool do, to `threshold` pixels. None where no model fits.
    """
    try:
        matrix, inliers = cv2.findHomography(
            p,
            q,
            cv2.USAC_MAGSAC,
            threshold,
            maxIters=MAX_RANSAC_STEPS,
            confidence=RANSAC_CONFIDENCE,
        )
    except cv2.error:
        matrix = None
    if matrix is None:
        return None, np.zeros(len(p), bool)
    return matrix, inliers.ravel() > 0


def rotation_share(
    matches: list[PairMatches],
    panorama: Panorama,
    width: int,
    height: int,
    tuning: RotationTuning = RotationTuning(),
) -> float | None:
    """The share of static matches, in [0, 1], that the rotations of a `panorama`
    explain.

    Static are matches that obey an epipolar geometry, over pairs far apart in time.
    Near 1 for a camera that only turns, well below with parallax; a flat scene does not
    deceive it. None where too few pairs far apart match at all.
    """
    min_gap = max((m.j - m.i for m in matches), default=0) * tuning.min_gap_share
    center = np.array([width / 2, height / 2])
    tolerance = max(tuning.rotation_error_px, tuning.rotation_error_share * max(width, height))
    num_explained = num_static = 0
    for m in matches:
        if m.j - m.i < min_gap or len(m.p) < tuning.min_far_matches:
            continue
        _, is_static = epipolar(m.p, m.q, tuning.epipolar_error_px)
        count = int(is_static.sum())
        if count < tuning.min_far_matches:
            continue
        frames = np.tile([m.i, m.j], (count, 1))
        predicted, _ = rotate_pixels(
            panorama.rotations, panorama.focal, frames, m.p[is_static] - center
        )
        error = np.linalg.norm(predicted + center - m.q[is_static], axis=1)
        num_explained += int((error < tolerance).sum())
        num_static += count
    if num_static < tuning.min_static_matches:
        return None
    return num_explained / num_static


def fit_video(
    video: ArrayStack,
    ignore: np.ndarray,
    matching: MatchingTuning,
    tuning: RotationTuning = RotationTuning(),
) -> Panorama | None:
    """The rotations of one camera from all of its frames (T, H, W, 3) in [0, 1], pixels
    in `ignore` (T, H, W) bool left out. None where nothing matches.
    """
    count, height, width = video.shape[:3]
    keypoints = detect_keypoints(video, ignore, matching)
    matches = match_pairs(keypoints, spread_pairs(count, matching), matching)
    return fit_panorama(matches, count, width, height, tuning)


def fit_panorama(
    matches: list[PairMatches],
    count: int,
    width: int,
    height: int,
    tuning: RotationTuning = RotationTuning(),
) -> Panorama | None:
    """Rotations of all `count` frames, and the focal length where the turn is wide
    enough to fix it. None where nothing matches.
    """
    kept, homographies = planar_matches(matches, tuning)
    if not kept:
        return None
    center = np.array([width / 2, height / 2])
    guess = default_focal(max(width, height), tuning)
    chained, linked = chain_rotations(kept, homographies, count, guess, center)
    pairs = collect_matches([m for m in kept if linked[m.i] and linked[m.j]], center)
    held = refine(chained, guess, pairs, False)
    free = refine(held.rotations, guess, pairs, True)
    fov = field_of_view(free.focal, width, height)
    plausible = tuning.min_fov_degrees < fov < tuning.max_fov_degrees
    focal_known = plausible and free.log_focal_deviation < tuning.max_log_focal_deviation
    best, long_lens = free if focal_known else held, False
    if not focal_known:
        focal = focal_length(tuning.long_fov_degrees, max(width, height))
        long = refine(free.rotations, focal, pairs, False)
        cost, long_cost = (robust_cost(f.rotations, f.focal, pairs) for f in (held, long))
        if cost > tuning.min_long_cost_ratio * long_cost:
            best, long_lens = long, True
    predicted, _ = rotate_pixels(best.rotations, best.focal, pairs.frames, pairs.p)
    residual = np.linalg.norm(predicted - pairs.q, axis=1)
    frame_errors = np.full(count, np.nan)
    for t in np.unique(pairs.frames):
        frame_errors[t] = np.median(residual[(pairs.frames == t).any(1)])
    rotations = best.rotations[count // 2].T @ best.rotations
    return Panorama(
        rotations=rotations,
        linked=linked,
        focal=best.focal,
        focal_known=focal_known,
        long_lens=long_lens,
        explained=float((residual < tuning.explained_error_px).mean()),
        frame_errors=frame_errors,
        max_displacement=max_displacement(rotations[linked], best.focal, width, height),
    )


def collect_matches(pairs: Sequence[PairMatches], center: np.ndarray) -> RotationMatches:
    """The matches of all pairs in one record, relative to the image `center` (2,)."""
    return RotationMatches(
        frames=np.repeat([(m.i, m.j) for m in pairs], [len(m.p) for m in pairs], axis=0),
        p=np.concatenate([m.p for m in pairs]) - center,
        q=np.concatenate([m.q for m in pairs]) - center,
    )


def planar_matches(
    matches: list[PairMatches], tuning: RotationTuning = RotationTuning()
) -> tuple[list[PairMatches], list[np.ndarray]]:
    """The inliers of every pair that a homography explains, spread over the pair and
    limited in number, and those homographies (3, 3).
    """
    kept, homographies = [], []
    for m in matches:
        count = len(m.p)
        if count < tuning.min_pair_matches:
            continue
        matrix, is_inlier = homography(m.p, m.q, tuning.homography_error_px)
        inliers = np.flatnonzero(is_inlier)
        required = max(tuning.min_pair_matches, count * tuning.min_inlier_share)
        if matrix is None or len(inliers) < required:
            continue
        num_chosen = min(tuning.max_pair_matches, len(inliers))
        chosen = inliers[np.linspace(0, len(inliers) - 1, num_chosen).astype(int)]
        kept.append(PairMatches(m.i, m.j, m.p[chosen], m.q[chosen]))
        homographies.append(matrix)
    return kept, homographies


def chain_rotations(
    pairs: list[PairMatches],
    homographies: list[np.ndarray],
    count: int,
    focal: float,
    center: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """First rotations (T, 3, 3) along the best-matched tree of pairs, and which frames
    (T,) it reaches from the best-linked one.
    """
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    relative = {
        (m.i, m.j): rotation_up_to_scale(np.linalg.inv(K) @ h @ K)
        for m, h in zip(pairs, homographies, strict=True)
    }  # R_j^T R_i
    i, j = np.array(list(relative)).T
    num_matches = np.array([len(m.p) for m in pairs])
    lengths = 1.0 / num_matches * (1 + 0.01 * (j - i))  # many matches, then near frames
    tree = minimum_spanning_tree(coo_matrix((lengths, (i, j)), shape=(count, count)))
    roots = np.unique(i)[:: max(1, len(np.unique(i)) // ROOT_CANDIDATES)]
    searches = [breadth_first_order(tree, int(t), directed=False) for t in roots]
    order, parent = max(searches, key=lambda search: len(search[0]))
    rotations, linked = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)
    linked[order] = True
    for t in order[1:]:
        s = parent[t]
        to_parent = relative[(s, t)].T if (s, t) in relative else relative[(t, s)]
        rotations[t] = rotations[s] @ to_parent
    return rotations, linked


def rotation_up_to_scale(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to a `matrix` (3, 3) up to a factor."""
    return nearest_rotation(matrix / np.cbrt(np.linalg.det(matrix)))


def max_displacement(rotations: np.ndarray, focal: float, width: int, height: int) -> float:
    """The farthest, in pixels, that any of `rotations` (T, 3, 3) moves the image's
    center or a corner from its position in the middle frame. Where it comes to lie
    behind the camera or almost sideways, the width of the image counts.
    """
    corners = np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
    positions = corners * np.array([width, height]) / 2
    count = len(rotations)
    sources = np.repeat(np.arange(count), len(positions))
    frames = np.stack([sources, np.full_like(sources, count // 2)], 1)
    p = np.tile(positions, (count, 1))
    moved, directions = rotate_pixels(rotations, focal, frames, p)
    ahead = directions[:, 2] > MIN_AHEAD * np.linalg.norm(directions, axis=1)
    return float(np.where(ahead, np.linalg.norm(moved - p, axis=1), width).max())
