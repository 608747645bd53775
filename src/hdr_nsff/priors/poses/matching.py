"""Sparse correspondences: SIFT keypoints on exposure-equalized frames, matched between
chosen pairs of frames.

Small frames are doubled and their local contrast is leveled first: at 240x136 there are
too few keypoints otherwise, and too coarse ones. Positions are pixels of the frames as
given, centers at +0.5.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from hdr_nsff.core.progress import track

SMALL = 480  # frames narrower than this are doubled before keypoints are looked for


@dataclass(frozen=True)
class Keypoints:
    """What SIFT found in one frame."""

    xy: np.ndarray  # (N, 2) pixels
    descriptors: (
        np.ndarray
    )  # (N, 128) square-rooted SIFT: unit length, so a dot product is a cosine


@dataclass(frozen=True)
class PairMatches:
    """Mutual nearest neighbors between two frames."""

    i: int
    j: int
    p: np.ndarray  # (M, 2) pixels in frame i
    q: np.ndarray  # (M, 2) pixels in frame j


def upsampling(width: int) -> int:
    """How many times larger a frame of this width is made before keypoints are looked
    for.
    """
    return 2 if width < SMALL else 1


def picture(frame: np.ndarray, scale: int, level_contrast: bool) -> np.ndarray:
    """The 8-bit gray picture (H * scale, W * scale) in which keypoints are looked for,
    from rgb (H, W, 3) in [0, 1].
    """
    gray = cv2.cvtColor(np.rint(np.clip(frame, 0, 1) * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    if scale != 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return cv2.createCLAHE(2.0, (8, 8)).apply(gray) if level_contrast else gray


def usable(ignore: np.ndarray, scale: int, margin: int = 2) -> np.ndarray:
    """255 where keypoints may lie, (H * scale, W * scale) uint8: outside `ignore` (H,
    W) bool grown by `margin` pixels.
    """
    grown = cv2.dilate(
        ignore.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1,) * 2)
    )
    return np.kron(255 - 255 * grown, np.ones((scale, scale), np.uint8)).astype(np.uint8)


def keypoints(video: np.ndarray, ignore: np.ndarray, limit: int = 1500) -> list[Keypoints]:
    """The `limit` strongest keypoints of every frame of `video` (T, H, W, 3) in [0, 1],
    none in `ignore` (T, H, W) bool.
    """
    sift = cv2.SIFT.create(nfeatures=limit, contrastThreshold=0.02, enable_precise_upscale=True)
    scale = upsampling(video.shape[2])
    found = []
    for t in track(range(len(video)), "keypoints"):
        where = usable(ignore[t], scale)
        points, descriptors = sift.detectAndCompute(picture(video[t], scale, True), where)
        if descriptors is None:
            found.append(Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32)))
            continue
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
        found.append(Keypoints((np.asarray(cv2.KeyPoint.convert(points)) + 0.5) / scale, root))
    return found


def match(a: Keypoints, b: Keypoints, ratio: float = 0.85) -> tuple[np.ndarray, np.ndarray]:
    """Positions (M, 2), (M, 2) of mutual nearest neighbors whose second-best match is
    at least `1 / ratio` times farther.
    """
    if len(a.xy) < 2 or len(b.xy) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    cosine = a.descriptors @ b.descriptors.T
    best = np.argmax(cosine, 1)
    rows = np.arange(len(best))
    first = cosine[rows, best]
    mutual = np.argmax(cosine, 0)[best] == rows
    cosine[rows, best] = -1
    second = cosine.max(1)
    good = mutual & (1 - first < ratio**2 * (1 - second))
    return a.xy[good], b.xy[best[good]]


def spread_pairs(count: int, neighbors: int = 4) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of `count` frames: the next few of each, then gaps of 6, 8,
    12, 16, 24, 32, ... frames.

    Gaps in this series are multiples of 2 or 3 or both, so that for every usual
    exposure cycle each frame also meets frames of its own exposure.
    """
    gaps = set(range(1, neighbors + 1))
    gaps |= {g for k in range(1, 20) for g in (2 * 2**k, 3 * 2**k)}
    return [(i, i + g) for g in sorted(gaps) for i in range(count - g)]


def match_all(found: list[Keypoints], pairs: list[tuple[int, int]]) -> list[PairMatches]:
    """Matches of every pair."""
    return [PairMatches(i, j, *match(found[i], found[j])) for i, j in track(pairs, "matches")]


def camera_groups(camera_ids: list[int]) -> list[list[int]]:
    """Frame indices of each physical camera, cameras in ascending order."""
    return [
        [t for t, c in enumerate(camera_ids) if c == camera] for camera in sorted(set(camera_ids))
    ]


def view_pairs(groups: list[list[int]], few: int = 30) -> list[tuple[int, int]]:
    """Which views to match: all of up to `few`; of more, those of one camera as
    `spread_pairs` says, and those of two cameras at the same time.
    """
    count = sum(len(g) for g in groups)
    if count <= few:
        return list(itertools.combinations(sorted(v for g in groups for v in g), 2))
    pairs = {(group[i], group[j]) for group in groups for i, j in spread_pairs(len(group))}
    for a, b in itertools.combinations(groups, 2):
        short, long = sorted((a, b), key=len)
        pairs |= {(view, short[k * len(short) // len(long)]) for k, view in enumerate(long)}
    return sorted({(min(p), max(p)) for p in pairs})
