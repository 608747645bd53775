"""Sparse correspondences: SIFT keypoints (Lowe 2004) on exposure-equalized frames,
matched between chosen pairs of frames.

Small frames are doubled, others are smoothed against noise, and local contrast is
leveled first: at 240x136 there are too few keypoints otherwise, and too coarse ones.
Positions are pixels of the frames as given, centers at +0.5.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import ArrayStack


@dataclass(frozen=True)
class MatchingTuning:
    """Keypoints, their matches, and which pairs of frames are matched.

    Hand-chosen on rendered clips of 240 to 480 pixels if no other origin is given.
    """

    max_keypoints: int = 1000  # per frame, the strongest ones
    contrast_threshold: float = 0.02  # of SIFT; half of OpenCV's, for dark frames
    max_ratio: float = 0.85  # of descriptor distances, best to second best (Lowe 2004: 0.8)
    small_side: int = 480  # pixels: frames whose longer side is shorter are doubled
    # standard deviation of the Gaussian that quiets the noise of other frames; doubling
    # does so by itself (640x360, a small sensor: 1.6 times as many matches)
    denoise_px: float = 0.7
    clahe_clip: float = 2.0  # contrast limit of histogram equalization in tiles (CLAHE)
    clahe_tiles: int = 8  # along each side
    mask_margin_px: int = 2  # keypoints keep this distance from ignored pixels
    neighbors: int = 4  # following frames that every frame is matched with
    max_exhaustive_views: int = 30  # up to this many views, all pairs are matched


@dataclass(frozen=True)
class Keypoints:
    """The SIFT keypoints of one frame."""

    xy: np.ndarray  # (N, 2) pixels
    # (N, 128) square-rooted SIFT (Arandjelovic and Zisserman 2012): unit length, so a
    # dot product is a cosine
    descriptors: np.ndarray


@dataclass(frozen=True)
class PairMatches:
    """Mutual nearest neighbors between two frames."""

    i: int
    j: int
    p: np.ndarray  # (M, 2) pixels in frame i
    q: np.ndarray  # (M, 2) pixels in frame j


def upsampling_factor(size: tuple[int, ...], tuning: MatchingTuning = MatchingTuning()) -> int:
    """How many times a frame of `size`, in pixels, is enlarged for detection."""
    return 2 if max(size) < tuning.small_side else 1


def sift_image(
    frame: np.ndarray,
    scale: int,
    level_contrast: bool,
    tuning: MatchingTuning = MatchingTuning(),
) -> np.ndarray:
    """The 8-bit gray image (H * scale, W * scale) in which keypoints are detected, from
    rgb (H, W, 3) in [0, 1].
    """
    rgb = np.rint(np.clip(frame, 0, 1) * 255).astype(np.uint8)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if scale != 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    elif tuning.denoise_px:
        gray = cv2.GaussianBlur(gray, (0, 0), tuning.denoise_px)
    if not level_contrast:
        return gray
    tiles = (tuning.clahe_tiles, tuning.clahe_tiles)
    return cv2.createCLAHE(tuning.clahe_clip, tiles).apply(gray)


def keypoint_mask(ignore: np.ndarray, scale: int, margin: int) -> np.ndarray:
    """255 where keypoints may lie, (H * scale, W * scale) uint8: outside `ignore` (H,
    W) bool grown by `margin` pixels.
    """
    side = 2 * margin + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    grown = cv2.dilate(ignore.astype(np.uint8), disk)
    return np.kron(255 - 255 * grown, np.ones((scale, scale), np.uint8)).astype(np.uint8)


def detect_keypoints(
    video: ArrayStack, ignore: np.ndarray, tuning: MatchingTuning = MatchingTuning()
) -> list[Keypoints]:
    """The strongest keypoints of every frame of `video` (T, H, W, 3) in [0, 1], none in
    `ignore` (T, H, W) bool.
    """
    sift = cv2.SIFT.create(
        nfeatures=tuning.max_keypoints,
        contrastThreshold=tuning.contrast_threshold,
        enable_precise_upscale=True,
    )
    scale = upsampling_factor(video.shape[1:3], tuning)
    detected = []
    for t in track(range(len(video)), "keypoints"):
        mask = keypoint_mask(ignore[t], scale, tuning.mask_margin_px)
        points, sift_descriptors = sift.detectAndCompute(
            sift_image(video[t], scale, True, tuning), mask
        )
        if sift_descriptors is None:
            detected.append(Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32)))
            continue
        total = np.maximum(sift_descriptors.sum(1, keepdims=True), 1e-9)
        xy = (np.asarray(cv2.KeyPoint.convert(points)) + 0.5) / scale
        detected.append(Keypoints(xy, np.sqrt(sift_descriptors / total)))
    return detected


def match_keypoints(
    a: Keypoints, b: Keypoints, tuning: MatchingTuning = MatchingTuning()
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (M, 2), (M, 2) of mutual nearest neighbors that pass the ratio test."""
    rows, columns = mutual_neighbors(a.descriptors @ b.descriptors.T, tuning.max_ratio)
    return a.xy[rows], b.xy[columns]


def mutual_neighbors(
    cosine: np.ndarray, max_ratio: float, min_cosine: float = -1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (M,) and columns (M,) of the `cosine` (A, B) of descriptors that are each
    other's best, above `min_cosine`, and pass the ratio test; `cosine` is changed.
    """
    if min(cosine.shape) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    best = np.argmax(cosine, 1)
    rows = np.arange(len(best))
    best_cosine = cosine[rows, best]
    mutual = np.argmax(cosine, 0)[best] == rows
    cosine[rows, best] = -1
    second_cosine = cosine.max(1)
    # squared distances of unit vectors are 2 (1 - cosine)
    distinct = 1 - best_cosine < max_ratio**2 * (1 - second_cosine)
    kept = mutual & distinct & (best_cosine > min_cosine)
    return rows[kept], best[kept]


def match_pairs(
    keypoints: list[Keypoints],
    pairs: list[tuple[int, int]],
    tuning: MatchingTuning = MatchingTuning(),
) -> list[PairMatches]:
    """Matches of every pair of frames."""
    return [
        PairMatches(i, j, *match_keypoints(keypoints[i], keypoints[j], tuning))
        for i, j in track(pairs, "matches")
    ]


def spread_pairs(count: int, tuning: MatchingTuning = MatchingTuning()) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of `count` frames: the next few of each, then gaps of 6, 8,
    12, 16, 24, 32, ... frames.

    Gaps in this series are multiples of 2 or 3 or both, so that for every usual
    exposure cycle each frame also meets frames of its own exposure.
    """
    gaps = set(range(1, tuning.neighbors + 1))
    for k in range(1, 20):
        gaps |= {2 * 2**k, 3 * 2**k}
    return [(i, i + gap) for gap in sorted(gaps) for i in range(count - gap)]


def camera_groups(camera_ids: list[int]) -> list[list[int]]:
    """Frame indices of each physical camera, cameras in ascending order."""
    return [
        [t for t, c in enumerate(camera_ids) if c == camera] for camera in sorted(set(camera_ids))
    ]


def view_pairs(
    groups: list[list[int]], tuning: MatchingTuning = MatchingTuning()
) -> list[tuple[int, int]]:
    """Which views to match, given the views of each camera.

    All pairs of up to `max_exhaustive_views` views; of more, those of one camera as
    `spread_pairs` chooses them, and those of two cameras at the same time.
    """
    views = sorted(v for group in groups for v in group)
    if len(views) <= tuning.max_exhaustive_views:
        return list(itertools.combinations(views, 2))
    pairs = {(group[i], group[j]) for group in groups for i, j in spread_pairs(len(group), tuning)}
    for a, b in itertools.combinations(groups, 2):
        short, long = sorted((a, b), key=len)
        pairs |= {(view, short[k * len(short) // len(long)]) for k, view in enumerate(long)}
    return sorted({(min(p), max(p)) for p in pairs})
