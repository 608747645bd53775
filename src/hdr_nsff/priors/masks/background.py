"""Moving masks of a camera that stands or only turns, corrected by what it sees behind:
the median of the whole clip.

Flow wanders where there is no texture (road, sky), and fails inside large plain movers.
With no parallax any frame can be laid over any other exactly, so there a second witness
speaks: a pixel that looks as the background does is not moving unless textured flow
insists, and a patch that differs from the background and is known to move in part moves
as a whole.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from hdr_nsff.core.parallel import in_threads
from hdr_nsff.radiometry.common_range import LUMA, recorded_range

SOURCES = 16  # frames the background is taken from
DIFFERENT = 0.06  # of equalized rgb in [0, 1], beyond noise
TEXTURED = 0.06  # standard deviation of gray in a window, from which flow can be believed
PART = 0.25  # share of a differing patch that must be known to move


def correct_masks(
    moving: np.ndarray,
    video: np.ndarray,
    clipped: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    sources: np.ndarray,
) -> np.ndarray:
    """`moving` (T, H, W) bool corrected by the background.

    `video` (T, H, W, 3) exposure-equalized rgb, `clipped` (T, H, W) bool, `K` (T, 3, 3)
    px, `c2w` (T, 3, 4) without parallax; `sources` indices of the frames that may show
    the background.
    """
    chosen = sources[
        np.unique(np.linspace(0, len(sources) - 1, min(SOURCES, len(sources))).astype(int))
    ]

    def one(i: int) -> np.ndarray:
        differs = different(i, video, clipped, K, c2w, chosen)
        wide = cv2.dilate(differs.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        kept = moving[i] & (wide | textured(video[i]))
        return cleaned(kept | parts(differs, kept))

    return np.stack(in_threads(one, list(range(len(video))), "masks against the background"))


def different(
    i: int,
    video: np.ndarray,
    clipped: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    sources: np.ndarray,
) -> np.ndarray:
    """Where frame `i` differs from the background (H, W) bool; where nothing is known
    of the background it does not.
    """
    height, width = clipped.shape[1:]
    seen = np.full((len(sources), height, width, 3), np.inf, np.float32)
    count = np.zeros((height, width), int)
    for k, j in enumerate(sources):
        there = laid_over(K[i], c2w[i], K[j], c2w[j])
        picture = cv2.warpPerspective(
            video[j], there, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        blocked = cv2.warpPerspective(
            clipped[j].astype(np.float32),
            there,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderValue=1.0,
        )
        free = blocked < 0.01
        seen[k][free] = picture[free]
        count += free
    seen.sort(axis=0)
    middle = np.take_along_axis(seen, (np.maximum(count - 1, 0) // 2)[None, ..., None], 0)[0]
    known = count >= 3
    low, high = recorded_range(video[i], clipped[i])
    difference = np.abs(
        np.clip(video[i], low, high) - np.clip(np.where(known[..., None], middle, 0), low, high)
    ).max(-1)
    noise = 1.4826 * np.median(difference[known]) if known.any() else 0.0
    found = (known & (difference > DIFFERENT + 2 * noise)).astype(np.uint8)
    return cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def laid_over(
    K_from: np.ndarray, from_c2w: np.ndarray, K_to: np.ndarray, to_c2w: np.ndarray
) -> np.ndarray:
    """The homography (3, 3) from array indices (x, y) of one frame to those of another
    with the same center.
    """
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return (
        np.linalg.inv(shift)
        @ K_to
        @ to_c2w[:, :3].T
        @ from_c2w[:, :3]
        @ np.linalg.inv(K_from)
        @ shift
    )


def textured(frame: np.ndarray) -> np.ndarray:
    """Where gray varies enough in a 9 x 9 window for flow to hold on to: (H, W) bool."""
    gray = (frame @ LUMA).astype(np.float32)
    variance = cv2.blur(gray * gray, (9, 9)) - cv2.blur(gray, (9, 9)) ** 2
    return np.sqrt(np.maximum(variance, 0)) > TEXTURED


def parts(differs: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """The connected patches of `differs` of which at least `PART` is `moving`: (H, W)
    bool.
    """
    _, label = cv2.connectedComponents(differs.astype(np.uint8))
    share = np.bincount(label.ravel(), moving.ravel()) / np.maximum(np.bincount(label.ravel()), 1)
    share[0] = 0
    return (share >= PART)[label]


def cleaned(mask: np.ndarray) -> np.ndarray:
    """Without specks (under a thousandth of the frame) and holes."""
    closed = cv2.morphologyEx(
        mask.astype(np.uint8), cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    )
    closed = ndimage.binary_fill_holes(closed).astype(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(closed)
    large = stats[:, cv2.CC_STAT_AREA] >= 0.001 * mask.size
    large[0] = False
    return large[label]
