"""Moving masks, corrected by difference from the background.

Flow finds no motion inside large dark clothes, or where somebody is next to the lens
and crosses the picture within a few frames; around outlines and in clipped sky it finds
motion where there is none. A camera without parallax shows the background behind movers
at other times: the median of what frames of the same exposure recorded there. A region
that differs from it joins the mask where flow has marked part of it, there or in the
frames before, so clouds and leaves stay static. Before a camera that stands still, what
differs much and is solid joins without a mark: a hand that enters within a frame.
Marked pixels without a trace of difference around them leave the mask.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.priors.masks.regions import marked_regions, regions_with_disc, without_specks

SIGMA_PER_MAD = 1.48  # standard deviation of a Gaussian per median absolute deviation


@dataclass(frozen=True)
class BackgroundTuning:
    """Tuning constants of the background, hand-chosen on real clips with people.

    Pixels (px) are those of the working grid.
    """

    working_pixels: int = 100_000
    """Frames with more pixels are compared on a coarser grid."""
    samples: int = 16
    """Other frames, at most, that a frame is compared to, spread over the clip."""
    min_samples: int = 4
    """Of them, those that must show the background at a pixel."""
    blur_px: float = 0.8
    """Standard deviation of the blur of all frames."""
    min_difference: float = 0.06
    """Of recorded values in [0, 1]; below, a pixel equals the background."""
    deviations: float = 5.0
    """Standard deviations of the background's own changes that it must also exceed."""
    min_marked_share: float = 0.2
    """Share of a region that flow must have marked."""
    solid_difference: float = 0.1
    """Of recorded values in [0, 1]: a pixel differs much beyond this and twice the
    `deviations`."""
    solid_share: float = 0.5
    """Share of a region that must differ much to join without a mark, ..."""
    solid_radius_share: float = 0.03
    """... and radius of a disc in it that does, of the picture's height."""
    min_trace: float = 0.02
    """Of recorded values in [0, 1]; below, nothing hints at a mover."""
    trace_deviations: float = 3.0
    """Standard deviations of the background's own changes that a hint exceeds."""
    trace_reach_share: float = 0.03
    """Distance of marked pixels from the nearest hint, of the picture's height."""
    max_share: float = 0.6
    """Of a frame that differs by more, nothing is taken: its exposure differs."""
    margin_px: int = 2
    """Pixels this near a mask show no background."""
    opening_px: int = 3
    """Side of the smallest region."""
    closing_px: int = 5
    """Side of the largest gap that is closed."""


def correct_by_background(
    moving: np.ndarray,
    video: ArrayStack,
    groups: np.ndarray,
    sources: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    tuning: BackgroundTuning = BackgroundTuning(),
) -> np.ndarray:
    """The moving masks (T, H, W) bool of one camera, with regions that differ from the
    background and without those that equal it.

    `video` (T, H, W, 3) is rgb in [0, 1]; frames of one of the `groups` (T,) were
    recorded alike. `sources` (T,) bool: frames that may show others their background;
    the others see all frames. `K` (T, 3, 3) px and `c2w` (T, 3, 4) are of cameras
    without parallax in each group.
    """
    count, height, width = moving.shape
    size = working_size((height, width), tuning.working_pixels)
    shrink = np.array([size[0] / width, size[1] / height, 1])[:, None]
    K = np.broadcast_to(K, (count, 3, 3)) * shrink
    frames = [resize(np.asarray(frame), size, tuning.blur_px) for frame in video]
    masks = [resize(mask.astype(np.float32), size) > 0.5 for mask in moving]
    margin = np.ones((2 * tuning.margin_px + 1,) * 2, np.uint8)
    hidden = [cv2.dilate(mask.astype(np.uint8), margin) for mask in masks]

    differences: dict[int, Difference] = {}
    for t in track(range(count), "background"):
        alike = (groups == groups[t]) & (sources | ~sources[t])
        others = overlapping(t, np.flatnonzero(alike), K, c2w, size)
        chosen = spread(others, tuning.samples)
        samples = [
            align(frames[j], hidden[j], pixel_homography(K, c2w, t, j), size) for j in chosen
        ]
        if len(samples) < tuning.min_samples:
            continue
        difference = compare(frames[t], np.stack(samples), tuning)
        if difference.certain.mean() <= tuning.max_share:
            differences[t] = difference

    marked = list(masks)
    if np.allclose(c2w, c2w[0]):
        for t, difference in differences.items():
            marked[t] = masks[t] | difference.solid
    grown = grow_masks(marked, differences, sources, tuning.min_marked_share)
    reach = max(1, round(tuning.trace_reach_share * size[1]))
    corrected = moving.copy()
    for t, difference in differences.items():
        equal = masks[t] & ~near(difference.possible, reach)
        equal &= ~ndimage.binary_fill_holes(grown[t] & ~equal)
        corrected[t] |= enlarge(grown[t] & ~masks[t], (width, height))
        corrected[t] &= ~enlarge(equal, (width, height))
    return corrected


def grow_masks(
    masks: list[np.ndarray],
    differences: dict[int, Difference],
    sources: np.ndarray,
    min_share: float,
) -> list[np.ndarray]:
    """The masks (H, W) with all regions that differ certainly and of which `min_share`
    are marked, here or in the frame before or after.

    What is found spreads from frame to frame, to frames that are no `sources` last.
    """
    grown = list(masks)

    def grow(t: int, neighbor: int) -> None:
        if t in differences:
            marked = grown[t] | grown[neighbor]
            grown[t] = grown[t] | marked_regions(differences[t].certain, marked, min_share)

    ordered = np.flatnonzero(sources).tolist()
    for order in (ordered, ordered[::-1]):
        for neighbor, t in zip([*order[:1], *order], order, strict=False):
            grow(t, neighbor)
    for t in np.flatnonzero(~sources).tolist():
        for neighbor in (max(t - 1, 0), min(t + 1, len(masks) - 1)):
            grow(t, neighbor)
    return grown


def working_size(shape: tuple[int, int], max_pixels: int) -> tuple[int, int]:
    """The size (width, height) of frames of `shape` (height, width), made coarser by
    the whole number that leaves at most about `max_pixels`.
    """
    height, width = shape
    coarseness = int(np.ceil(np.sqrt(height * width / max_pixels)))
    return -(-width // coarseness), -(-height // coarseness)


def resize(image: np.ndarray, size: tuple[int, int], blur_px: float = 0.0) -> np.ndarray:
    """An image at `size` (width, height), float32, blurred there."""
    if image.shape[1::-1] != size:
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if not blur_px:
        return image
    return cv2.GaussianBlur(image, (0, 0), blur_px)


def pixel_homography(K: np.ndarray, c2w: np.ndarray, t: int, j: int) -> np.ndarray:
    """From pixels of frame `t` to those of frame `j`, (3, 3), centers at +0.5."""
    turn = c2w[j, :, :3].T @ c2w[t, :, :3]
    return K[j] @ turn @ np.linalg.inv(K[t])


def overlapping(
    t: int, others: np.ndarray, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int]
) -> list[int]:
    """Those of the `others` that see the center of frame `t`."""
    center = np.array([size[0] / 2, size[1] / 2, 1.0])
    seen = []
    for j in others:
        x, y, z = pixel_homography(K, c2w, t, j) @ center
        if j != t and z > 0 and 0 <= x / z <= size[0] and 0 <= y / z <= size[1]:
            seen.append(int(j))
    return seen


def spread(items: list[int], count: int) -> list[int]:
    """At most `count` of the items, evenly spread."""
    if len(items) <= count:
        return items
    return [items[k] for k in np.linspace(0, len(items) - 1, count).round().astype(int)]


def align(
    frame: np.ndarray, hidden: np.ndarray, homography: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Another frame's background (H, W, C) as seen from here; NaN where it is `hidden`
    (H, W) or outside. `homography` leads from here to there, centers at +0.5.
    """
    to_center = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    matrix = np.linalg.inv(to_center) @ homography @ to_center  # OpenCV's centers are at 0
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(frame, matrix, size, flags=flags).reshape(*size[::-1], -1)
    covered = cv2.warpPerspective(
        hidden.astype(np.float32), matrix, size, flags=flags, borderValue=1
    )
    return np.where(covered[..., None] > 0, np.float32(np.nan), seen)


@dataclass(frozen=True)
class Difference:
    """Where a frame differs from the background, (H, W) bool."""

    certain: np.ndarray
    solid: np.ndarray  # regions of it that differ much
    possible: np.ndarray  # at least a hint, or the background is not known


def compare(frame: np.ndarray, samples: np.ndarray, tuning: BackgroundTuning) -> Difference:
    """A `frame` (H, W, 3) against what the `samples` (N, H, W, 3), NaN where unknown,
    show of the background.
    """
    count = np.isfinite(samples[..., 0]).sum(0)
    known = count >= tuning.min_samples
    background = known_median(samples, count)
    deviation = SIGMA_PER_MAD * known_median(np.abs(samples - background), count)
    difference = np.abs(frame - background)
    threshold = np.maximum(tuning.min_difference, tuning.deviations * deviation)
    differs = (difference > threshold).any(-1) & known
    hint = np.maximum(tuning.min_trace, tuning.trace_deviations * deviation)
    certain = without_specks(differs, tuning.opening_px, tuning.closing_px)
    much = np.maximum(tuning.solid_difference, 2 * tuning.deviations * deviation)
    differs_much = (difference > much).any(-1) & known
    solid = marked_regions(certain, differs_much, tuning.solid_share)
    solid &= regions_with_disc(certain, differs_much, tuning.solid_radius_share * len(frame))
    return Difference(certain, solid, (difference > hint).any(-1) | ~known)


def known_median(samples: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The (lower) median (H, W, 3) of `count` (H, W) known samples (N, H, W, 3)."""
    middle = np.maximum((count - 1) // 2, 0)[None, ..., None]
    index = np.broadcast_to(middle, (1, *samples.shape[1:]))
    return np.take_along_axis(np.sort(samples, 0), index, 0)[0]


def near(pixels: np.ndarray, reach: int) -> np.ndarray:
    """The pixels (H, W) within `reach` px of one of `pixels` (H, W)."""
    return cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, 3) <= reach


def enlarge(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask of the working grid at `size` (width, height)."""
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
