"""Moving masks of a camera without parallax: what never shows the same again.

Somebody who sits and talks moves by less than flow can tell from one frame to the next,
and hides the background at all times, so neither flow nor the background finds him. But
what is recorded there is different at all times: the typical deviation from the median
over the clip is large, while it is small where a passer-by hid the background for a
moment. A region of this kind that flow marks now and then moves at all times.
Frames of a camera that turns a little are compared as its middle frame sees them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.stack import ArrayStack, spread_frames
from hdr_nsff.priors.masks.background import (
    SIGMA_PER_MAD,
    align,
    enlarge,
    pixel_homography,
    resize,
    working_size,
)
from hdr_nsff.priors.masks.regions import marked_regions, regions_with_disc, without_specks


@dataclass(frozen=True)
class UnsteadyTuning:
    """Tuning constants of unsteady regions, hand-chosen on real clips with people.

    Pixels (px) are those of the working grid.
    """

    working_pixels: int = 100_000
    """Frames with more pixels are compared on a coarser grid."""
    blur_px: float = 0.8
    """Standard deviation of the blur of all frames."""
    max_frames: int = 48
    """Frames of one exposure that are compared, spread over the clip."""
    min_frames: int = 6
    """Fewer of one exposure show nothing."""
    min_deviation: float = 0.03
    """Over time, of recorded values in [0, 1]: smaller ones are steady."""
    min_noise_ratio: float = 4.0
    """Deviation relative to that of most pixels, which is the noise."""
    min_marked: float = 0.1
    """Share of a region that flow marks, in the mean over time."""
    radius_share: float = 0.03
    """Radius of a disc in a region, of the picture's height."""
    opening_px: int = 3
    """Side of the smallest region."""
    closing_px: int = 5
    """Side of the largest gap that is closed."""
    alignment_px: float = 0.5
    """Error of the frames of a camera that turns, which moves edges by as much."""
    max_turn_share: float = 0.05
    """Of the picture's width, by which a turn may move a corner: beyond, frames are not
    aligned well enough. (A man in a car: 0.006; four pans past traffic, where static
    signs and plants would be marked: 0.1 to 0.17.)
    """


@dataclass(frozen=True)
class Views:
    """How frames of one camera are seen from its middle frame, on a working grid."""

    size: tuple[int, int]  # width, height of the grid
    homographies: np.ndarray | None  # (T, 3, 3) from there; None: the camera stands still

    def turn_share(self) -> float:
        """The farthest that a corner moves from the middle frame, of the width."""
        if self.homographies is None:
            return 0.0
        width, height = self.size
        corners = np.array([[x, y, 1.0] for x in (0, width) for y in (0, height)])
        seen = corners @ self.homographies.transpose(0, 2, 1)
        moved = seen[..., :2] / seen[..., 2:] - corners[:, :2]
        return float(np.linalg.norm(moved, axis=-1).max()) / width

    def from_middle(self, image: np.ndarray, t: int) -> np.ndarray:
        """An image (h, w, C) of frame `t`, seen from the middle frame; NaN outside."""
        if self.homographies is None:
            return image
        return align(image, np.zeros(image.shape[:2], np.uint8), self.homographies[t], self.size)

    def from_frame(self, region: np.ndarray, t: int) -> np.ndarray:
        """A region (h, w) bool of the middle frame as seen from frame `t`."""
        if self.homographies is None:
            return region
        image, inside = region[..., None].astype(np.float32), np.zeros(region.shape, np.uint8)
        seen = align(image, inside, np.linalg.inv(self.homographies[t]), self.size)
        return np.asarray(seen[..., 0] > 0.5)


def mark_unsteady(
    moving: np.ndarray,
    video: ArrayStack,
    groups: np.ndarray,
    sources: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    tuning: UnsteadyTuning = UnsteadyTuning(),
) -> np.ndarray:
    """The moving masks (T, H, W) bool of one camera without parallax, with what is
    unsteady marked at all times.

    `video` (T, H, W, 3) is rgb in [0, 1]; frames of one of the `groups` (T,) were
    recorded alike. `sources` (T,) bool: frames that may decide about others; the others
    are decided about by all. `K` (T, 3, 3) px; `c2w` (T, 3, 4).
    """
    height, width = moving.shape[1:]
    views = views_of(working_size((height, width), tuning.working_pixels), (width, height), K, c2w)
    if views.turn_share() > tuning.max_turn_share:
        return moving
    marked = moving.copy()
    for decided, deciding in ((sources, sources), (~sources, np.ones_like(sources))):
        if not decided.any():
            continue
        frames = np.flatnonzero(deciding)
        unsteady = unsteady_regions(moving, video, groups, frames, views, tuning)
        for t in np.flatnonzero(decided).tolist():
            marked[t] |= enlarge(views.from_frame(unsteady, t), (width, height))
    return marked


def views_of(
    size: tuple[int, int], frame_size: tuple[int, int], K: np.ndarray, c2w: np.ndarray
) -> Views:
    """The views on a grid of `size`, for frames of `frame_size` (width, height)."""
    if np.allclose(c2w, c2w[0]):
        return Views(size, None)
    count = len(c2w)
    shrink = np.array([size[0] / frame_size[0], size[1] / frame_size[1], 1])[:, None]
    K = np.broadcast_to(K, (count, 3, 3)) * shrink
    return Views(size, np.stack([pixel_homography(K, c2w, count // 2, t) for t in range(count)]))


def unsteady_regions(
    moving: np.ndarray,
    video: ArrayStack,
    groups: np.ndarray,
    frames: np.ndarray,
    views: Views,
    tuning: UnsteadyTuning = UnsteadyTuning(),
) -> np.ndarray:
    """Where `frames` (F,) are unsteady, (h, w) bool as seen from the middle frame."""
    size, turns = views.size, views.homographies is not None
    unsteady = np.zeros(size[::-1], bool)
    for group in np.unique(groups[frames]):
        alike = frames[groups[frames] == group]
        if len(alike) < tuning.min_frames:
            continue
        chosen = alike[spread_frames(len(alike), tuning.max_frames)]
        shown = [resize(np.asarray(video[t]), size, tuning.blur_px) for t in chosen]
        shown = [views.from_middle(image, t) for image, t in zip(shown, chosen, strict=True)]
        alignment = tuning.alignment_px if turns else 0.0
        deviation, seen = typical_deviation(np.stack(shown), alignment)
        if seen.any():
            noise = float(np.median(deviation[seen]))
            unsteady |= deviation > max(tuning.min_deviation, tuning.min_noise_ratio * noise)
    unsteady = without_specks(unsteady, tuning.opening_px, tuning.closing_px)
    share = np.zeros(size[::-1], np.float32)
    for t in frames:
        mask = resize(moving[t].astype(np.float32), size)
        share += np.nan_to_num(views.from_middle(mask[..., None], t)[..., 0]) / len(frames)
    regions = marked_regions(unsteady, share, tuning.min_marked)
    return regions & regions_with_disc(regions, regions, tuning.radius_share * size[1])


def typical_deviation(
    frames: np.ndarray, alignment_px: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The standard deviation (H, W) over time of `frames` (F, H, W, 3), NaN outside,
    from the median deviation of the channel that changes most, beyond what edges change
    that are moved by `alignment_px`; and where (H, W) bool all frames see a pixel.
    Elsewhere the deviation is 0.
    """
    seen = np.isfinite(frames[..., 0]).all(0)
    frames = np.where(seen[..., None], frames, 0)
    center = np.median(frames, 0)
    deviation = SIGMA_PER_MAD * np.median(np.abs(frames - center), 0)
    slope = np.hypot(*np.gradient(center, axis=(0, 1)))
    return np.maximum(deviation - alignment_px * slope, 0).max(-1), seen
