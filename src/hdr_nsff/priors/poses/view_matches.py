"""Keypoints and matches of all views of a clip, found once in unmasked images and
filtered by the masks of every round of structure from motion.

Which pixels move is known better after every round; where keypoints lie is not. Pairs
are matched in windows along time and at growing distances, but a view that is no
keyframe only with the keyframes around it, so the number of pairs grows with the number
of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hdr_nsff.priors.poses.matching import MatchingTuning, view_pairs

Pairs = list[tuple[int, int]]
MATCHING_TUNING = MatchingTuning()


@dataclass(frozen=True)
class KeyframeTuning:
    """Which views are mapped first (chosen on a clip of 64 frames: half of them take a
    third of the time; the focal length stays within 2 %).
    """

    max_all: int = 48  # up to this many views, all are mapped at once
    share: float = 0.5  # of the views of longer clips that are keyframes ...
    min_keyframes: int = 32  # ... but no fewer than this many
    max_keyframes: int = 64  # ... and no more
    links: int = 2  # keyframes before, and after, that any other view is matched with


@dataclass(frozen=True)
class ViewMatches:
    """Keypoints of every view, and matches of pairs of views."""

    keypoints: list[np.ndarray]  # (N, 2) per view: pixels of its image, centers at +0.5
    pairs: Pairs
    matches: list[np.ndarray]  # (M, 2) per pair: rows of both

    def outside(self, masks: Sequence[np.ndarray]) -> ViewMatches:
        """What is left where the `masks` (H, W) of the views are above 0."""
        keypoints, new_rows = [], []
        for points, mask in zip(self.keypoints, masks, strict=True):
            height, width = mask.shape
            x = points[:, 0].astype(int).clip(0, width - 1)
            y = points[:, 1].astype(int).clip(0, height - 1)
            kept = mask[y, x] > 0
            keypoints.append(points[kept])
            new_rows.append(np.where(kept, np.cumsum(kept) - 1, -1))
        matches = []
        for (a, b), rows in zip(self.pairs, self.matches, strict=True):
            first, second = new_rows[a][rows[:, 0]], new_rows[b][rows[:, 1]]
            both = (first >= 0) & (second >= 0)
            matches.append(np.stack([first[both], second[both]], 1))
        return ViewMatches(keypoints, self.pairs, matches)


@dataclass
class EarlierRounds:
    """What one round of structure from motion leaves to the next."""

    # by matcher and contrast, and checksums of the images
    matches: dict[tuple[str, tuple[int, ...]], ViewMatches] = field(default_factory=dict)
    # the files of the model that was found, by name; empty: none
    model: dict[str, bytes] = field(default_factory=dict)
    readout: float | None = None  # of the rolling shutter, in frames; None: not measured


def choose_keyframes(
    groups: Sequence[Sequence[int]], tuning: KeyframeTuning = KeyframeTuning()
) -> list[int]:
    """The views that are mapped first, spread evenly over the views of each camera, the
    first and the last ones among them; empty where all are mapped at once.
    """
    count = sum(len(group) for group in groups)
    if count <= tuning.max_all:
        return []
    wanted = int(np.clip(tuning.share * count, tuning.min_keyframes, tuning.max_keyframes))
    chosen: list[int] = []
    for group in groups:
        number = max(2, round(wanted * len(group) / count))
        positions = np.linspace(0, len(group) - 1, min(number, len(group)))
        chosen += [group[k] for k in np.unique(positions.round().astype(int))]
    return sorted(chosen)


def pairs_to_match(
    groups: Sequence[Sequence[int]],
    keyframes: Sequence[int],
    matching: MatchingTuning = MATCHING_TUNING,
    tuning: KeyframeTuning = KeyframeTuning(),
) -> Pairs:
    """The pairs of views to match: keyframes among each other as `view_pairs` chooses
    them, other views with the keyframes around them. Without keyframes, as
    `view_pairs` chooses among all views.
    """
    if not keyframes:
        return view_pairs([list(group) for group in groups], matching)
    is_keyframe = set(keyframes)
    of_keyframes = [[v for v in group if v in is_keyframe] for group in groups]
    pairs = set(view_pairs(of_keyframes, matching))
    for group, own in zip(groups, of_keyframes, strict=True):
        for view in group:
            if view in is_keyframe:
                continue
            place = int(np.searchsorted(own, view))
            around = own[max(0, place - tuning.links) : place + tuning.links]
            pairs |= {(min(view, other), max(view, other)) for other in around}
    return sorted(pairs)
