"""How exposure and white balance drift in a clip, from points of the scene that frames
of one exposure share: a pan into the dark is no drift.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from hdr_nsff.core.stack import spread_frames
from hdr_nsff.priors.poses.matching import Keypoints, match_pairs
from hdr_nsff.radiometry import exposure_cycle as exposure


@dataclass(frozen=True)
class DriftTuning:
    """Hand-chosen on the real clips that docs/shooting.md was tried on."""

    low: float = 0.012  # recorded values beyond these are black and white, as for cycles
    high: float = 0.97
    point_blur_px: float = 1.5  # values at keypoints are means over this radius
    min_points: int = 12  # of a pair of frames
    max_frames: int = 16  # compared with each other
    reweightings: int = 8
    least_error_ev: float = 0.02  # smaller errors of a pair count alike
    max_disagreement: float = 0.15  # of pairs, relative to the drift: else it is motion
    min_given_ev: float = 0.3  # range of given exposures that pixels can be held against
    max_ev_ratio: float = 2.0  # by which they may be off: a camera has no gamma of 2.2


@dataclass(frozen=True)
class Levels:
    """Levels of frames on which pairs of them agree, in EV under a gamma of 2.2."""

    frames: list[int]
    ev: np.ndarray  # (N,) of these frames, up to a constant
    disagreement: float  # median over pairs, EV


@dataclass(frozen=True)
class Drift:
    """Ranges over a clip, under a gamma of 2.2."""

    exposure_ev: float
    color_ev: float  # of red or blue against green
    levels: Levels | None = None  # of the exposure; None where no frames are linked


def measure_drift(
    video: np.ndarray,
    cycle: exposure.Cycle,
    keypoints: list[Keypoints],
    tuning: DriftTuning = DriftTuning(),
) -> Drift:
    """What matched points change between frames of one bracket of `video` (T, H, W, 3).

    Every pair of some frames says how far their exposures, and their colors, are apart.
    """
    reference = exposure.reference_bracket(video, cycle.brackets)
    own = np.flatnonzero(np.array(cycle.brackets) == reference)
    chosen = own[spread_frames(len(own), tuning.max_frames)]
    pairs = list(itertools.combinations(range(len(chosen)), 2))
    matches = match_pairs([keypoints[t] for t in chosen], pairs)
    blurred = [cv2.GaussianBlur(video[t], (0, 0), tuning.point_blur_px) for t in chosen.tolist()]
    exposures, colors = [], []
    known, known_colors = [], []
    for pair in matches:
        before, after = sample(blurred[pair.i], pair.p), sample(blurred[pair.j], pair.q)
        gray_before, gray_after = before.mean(1), after.mean(1)
        use = is_recorded(gray_before, gray_after, tuning)
        if use.sum() >= tuning.min_points:
            ratio = np.log2(gray_after[use] / gray_before[use])
            exposures.append(float(np.median(ratio)))
            known.append((pair.i, pair.j))
        use = is_recorded(before.min(1), after.min(1), tuning)
        use &= is_recorded(before.max(1), after.max(1), tuning)
        if use.sum() >= tuning.min_points:
            ratios = np.log2(after[use] / before[use])  # (M, 3)
            colors.append(np.median(ratios[:, [0, 2]] - ratios[:, 1:2], axis=0))
            known_colors.append((pair.i, pair.j))
    red_blue = np.array(colors).reshape(-1, 2)
    color_ranges = [range_over_frames(known_colors, red_blue[:, c], tuning) for c in (0, 1)]
    pairs = [(int(chosen[i]), int(chosen[j])) for i, j in known]
    levels = levels_of_frames(pairs, np.array(exposures), tuning)
    return Drift(range_of_levels(levels, tuning), max(color_ranges), levels)


def drift_contradictions(
    drift: Drift, given: list[float], tuning: DriftTuning = DriftTuning()
) -> list[str]:
    """What the levels of frames contradict in the `given` EV of all frames: a sentence,
    none where they agree, or show nothing.
    """
    levels = drift.levels
    if levels is None:
        return []
    listed = np.array(given)[levels.frames]
    span = float(np.ptp(listed))
    unsure = levels.disagreement > tuning.max_disagreement * span
    if span < tuning.min_given_ev or unsure:
        return []
    listed = listed - listed.mean()
    ratio = float(levels.ev @ listed / (listed @ listed))
    if 1 / tuning.max_ev_ratio < ratio < tuning.max_ev_ratio:
        return []
    return [
        f"a given drift of {span:.1f} EV changes points of the scene like {ratio * span:.1f} EV "
        "(measured with a gamma of 2.2)"
    ]


def is_recorded(before: np.ndarray, after: np.ndarray, tuning: DriftTuning) -> np.ndarray:
    """Where values (M,) of two frames are neither black nor white."""
    low, high = np.minimum(before, after), np.maximum(before, after)
    return (low > 4 * tuning.low) & (high < tuning.high)


def range_over_frames(
    pairs: list[tuple[int, int]], log2_ratios: np.ndarray, tuning: DriftTuning
) -> float:
    """The range in EV over frames of what `pairs` of these differ by (P,), in log2 of
    recorded values; 0 where the pairs contradict each other.
    """
    return range_of_levels(levels_of_frames(pairs, log2_ratios, tuning), tuning)


def range_of_levels(levels: Levels | None, tuning: DriftTuning) -> float:
    """The range in EV of levels; 0 where pairs contradict each other, or link none."""
    if levels is None:
        return 0.0
    drift = float(np.ptp(levels.ev))
    return drift if levels.disagreement < tuning.max_disagreement * drift else 0.0


def levels_of_frames(
    pairs: list[tuple[int, int]], log2_ratios: np.ndarray, tuning: DriftTuning
) -> Levels | None:
    """One level per frame from what `pairs` of frames differ by (P,), in log2 of
    recorded values; None where no pairs are known.

    Least squares, reweighted to least absolute errors.
    """
    linked = sorted({t for pair in pairs for t in pair})
    if len(linked) < 2:
        return None
    design = np.zeros((len(pairs), linked[-1] + 1))
    for row, (i, j) in enumerate(pairs):
        design[row, [i, j]] = -1, 1
    change = exposure.GAMMA * log2_ratios
    weights = np.ones(len(pairs))
    level: np.ndarray = np.zeros(design.shape[1])
    for _ in range(tuning.reweightings):
        level = np.linalg.lstsq(design * weights[:, None], change * weights, rcond=None)[0]
        error = np.abs(design @ level - change)
        weights = 1 / np.sqrt(np.maximum(error, tuning.least_error_ev))
    disagreement = float(np.median(np.abs(design @ level - change)))
    return Levels(linked, level[linked], disagreement)


def sample(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values (M, C) of an image (H, W, C) at points (M, 2), pixel centers at +0.5."""
    height, width = image.shape[:2]
    column = np.clip(points[:, 0].astype(int), 0, width - 1)
    row = np.clip(points[:, 1].astype(int), 0, height - 1)
    return image[row, column]
