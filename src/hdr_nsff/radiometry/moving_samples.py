"""Points on movers with what every exposure recorded of them, found by optical flow.

They serve where static points tell too little of a curve, such as those of a dark room
behind somebody who fills the picture. Light on a mover changes as it turns, which
static points know nothing of, so they come second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import LazyList
from hdr_nsff.radiometry.samples import Samples, empty_samples, joined
from hdr_nsff.radiometry.static_samples import (
    KEPT_PATCHES,
    PatchStatistics,
    ResponseView,
    StaticSamplesTuning,
    enter_readings,
    patch_statistics,
    spread_over_levels,
)

TUNING = StaticSamplesTuning()


@dataclass(frozen=True)
class FlowLinks:
    """Optical flow between recorded frames."""

    targets: Sequence[Sequence[int]]  # of every view: the views that flow leads to
    # (from, to) -> flow (H, W, 2) px and where it is valid (H, W), as of `FlowPrior`
    read: Callable[[int, int], tuple[np.ndarray, np.ndarray]]


def moving_samples(
    views: Sequence[ResponseView],
    links: FlowLinks,
    num_brackets: int,
    num: int,
    rng: np.random.Generator,
    tuning: StaticSamplesTuning = TUNING,
) -> Samples:
    """Up to `num` points of movers with what their own bracket and those that flow
    leads to recorded of them.
    """
    patches = LazyList(lambda k: moving_patches(views[k], tuning), len(views), KEPT_PATCHES)
    points_per_view = max(1, num // max(len(views), 1))
    parts = [
        samples_of_movers(source, views, patches, links, num_brackets, points_per_view, rng, tuning)
        for source in track(range(len(views)), "response: points of movers")
    ]
    return joined(parts, num_brackets)


def samples_of_movers(
    source: int,
    views: Sequence[ResponseView],
    patches: Sequence[PatchStatistics],
    links: FlowLinks,
    num_brackets: int,
    num: int,
    rng: np.random.Generator,
    tuning: StaticSamplesTuning = TUNING,
) -> Samples:
    """Up to `num` points on movers of view `source`."""
    view, own = views[source], patches[source]
    others = [k for k in links.targets[source] if views[k].bracket != view.bracket]
    flows = {k: links.read(source, k) for k in others}
    followed = np.zeros(own.good.shape, bool)
    for _, valid in flows.values():
        followed |= valid
    pixels = spread_over_levels(view.image, own.good & followed, num, rng, tuning)
    columns, rows = pixels.T
    samples = empty_samples(len(pixels), num_brackets, source)
    enter_readings(samples, view.bracket, own, np.ones(len(pixels), bool), rows, columns)
    for k in sorted(others, key=lambda k: abs(views[k].time - view.time)):
        flow, valid = flows[k]
        ends = np.rint(pixels + flow[rows, columns]).astype(int)
        size = np.array(valid.shape)[::-1]
        seen = valid[rows, columns] & ((ends >= 0) & (ends < size)).all(-1)
        there = np.where(seen[:, None], ends, 0)
        seen &= patches[k].good[there[:, 1], there[:, 0]]
        enter_readings(samples, views[k].bracket, patches[k], seen, there[:, 1], there[:, 0])
    return samples


def moving_patches(view: ResponseView, tuning: StaticSamplesTuning = TUNING) -> PatchStatistics:
    """The patches of a view, good where their center moves."""
    if view.moving is None:
        return patch_statistics(view.image, np.zeros(view.image.shape[:2], bool), tuning)
    return patch_statistics(view.image, view.moving, tuning)
