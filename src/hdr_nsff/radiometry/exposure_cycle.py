"""Exposures from brightness alone: which frames share an exposure, and all frames
brought to one common brightness.

Nothing here knows the camera. "EV" in this file is `2.2 log2(recorded)`, the exposure
under the guess that the response is a plain gamma: good enough to find a cycle and its
order, and to doubt a user's list; the true values are learned later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_CYCLE = 6
LOW, HIGH = 0.012, 0.97  # a recorded value outside says only "darker than" or "brighter than"
# EV between the darkest and brightest bracket below which brightness merely flickers;
# positions of a cycle that are closer than this share a bracket
MIN_STEP = 0.3
MIN_EXPLAINED = 0.6  # share of the brightness changes a cycle must explain
NOISE = 0.1  # EV: changes of brightness smaller than this are never evidence
LEVELS = np.linspace(0.05, 0.95, 37)  # quantiles that stand for a frame's brightness
BINS = 1024


@dataclass(frozen=True)
class Cycle:
    """An exposure cycle found in a clip."""

    length: int  # 1: no alternation
    # per frame: positions of the cycle closer than `MIN_STEP` share a bracket, numbered
    # as they appear
    brackets: list[int]
    order: list[int]  # the brackets from the darkest to the brightest
    ev: list[
        float
    ]  # per bracket: EV relative to the darkest, under a gamma of 2.2 (a rough measurement)
    # in [0, 1]: the share of the brightness changes between frames that the cycle
    # explains
    confidence: float


def extent(rgb: np.ndarray) -> tuple[float, float]:
    """The recorded values between which nearly all of a frame (H, W, 3) lies."""
    low, high = np.percentile(rgb[::2, ::2], [1, 99])
    return float(low), float(high)


def all_clipped(extents: list[tuple[float, float]]) -> str | None:
    """ "black" or "white" where every frame is that and nothing else, else None;
    `extents` as of `extent`, one per frame.
    """
    if max(high for _, high in extents) < LOW:
        return "black"
    return "white" if min(low for low, _ in extents) > HIGH else None


def brightness_steps(video: np.ndarray) -> np.ndarray:
    """EV from each frame of `video` (T, H, W, 3) recorded to the next, (T-1,).

    Compares the same quantiles of both histograms (motion moves pixels, not quantiles)
    and takes the median over those that are neither black nor saturated in either
    frame, so one lamp or one passing car does not count.
    """
    stride = max(1, int(np.sqrt(video.shape[1] * video.shape[2] / 20000)))
    luminance = video[:, ::stride, ::stride].mean(-1).reshape(len(video), -1)
    q = np.quantile(luminance, LEVELS, axis=1).T  # (T, levels)
    ev = 2.2 * np.log2(np.maximum(q, 1 / 512))
    known = (q > LOW) & (q < HIGH)
    both = known[1:] & known[:-1]
    steps = np.diff(ev, axis=0)
    enough = both.sum(1) >= 3
    return np.array(
        [np.median(s[b] if e else s) for s, b, e in zip(steps, both, enough, strict=True)]
    )


def fit_cycle(steps: np.ndarray, length: int) -> tuple[float, np.ndarray]:
    """How badly a cycle of `length` explains the EV `steps` (mean absolute EV, at least
    `NOISE`), and its levels (length,) in EV.

    One median step per phase; what they sum to over a cycle is taken off, since a cycle
    comes back to where it began.
    """
    phase = np.arange(len(steps)) % length
    fit = np.array([np.median(steps[phase == k]) for k in range(length)])
    fit -= fit.mean()
    level = np.concatenate([[0.0], np.cumsum(fit[:-1])])
    return max(float(np.abs(steps - fit[phase]).mean()), NOISE), level - level.min()


def detect_cycle(video: np.ndarray, max_cycle: int = MAX_CYCLE) -> Cycle:
    """The exposure cycle of `video` (T, H, W, 3) recorded in [0, 1], or a cycle of
    length 1 where there is none.

    The steps of brightness between frames repeat with the cycle; of all lengths the one
    with the best Bayesian information criterion under Laplace noise wins, so a multiple
    of the true length, which fits no better, loses.
    """
    steps = brightness_steps(video)
    n = len(steps)
    candidates = [
        (length, *fit_cycle(steps, length))
        for length in range(1, max(1, min(max_cycle, (n + 1) // 2)) + 1)
    ]
    still = candidates[0][1]
    length, cost, level = min(candidates, key=lambda c: 2 * n * np.log(c[1]) + c[0] * np.log(n))
    if level.max() < MIN_STEP or 1 - cost / still < MIN_EXPLAINED:
        length, cost, level = candidates[0]
    positions = share_brackets(level)
    ev = [level[positions == b].mean() for b in range(positions.max() + 1)]
    return Cycle(
        length=length,
        brackets=[int(positions[t % length]) for t in range(len(video))],
        order=np.argsort(ev, kind="stable").tolist(),
        ev=[float(v) for v in ev],
        confidence=1 - cost / still,
    )


def share_brackets(levels: np.ndarray) -> np.ndarray:
    """The bracket (length,) of each position of a cycle with these `levels` (length,) in
    EV, numbered as they appear.

    A camera that goes up and down again (-2, 0, 2, 0 EV) shows one exposure at two
    positions. From the darkest on, positions within `MIN_STEP` of a bracket's darkest
    join it, so a ramp of small steps never becomes one bracket.
    """
    rank = np.zeros(len(levels), int)  # of each position's bracket, 0 the darkest
    current, darkest = -1, -np.inf
    for k in np.argsort(levels, kind="stable"):
        if levels[k] - darkest >= MIN_STEP:
            current, darkest = current + 1, levels[k]
        rank[k] = current
    appearance = list(dict.fromkeys(rank.tolist()))
    return np.array([appearance.index(r) for r in rank])


def period(brackets: list[int]) -> int:
    """The smallest p with `brackets[t] == brackets[t + p]` throughout and seen at least
    twice, else the number of brackets.
    """
    n = len(brackets)
    return next(
        (p for p in range(1, n // 2 + 1) if brackets[p:] == brackets[: n - p]), len(set(brackets))
    )


def by_value(ev: list[float]) -> tuple[list[int], list[float]]:
    """Frames with the same EV (to 0.01) share a bracket, numbered as they appear:
    (bracket per frame, EV per bracket).
    """
    keys = [round(v, 2) for v in ev]
    order = list(dict.fromkeys(keys))
    return [order.index(k) for k in keys], [ev[keys.index(k)] for k in order]


def common_brackets(cycles: list[Cycle]) -> list[list[int]]:
    """Per synchronized camera the bracket of each frame, such that equal brackets are
    equally bright in every camera.
    """
    kinds = [(c.length, len(c.order)) for c in cycles]
    usual = max(sorted(set(kinds)), key=kinds.count)
    lead = cycles[kinds.index(usual)]
    result = []
    for cycle, kind in zip(cycles, kinds, strict=True):
        if kind == usual:
            same = dict(zip(cycle.order, lead.order, strict=True))
            result.append([same[b] for b in cycle.brackets])
        else:  # a camera whose own cycle was not found takes that of the others
            frames = range(len(cycle.brackets))
            result.append([lead.brackets[t % lead.length] for t in frames])
    return result


def doubts(video: np.ndarray, ev: list[float]) -> list[str]:
    """What in `video` (T, H, W, 3), recorded, contradicts the given `ev` per frame:
    sentences, none where they agree.
    """
    steps, given = brightness_steps(video), np.diff(ev)
    alternates = np.abs(given) >= MIN_STEP
    if not alternates.any():
        cycle = detect_cycle(video)
        return (
            []
            if cycle.length == 1
            else [f"one exposure is given, but the brightness repeats every {cycle.length} frames"]
        )
    if np.abs(steps).mean() < MIN_STEP:
        return [
            f"exposure steps of {np.abs(given).mean():.1f} EV are given, but all frames are about equally bright"
        ]
    sign = np.mean(np.sign(steps[alternates]) == np.sign(given[alternates]))
    if sign < 0.8:
        cycle = detect_cycle(video)
        seen = (
            f"; the brightness repeats every {cycle.length} frames, order from dark to bright {cycle.order}"
            if cycle.length > 1
            else ""
        )
        return [f"only {sign:.0%} of the exposure steps go the way the brightness goes{seen}"]
    ratio = float(np.median(steps[alternates] / given[alternates]))
    if not 0.5 < ratio < 2:
        return [
            f"a step of 1 EV as given changes the brightness like {ratio:.1f} EV (measured with a gamma of 2.2)"
        ]
    return []


def reference_bracket(video: np.ndarray, brackets: list[int]) -> int:
    """The bracket of `video` (T, H, W, 3) whose pixels are best exposed: the largest
    share between 0.05 and `HIGH` in recorded value.
    """
    good = ((video > 0.05) & (video < HIGH)).mean((1, 2, 3))  # (T,)
    group = np.array(brackets)
    return int(
        np.argmax(
            [good[group == b].mean() if (group == b).any() else 0.0 for b in range(group.max() + 1)]
        )
    )


def equalize(
    video: np.ndarray, groups: list[int], pool: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """All frames at one common brightness, for matching only: (equalized (T, H, W, 3)
    in [0, 1], clipped (T, H, W) bool).

    `groups` says which frames of `video` (T, H, W, 3) share an exposure (and a camera);
    `pool` (T,) bool which frames the histograms are taken from (all). Each group shows
    about the same content, so the value of rank r in one histogram is the value of rank
    r in another: a monotone map per channel between any two exposures, with no response
    curve or exposure time assumed. A pixel becomes the mean of its images in all
    groups, which keeps contrast wherever any exposure has some. `clipped`: at least two
    channels say only "darker than" or "brighter than".
    """
    group = np.array(groups)
    pool = np.ones(len(group), bool) if pool is None else pool
    equalized, outside = np.empty(video.shape, np.float32), np.empty(video.shape, bool)
    ranks = np.linspace(0, 1, 4 * BINS)
    for channel in range(3):
        curves = {}
        for g in np.unique(group):
            frames = (group == g) & pool
            curves[g] = value_ranks(video[frames if frames.any() else group == g][..., channel])
        common = np.mean(
            [np.interp(ranks, rank, value) for value, rank in curves.values()], axis=0
        )  # (ranks,)
        for t, g in enumerate(group):
            value, rank = curves[g]
            recorded = video[t, ..., channel]
            equalized[t, ..., channel] = np.interp(recorded, value, np.interp(rank, ranks, common))
            black = LOW + np.interp(0.001, rank, value)  # some cameras add a pedestal
            outside[t, ..., channel] = (recorded < black) | (recorded > HIGH)
    return equalized, outside.sum(-1) >= 2


def value_ranks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The values in [0, 1] that occur (in `BINS` steps, increasing) and the share of
    `values` below each, ties counted half.

    All that is saturated is one tie: codes 250 to 255 of a burnt sky are not worth half
    the contrast.
    """
    count = np.bincount(np.rint(values.ravel() * (BINS - 1)).astype(np.int64), minlength=BINS)
    white = round(HIGH * (BINS - 1))
    count[white:] = [count[white:].sum(), *[0] * (BINS - 1 - white)]
    share = count / count.sum()
    rank = np.cumsum(share) - share / 2
    return np.flatnonzero(count) / (BINS - 1), rank[count > 0]
