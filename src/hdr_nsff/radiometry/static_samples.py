"""Static points with what every exposure recorded of them, found through disparity and
poses: the input of `debevec.py`.

Points lie where nothing moves and the surface is flat, so that a pixel of misplacement
costs little. They are spread over the recorded levels. A value is the mean
of 3x3 pixels, and it counts only where all nine are away from black and saturation: a
mean over clipped pixels is no recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import LazyList
from hdr_nsff.geometry import pinhole
from hdr_nsff.radiometry.log_curve import HIGH, LOW, SATURATED
from hdr_nsff.radiometry.samples import Samples, empty_samples, joined

# frames whose patches are in memory at a time: those around one in time, both ways
KEPT_PATCHES = 56


@dataclass(frozen=True)
class StaticSamplesTuning:
    """Which pixels are trusted to be found again in other frames (hand-chosen on
    rendered scenes).
    """

    mover_margin_px: int = 3  # pixels this close to a moving one are left out
    min_confidence: float = 0.1  # of the disparity
    # a patch is flat if its values differ by less than the sum of these two
    max_contrast: float = 0.03  # of a recorded value
    max_relative_contrast: float = 0.12  # share of the patch's highest value
    max_disparity_error: float = 0.08  # share, between a point and the map of another frame
    max_cycles_apart: int = 3  # a point is read in frames at most this many cycles away
    level_bins: int = 16  # of the gray levels that points are spread over


@dataclass(frozen=True)
class ResponseView:
    """One recorded frame, and what finds its static points in other frames."""

    image: np.ndarray  # (H, W, 3) recorded, in [0, 1]
    bracket: int
    time: float  # in frames
    K: np.ndarray  # (3, 3) pixels
    c2w: np.ndarray  # (3, 4) OpenCV, scene units
    disparity: np.ndarray  # (H, W) 1 / z-depth, scene units
    confidence: np.ndarray | None = None  # (H, W) in [0, 1]
    moving: np.ndarray | None = None  # (H, W) bool

    def in_bracket(self, bracket: int) -> ResponseView:
        """The same frame, counted as one of another bracket."""
        return replace(self, bracket=bracket)


@dataclass(frozen=True)
class PatchStatistics:
    """The 3x3 pixels around every pixel of a frame."""

    mean: np.ndarray  # (H, W, 3) recorded
    unclipped: np.ndarray  # (H, W, 3) bool: all nine away from black and saturation
    saturated: np.ndarray  # (H, W, 3) bool: all nine saturated
    good: np.ndarray  # (H, W) bool: flat, and known to be found again


def static_samples(
    views: Sequence[ResponseView],
    num_brackets: int,
    num: int,
    rng: np.random.Generator,
    tuning: StaticSamplesTuning = StaticSamplesTuning(),
) -> Samples:
    """Up to `num` static points with what every bracket recorded of them.

    A bracket is read in the frame nearest in time that sees the point: inside the
    frame, static, and with a disparity that agrees.
    """
    patches = LazyList(lambda k: view_patches(views[k], tuning), len(views), KEPT_PATCHES)
    points_per_view = max(1, num // max(len(views), 1))
    parts = [
        samples_of_view(source, views, patches, num_brackets, points_per_view, rng, tuning)
        for source in track(range(len(views)), "response: points")
    ]
    return joined(parts, num_brackets)


def samples_of_view(
    source: int,
    views: Sequence[ResponseView],
    patches: Sequence[PatchStatistics],
    num_brackets: int,
    num: int,
    rng: np.random.Generator,
    tuning: StaticSamplesTuning = StaticSamplesTuning(),
) -> Samples:
    """Up to `num` static points of view `source`, read in all brackets."""
    view = views[source]
    pixels = spread_over_levels(view.image, patches[source].good, num, rng, tuning)
    depth = 1 / np.maximum(view.disparity[pixels[:, 1], pixels[:, 0]], 1e-9)
    points = pinhole.unproject(pixels + 0.5, depth, view.K, view.c2w)
    samples = empty_samples(len(points), num_brackets, source)
    nearest_first = sorted(range(len(views)), key=lambda i: abs(views[i].time - view.time))
    for other in nearest_first:
        seen_by = views[other]
        too_late = abs(seen_by.time - view.time) > tuning.max_cycles_apart * num_brackets
        # the point's own bracket is read where the point was chosen
        same_bracket = other != source and seen_by.bracket == view.bracket
        if too_late or same_bracket:
            continue
        visible, rows, columns = visible_points(seen_by, patches[other], points, tuning)
        enter_readings(samples, seen_by.bracket, patches[other], visible, rows, columns)
    return samples


def enter_readings(
    samples: Samples,
    bracket: int,
    patches: PatchStatistics,
    visible: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
) -> None:
    """Enter what the `visible` (P,) points are at pixels `rows`, `columns` (P,) of a
    frame of `bracket`, in place. Points that have a reading of it keep theirs.
    """
    known = (samples.valid | samples.saturated)[:, bracket].any(-1)
    new = visible & ~known
    samples.rgb[new, bracket] = patches.mean[rows, columns][new]
    samples.valid[new, bracket] = patches.unclipped[rows, columns][new]
    samples.saturated[new, bracket] = patches.saturated[rows, columns][new]


def view_patches(
    view: ResponseView, tuning: StaticSamplesTuning = StaticSamplesTuning()
) -> PatchStatistics:
    """The patches of a view, good where its points can be found in other frames."""
    known = view.disparity > 0
    if view.moving is not None:
        side = 2 * tuning.mover_margin_px + 1
        near_movers = cv2.dilate(view.moving.astype(np.uint8), np.ones((side, side), np.uint8))
        known = known & (near_movers == 0)
    if view.confidence is not None:
        known = known & (view.confidence > tuning.min_confidence)
    return patch_statistics(view.image, known, tuning)


def patch_statistics(
    image: np.ndarray, known: np.ndarray, tuning: StaticSamplesTuning = StaticSamplesTuning()
) -> PatchStatistics:
    """The patches of a recorded `image` (H, W, 3); good ones are flat and `known`."""
    window = np.ones((3, 3), np.uint8)
    image = np.ascontiguousarray(image, np.float32)
    lowest, highest = np.asarray(cv2.erode(image, window)), np.asarray(cv2.dilate(image, window))
    max_difference = tuning.max_contrast + tuning.max_relative_contrast * highest
    is_smooth = ((highest - lowest) < max_difference).all(-1)
    return PatchStatistics(
        mean=np.asarray(cv2.blur(image, (3, 3))),
        unclipped=(lowest >= LOW) & (highest <= HIGH),
        saturated=lowest >= SATURATED,
        good=is_smooth & known,
    )


def spread_over_levels(
    image: np.ndarray,
    mask: np.ndarray,
    num: int,
    rng: np.random.Generator,
    tuning: StaticSamplesTuning = StaticSamplesTuning(),
) -> np.ndarray:
    """Up to `num` pixels (P, 2; column, row) of `mask` (H, W) bool, their gray levels
    spread as evenly as `image` (H, W, 3) allows.
    """
    rows, columns = np.nonzero(mask)
    gray = image[rows, columns].mean(-1)
    informative = (gray > LOW) & (gray < HIGH)
    rows, columns = rows[informative], columns[informative]
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    num_bins = tuning.level_bins
    bins = np.minimum((gray[informative] * num_bins).astype(int), num_bins - 1)
    weight = 1 / np.bincount(bins, minlength=num_bins)[bins]
    chance = weight / weight.sum()
    chosen = rng.choice(len(rows), min(num, len(rows)), replace=False, p=chance)
    return np.stack([columns[chosen], rows[chosen]], -1)


def visible_points(
    view: ResponseView,
    patches: PatchStatistics,
    points: np.ndarray,
    tuning: StaticSamplesTuning = StaticSamplesTuning(),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which world `points` (P, 3) a view sees undisturbed (P,) bool, and the pixel each
    falls into: row (P,), column (P,).
    """
    height, width = view.disparity.shape
    pixels, depth = pinhole.project(points, view.K, view.c2w)
    inside = (depth > 0) & (pixels > 1).all(-1) & (pixels < (width - 1, height - 1)).all(-1)
    columns, rows = np.where(inside[:, None], pixels, 1).astype(int).T
    disparity_error = np.abs(view.disparity[rows, columns] * depth - 1)
    unoccluded = disparity_error < tuning.max_disparity_error
    return inside & unoccluded & patches.good[rows, columns], rows, columns
