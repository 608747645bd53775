"""Optical flow between frames of different exposure: where each pixel of one frame goes
in another, and where that can be believed.

A flow prior is a function `(video, clipped, pairs) -> (flow, valid)`; `flow` runs the
offline default (OpenCV's dense inverse search) and `read_flow` reads a folder made by
any other tool. Flow is in pixels, `flow[row, column]` = where the pixel goes in the
other frame minus where it is. Valid means: forward and backward flow agree to sub-pixel
strictness, the target lies inside the other frame, and neither end is clipped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import cv2
import numpy as np

from hdr_nsff.core.parallel import in_threads
from hdr_nsff.geometry.round_trip import agreement, allowed, follow, round_trip
from hdr_nsff.priors.flow.local_motion import filled
from hdr_nsff.radiometry.common_range import common_gray, recorded_range

SMALL = 100_000  # frames of fewer pixels are matched at twice their size
# pixels: a round trip that misses by so much is trusted exp(-1/2); one that misses by
# more, or is clipped, is told by what is around
MISSED = 0.1
# squared grays per pixel: the smaller eigenvalue of the structure tensor at which a
# pixel is trusted by half
PLAIN = 64.0
BLIND = 0.1  # trust in a clipped pixel, relative to others: patches around it may show something


class FlowPrior(Protocol):
    """What `prepare` calls, whatever is behind it."""

    def __call__(
        self, video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Exposure-equalized rgb `video` (T, H, W, 3) in [0, 1], `clipped` (T, H, W)
        bool, `pairs` (P, 2) of frames (from, to) -> flow (P, H, W, 2) float32 px, valid
        (P, H, W) bool.
        """
        ...


def flow(
    video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray, report: str | None = "optical flow"
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) float32 px and valid (P, H, W) bool of `pairs` (P, 2) by dense
    inverse search, checked against the reverse.

    `video` (T, H, W, 3) is exposure-equalized rgb in [0, 1], `clipped` (T, H, W) bool
    marks pixels without information. The answer does not depend on the order of the
    pairs or on the number of cores. `report` None shows no progress.
    """
    ranges = {
        int(k): recorded_range(video[k], clipped[k]) for k in np.unique(np.asarray(pairs, np.int64))
    }

    def both_ways(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        a, b = common_gray(video, ranges, i, j)
        return dense_inverse_search(a, b), dense_inverse_search(b, a)

    return checked(both_ways, clipped, pairs, report)


def checked(
    both_ways: Callable[[int, int], tuple[np.ndarray, np.ndarray]],
    clipped: np.ndarray,
    pairs: np.ndarray,
    report: str | None,
    threads: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) float32 px and valid (P, H, W) bool of `pairs` (P, 2), each
    matched once in both directions.

    `both_ways(i, j)` with i < j gives the flow (H, W, 2) from frame i to j and that
    from j to i; `clipped` (T, H, W) bool.
    """
    pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
    assert pairs.size == 0 or (pairs.min() >= 0 and pairs.max() < len(clipped)), (
        f"pairs reach beyond {len(clipped)} frames"
    )
    wanted = sorted({(int(min(p)), int(max(p))) for p in pairs})
    found = {}
    for (i, j), (there, back) in zip(
        wanted, in_threads(lambda p: both_ways(*p), wanted, report, threads), strict=True
    ):
        found[i, j], found[j, i] = there, back
    forward = [found[int(i), int(j)] for i, j in pairs]
    valid = [
        agreement(found[int(i), int(j)], found[int(j), int(i)], clipped[i], clipped[j])
        for i, j in pairs
    ]
    size = clipped.shape[1:]
    return np.array(forward, np.float32).reshape(-1, *size, 2), np.array(valid, bool).reshape(
        -1, *size
    )


def dense_inverse_search(
    a: np.ndarray, b: np.ndarray, initial: np.ndarray | None = None
) -> np.ndarray:
    """Flow (H, W, 2) px between gray uint8 (H, W) images, by OpenCV's DIS with a long
    variational refinement.

    With `initial` flow (H, W, 2) the search starts from it and at half the size, so it
    only mends what is nearly right. Small frames are doubled first: measured on moving
    objects, the median error falls by a quarter; larger ones only gain noise.
    """
    h, w = a.shape
    scale = 2 if h * w < SMALL else 1
    a, b = (cv2.GaussianBlur(x, (0, 0), 0.6) for x in (a, b))  # the dark exposures are noisy
    if scale == 2:
        a, b = (cv2.resize(x, (w * 2, h * 2), interpolation=cv2.INTER_CUBIC) for x in (a, b))
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    small = scale == 1 or initial is not None
    search.setPatchSize(8 if small else 12)
    search.setPatchStride(3 if small else 4)
    search.setVariationalRefinementIterations(10)
    search.setVariationalRefinementAlpha(20.0 * scale)
    start = np.zeros((*a.shape, 2), np.float32)
    if initial is not None:
        search.setCoarsestScale(1)
        start = cv2.resize(initial, a.shape[::-1], interpolation=cv2.INTER_LINEAR) * np.float32(
            scale
        )
    found = np.asarray(search.calc(a, b, start))
    return cv2.resize(found, (w, h), interpolation=cv2.INTER_AREA) / np.float32(scale)


def told(
    flow: np.ndarray,
    reverse: np.ndarray,
    here: np.ndarray,
    there: np.ndarray,
    clipped_here: np.ndarray,
    clipped_there: np.ndarray,
    moving: np.ndarray,
) -> np.ndarray:
    """`flow` (H, W, 2) px between gray uint8 pictures (H, W), where it is not sure told
    by the trusted pixels around that move alike.

    What stands still tells nothing of what is `moving` (H, W) bool. Masks miss some of
    that, so the rest is told by all; of what is clipped they know nothing. Trusted is
    what agrees with its `reverse`, shows something in both pictures, and is clipped at
    neither end.
    """
    blind = clipped_here | (follow(clipped_there.astype(np.float32), flow, fill=1.0) > 0.01)
    missed = round_trip(flow, reverse)
    shown = np.minimum(detail(here), follow(detail(there), flow))
    trust = (
        np.exp(-0.5 * (missed / MISSED) ** 2) * np.where(blind, BLIND, 1) * shown / (shown + PLAIN)
    )
    side = np.where(blind, 0, np.where(moving, 1, -1))
    return filled(flow, trust, blind | (missed > MISSED), side)


def halfway(forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """`forward` (H, W, 2) px, and where it agrees with `backward` the mean of both:
    each is off by errors of its own.
    """
    missed = forward + follow(backward, forward)
    near = np.linalg.norm(missed, axis=-1) < allowed(forward)
    return forward - 0.5 * missed * near[..., None]


def detail(gray: np.ndarray) -> np.ndarray:
    """The smaller eigenvalue (H, W) of the structure tensor over 5x5 pixels, in squared
    grays per pixel (Shi & Tomasi 1994).
    """
    return cv2.cornerMinEigenVal(cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 0.6), 5) / 4
