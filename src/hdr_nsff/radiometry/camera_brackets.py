"""The brackets of synchronized cameras, each with a cycle of exposures or one of its
own, so that equal brackets are equal exposures.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.radiometry.exposure_cycle import Cycle, brightness_steps

# EV between two cameras that are exposed differently; smaller differences are of what
# they see, and the response has a gain per camera for them (hand-chosen)
MIN_CAMERA_STEP_EV = 0.7


def common_brackets(cycles: list[Cycle], group: list[int]) -> list[list[int]]:
    """Per synchronized camera the bracket of each frame, such that equal brackets are
    equally bright in every camera of a `group` (see `exposure_groups`).

    The most frequent cycle (its length and number of brackets) wins, and the first
    camera with it numbers the brackets. A camera with another cycle, whose own was not
    found, takes that of the others.
    """
    reference = cycles[usual_cameras(cycles)[0]]
    brackets = []
    for cycle, own_group in zip(cycles, group, strict=True):
        first = own_group * len(reference.order)
        if kind_of(cycle) == kind_of(reference):
            same_rank = dict(zip(cycle.order, reference.order, strict=True))
            brackets.append([first + same_rank[b] for b in cycle.brackets])
        else:
            frames = range(len(cycle.brackets))
            brackets.append([first + reference.brackets[t % reference.length] for t in frames])
    return brackets


def exposure_groups(videos: list[ArrayStack], cycles: list[Cycle]) -> list[int]:
    """The group (C,) of every synchronized camera: cameras of one group are equally
    exposed, those of different ones differ as a whole, as where each camera of a rig
    has an exposure of its own. Groups are numbered in the order of the cameras.

    `videos` of (T, H, W, 3) recorded. The cameras see one scene from different places,
    so only clear differences of brightness count. A camera whose own cycle was not
    found is in the first group.
    """
    compared = usual_cameras(cycles)
    level = np.zeros(len(cycles))
    level[compared] = camera_levels([videos[c] for c in compared], [cycles[c] for c in compared])
    ordered = np.argsort(level[compared], kind="stable")
    by_level = np.array(compared)[ordered]
    apart = np.diff(level[by_level]) > MIN_CAMERA_STEP_EV
    rank = dict(zip(by_level.tolist(), np.cumsum([0, *apart]).tolist(), strict=True))
    ranks = [rank.get(c, rank[compared[0]]) for c in range(len(cycles))]
    appearance = list(dict.fromkeys(ranks))
    return [appearance.index(r) for r in ranks]


def camera_levels(videos: list[ArrayStack], cycles: list[Cycle]) -> np.ndarray:
    """By how many EV (C,) cameras with cycles of one kind record brighter than the
    first: the median over the brackets, from dark to bright, of frames in mid-clip.
    """
    steps = []
    for rank in range(len(cycles[0].order)):
        frames = []
        for video, cycle in zip(videos, cycles, strict=True):
            own = [t for t, b in enumerate(cycle.brackets) if b == cycle.order[rank]]
            frames.append(video[own[len(own) // 2]])
        steps.append(brightness_steps(np.stack(frames)))
    return np.concatenate([[0.0], np.cumsum(np.median(steps, axis=0))])


def usual_cameras(cycles: list[Cycle]) -> list[int]:
    """The cameras whose cycle is of the most frequent kind."""
    kinds = [kind_of(cycle) for cycle in cycles]
    usual = max(sorted(set(kinds)), key=kinds.count)
    return [c for c, kind in enumerate(kinds) if kind == usual]


def kind_of(cycle: Cycle) -> tuple[int, int]:
    """The length of a cycle and its number of brackets."""
    return cycle.length, len(cycle.order)
