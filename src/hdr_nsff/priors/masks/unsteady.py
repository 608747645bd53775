"""Moving masks before a camera that stands still: what never shows the same again.

Somebody who sits and talks moves by less than flow can tell from one frame to the next,
and hides the background at all times, so neither flow nor the background finds him. But
what is recorded there is different at all times: the typical deviation from the median
over the clip is large, while it is small where a passer-by hid the background for a
moment. A region of this kind that flow marks now and then moves at all times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.stack import ArrayStack, spread_frames
from hdr_nsff.priors.masks.background import SIGMA_PER_MAD, enlarge, resize, working_size
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


def mark_unsteady(
    moving: np.ndarray,
    video: ArrayStack,
    groups: np.ndarray,
    sources: np.ndarray,
    tuning: UnsteadyTuning = UnsteadyTuning(),
) -> np.ndarray:
    """The moving masks (T, H, W) bool of a camera that stands still, with what is
    unsteady marked at all times.

    `video` (T, H, W, 3) is rgb in [0, 1]; frames of one of the `groups` (T,) were
    recorded alike. `sources` (T,) bool: frames that may decide about others; the others
    are decided about by all.
    """
    height, width = moving.shape[1:]
    marked = moving.copy()
    for decided, deciding in ((sources, sources), (~sources, np.ones_like(sources))):
        if decided.any():
            unsteady = unsteady_regions(moving, video, groups, np.flatnonzero(deciding), tuning)
            marked[decided] |= enlarge(unsteady, (width, height))
    return marked


def unsteady_regions(
    moving: np.ndarray,
    video: ArrayStack,
    groups: np.ndarray,
    frames: np.ndarray,
    tuning: UnsteadyTuning = UnsteadyTuning(),
) -> np.ndarray:
    """Where the `frames` (F,) are unsteady, (h, w) bool on the working grid."""
    size = working_size(moving.shape[1:], tuning.working_pixels)
    unsteady = np.zeros(size[::-1], bool)
    for group in np.unique(groups[frames]):
        alike = frames[groups[frames] == group]
        if len(alike) < tuning.min_frames:
            continue
        chosen = alike[spread_frames(len(alike), tuning.max_frames)]
        shown = np.stack([resize(np.asarray(video[t]), size, tuning.blur_px) for t in chosen])
        deviation = typical_deviation(shown)
        noise = float(np.median(deviation))
        unsteady |= deviation > max(tuning.min_deviation, tuning.min_noise_ratio * noise)
    unsteady = without_specks(unsteady, tuning.opening_px, tuning.closing_px)
    share = resize(moving[frames].mean(0, dtype=np.float32), size)
    regions = marked_regions(unsteady, share, tuning.min_marked)
    return regions & regions_with_disc(regions, regions, tuning.radius_share * size[1])


def typical_deviation(frames: np.ndarray) -> np.ndarray:
    """The standard deviation (H, W) over time of `frames` (F, H, W, 3), from the median
    deviation of the channel that changes most.
    """
    center = np.median(frames, 0)
    return SIGMA_PER_MAD * np.median(np.abs(frames - center), 0).max(-1)
