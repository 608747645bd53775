"""Optical flow across exposures by OpenCV's dense inverse search, and its validity.

A flow prior is a function `(video, clipped, pairs) -> (flow, valid)`; `dense_flow` is
the one that needs no weights (Kroeger et al., "Fast Optical Flow using Dense Inverse
Search", ECCV 2016). Assumption: `video` is exposure-equalized, so the two frames of a
pair differ only where one of them is clipped; both are limited to their common range.

Flow is in pixels: `flow[row, column]` is the position in the other frame minus the
position in this one, x then y. A valid pixel agrees forward and backward within
`geometry.round_trip.max_round_trip`, ends inside the other frame, and is clipped at
neither end of its motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from hdr_nsff.core.parallel import map_in_threads
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.geometry.round_trip import follow, max_round_trip, valid_flow
from hdr_nsff.radiometry.common_range import common_gray, recorded_range


@dataclass(frozen=True)
class DenseFlowTuning:
    """Tuning constants of the dense inverse search.

    Hand-chosen on rendered scenes with exact flow; `patch_px`, `stride_px` and
    `smoothness` are those of OpenCV's MEDIUM preset.
    """

    doubled_below_pixels: int = 100_000
    """Frames with fewer pixels are matched at twice their size. That lowers the median
    error on moving objects by a quarter; larger frames only gain noise.
    """
    blur_px: float = 0.6
    """Standard deviation of the blur before the search: dark exposures are noisy."""
    patch_px: int = 8
    """Side of a patch."""
    stride_px: int = 3
    """Distance between patches."""
    doubled_patch_px: int = 12
    """Side of a patch in doubled frames, without initial flow."""
    doubled_stride_px: int = 4
    """Distance between patches in doubled frames, without initial flow."""
    refinement_iterations: int = 10
    """Variational refinement steps per level; the preset has 5."""
    smoothness: float = 20.0
    """Weight of the smoothness term (alpha), times two in doubled frames."""
    coarsest_level_with_initial: int = 1
    """Pyramid level at which a search from initial flow starts; 1 is half the size."""


DENSE_FLOW_TUNING = DenseFlowTuning()


class FlowPrior(Protocol):
    """A source of optical flow between frames of a clip."""

    def __call__(
        self, video: ArrayStack, clipped: ArrayStack, pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow (P, H, W, 2) float32 px and valid (P, H, W) bool of `pairs` (P, 2).

        A pair holds two frames (from, to). `video` (T, H, W, 3) is exposure-equalized
        rgb in [0, 1], `clipped` (T, H, W) bool marks pixels without information.
        """
        ...


def dense_flow(
    video: ArrayStack,
    clipped: ArrayStack,
    pairs: np.ndarray,
    tuning: DenseFlowTuning = DENSE_FLOW_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """`FlowPrior` by dense inverse search.

    The result depends neither on the order of the pairs nor on the number of cores.
    """
    ranges = recorded_ranges(video, clipped, pairs)

    def match(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        a, b = common_gray(video, ranges, i, j)
        forward = dense_inverse_search(a, b, tuning=tuning)
        backward = dense_inverse_search(b, a, tuning=tuning)
        return forward, backward

    return match_pairs(match, clipped, pairs)


def recorded_ranges(
    video: ArrayStack, clipped: ArrayStack, pairs: np.ndarray
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """The lowest and highest rgb (3,), (3,) that each frame of `pairs` recorded.

    `video`, `clipped` and `pairs` are those of `FlowPrior`.
    """
    frames = np.unique(np.asarray(pairs, np.int64))
    return {int(k): recorded_range(video[k], clipped[k]) for k in frames}


def match_pairs(
    match: Callable[[int, int], tuple[np.ndarray, np.ndarray]],
    clipped: ArrayStack,
    pairs: np.ndarray,
    report: str | None = None,
    threads: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) float32 px and valid (P, H, W) bool of `pairs` (P, 2).

    Each pair of frames is matched once for both directions: `match(i, j)` with i < j
    returns the flow (H, W, 2) from frame i to j and that from j to i. `clipped` is (T,
    H, W) bool. Progress is shown under the name `report`.
    """
    pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
    assert pairs.size == 0 or (pairs.min() >= 0 and pairs.max() < len(clipped)), (
        f"pairs reach beyond {len(clipped)} frames"
    )
    unordered = sorted({(int(min(p)), int(max(p))) for p in pairs})
    matches = map_in_threads(lambda pair: match(*pair), unordered, report, threads)
    flows: dict[tuple[int, int], np.ndarray] = {}
    for (i, j), (forward, backward) in zip(unordered, matches, strict=True):
        flows[i, j] = forward
        flows[j, i] = backward

    size = clipped.shape[1:]
    flow = np.empty((len(pairs), *size, 2), np.float32)
    valid = np.empty((len(pairs), *size), bool)
    for p, (i, j) in enumerate(pairs.tolist()):
        flow[p] = flows[i, j]
        valid[p] = valid_flow(flows[i, j], flows[j, i], clipped[i], clipped[j])
    return flow, valid


def dense_inverse_search(
    a: np.ndarray,
    b: np.ndarray,
    initial: np.ndarray | None = None,
    tuning: DenseFlowTuning = DENSE_FLOW_TUNING,
) -> np.ndarray:
    """Flow (H, W, 2) px from `a` to `b`, gray uint8 (H, W).

    With `initial` flow (H, W, 2) px the search starts there and at half the size, so it
    only corrects flow that is nearly right.
    """
    height, width = a.shape
    scale = 2 if height * width < tuning.doubled_below_pixels else 1
    a = prepare_image(a, scale, tuning.blur_px)
    b = prepare_image(b, scale, tuning.blur_px)

    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    search.setVariationalRefinementIterations(tuning.refinement_iterations)
    search.setVariationalRefinementAlpha(tuning.smoothness * scale)
    if scale == 1 or initial is not None:
        search.setPatchSize(tuning.patch_px)
        search.setPatchStride(tuning.stride_px)
    else:
        search.setPatchSize(tuning.doubled_patch_px)
        search.setPatchStride(tuning.doubled_stride_px)

    start = np.zeros((*a.shape, 2), np.float32)
    if initial is not None:
        search.setCoarsestScale(tuning.coarsest_level_with_initial)
        resized = cv2.resize(initial, a.shape[::-1], interpolation=cv2.INTER_LINEAR)
        start = resized * np.float32(scale)
    flow = np.asarray(search.calc(a, b, start))
    return cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA) / np.float32(scale)


def prepare_image(gray: np.ndarray, scale: int, blur_px: float) -> np.ndarray:
    """A gray uint8 image (H, W), blurred, then `scale` times as large."""
    blurred = cv2.GaussianBlur(gray, (0, 0), blur_px)
    if scale == 1:
        return blurred
    height, width = gray.shape
    return cv2.resize(blurred, (width * scale, height * scale), interpolation=cv2.INTER_CUBIC)


def average_with_reverse(forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """The mean (H, W, 2) px of `forward` and of the reverse of `backward`.

    Each direction has errors of its own. Where the two disagree, `forward` (H, W, 2)
    stays as it is.
    """
    gap = forward + follow(backward, forward)
    agrees = np.linalg.norm(gap, axis=-1) < max_round_trip(forward)
    return forward - 0.5 * gap * agrees[..., None]
