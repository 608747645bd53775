"""Exposures from brightness alone: which frames share an exposure, and all frames
brought to one common brightness.

No camera model is used. "EV" in this file is `2.2 log2(recorded)`: the exposure under
the assumption that the response is a plain gamma of 2.2. That is good enough to find a
cycle and its order, and to question a user's list; the true values are learned later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import ArrayStack, Stack

MAX_CYCLE = 6  # frames: the longest cycle looked for, two more than cameras offer
# EV between the darkest and brightest bracket below which brightness merely flickers;
# positions of a cycle that are closer than this share a bracket (hand-chosen on
# recorded clips: cameras step by 1/3 EV at least)
MIN_STEP = 0.3
SAME_EV = 0.01  # given exposures that are closer count as one
GAMMA = 2.2  # of the assumed response
BINS = 1024  # of the histograms; 8-bit codes fall four bins apart
QUANTILES = np.linspace(0.05, 0.95, 37)  # they stand for a frame's brightness


@dataclass(frozen=True)
class ExposureCycleTuning:
    """What counts as a step of exposure, and which recorded values carry information.

    All values are hand-chosen on recorded and rendered clips.
    """

    max_cycle: int = MAX_CYCLE  # frames
    min_step_ev: float = MIN_STEP
    min_explained: float = 0.6  # share of the brightness changes a cycle must explain
    # the same of a cycle that the clip shows fewer than three times: auto exposure of a
    # few frames may fit one. The cycles of eleven clips explain 0.95 and more
    min_explained_briefly: float = 0.8
    noise_ev: float = 0.1  # smaller changes of brightness are never evidence
    # recorded values outside [low, high] are only "darker than" or "brighter than"
    low: float = 0.012
    high: float = 0.97
    sampled_pixels: int = 20000  # of a frame, for its quantiles
    min_common_quantiles: int = 3  # away from black and white in both of two frames
    # a list of exposures is questioned when fewer of its steps have the sign of the
    # measured ones, or when it is off by more than this factor
    min_same_sign: float = 0.8
    min_alternating: float = 0.25  # share of given steps; fewer are no alternation
    max_ev_ratio: float = 2.0
    well_exposed_low: float = 0.05  # recorded value, for the choice of the reference
    # share of the darkest pixels that is the black of a camera with a pedestal
    pedestal_quantile: float = 0.001


@dataclass(frozen=True)
class Cycle:
    """An exposure cycle found in a clip."""

    length: int  # frames; 1: no alternation
    # per frame: positions of the cycle closer than `min_step_ev` share a bracket,
    # numbered in the order of appearance
    brackets: list[int]
    order: list[int]  # the brackets from the darkest to the brightest
    # per bracket: EV relative to the darkest, under a gamma of 2.2 (a rough
    # measurement)
    ev: list[float]
    # share of the brightness changes between frames that the cycle explains, in [0, 1]
    confidence: float


def extent(rgb: np.ndarray) -> tuple[float, float]:
    """The recorded values between which nearly all of a frame (H, W, 3) lies."""
    low, high = np.percentile(rgb[::2, ::2], [1, 99])
    return float(low), float(high)


def all_clipped(
    extents: list[tuple[float, float]], tuning: ExposureCycleTuning = ExposureCycleTuning()
) -> str | None:
    """ "black" or "white" where every frame is that and nothing else, else None;
    `extents` as of `extent`, one per frame.
    """
    if max(high for _, high in extents) < tuning.low:
        return "black"
    if min(low for low, _ in extents) > tuning.high:
        return "white"
    return None


def brightness_steps(
    video: ArrayStack, tuning: ExposureCycleTuning = ExposureCycleTuning()
) -> np.ndarray:
    """EV from each frame of `video` (T, H, W, 3) recorded to the next, (T-1,).

    The same quantiles of both histograms are compared: motion moves pixels, not
    quantiles. The median is taken over those that are neither black nor saturated in
    either frame, so one lamp or one passing car does not count.
    """
    num_frames, height, width = video.shape[:3]
    stride = max(1, int(np.sqrt(height * width / tuning.sampled_pixels)))
    sampled = [frame[::stride, ::stride].mean(-1).ravel() for frame in video]
    luminance = np.stack(sampled).reshape(num_frames, -1)
    quantiles = np.quantile(luminance, QUANTILES, axis=1).T  # (T, quantiles)
    ev = GAMMA * np.log2(np.maximum(quantiles, 1 / 512))
    informative = (quantiles > tuning.low) & (quantiles < tuning.high)
    common = informative[1:] & informative[:-1]
    medians = []
    for steps, use in zip(np.diff(ev, axis=0), common, strict=True):
        enough = use.sum() >= tuning.min_common_quantiles
        medians.append(np.median(steps[use] if enough else steps))
    return np.array(medians)


def fit_cycle(
    steps: np.ndarray, length: int, tuning: ExposureCycleTuning = ExposureCycleTuning()
) -> tuple[float, np.ndarray]:
    """How badly a cycle of `length` explains the EV `steps` (T-1,), and its levels.

    The misfit is the mean absolute EV, at least `noise_ev`; the levels (length,) are EV
    above the darkest. Every phase takes its median step; their mean is subtracted,
    since a cycle returns to where it began.
    """
    phase = np.arange(len(steps)) % length
    fitted = np.array([np.median(steps[phase == k]) for k in range(length)])
    fitted -= fitted.mean()
    levels = np.concatenate([[0.0], np.cumsum(fitted[:-1])])
    misfit = float(np.abs(steps - fitted[phase]).mean())
    return max(misfit, tuning.noise_ev), levels - levels.min()


def detect_cycle(video: ArrayStack, tuning: ExposureCycleTuning = ExposureCycleTuning()) -> Cycle:
    """The exposure cycle of `video` (T, H, W, 3) recorded in [0, 1], or a cycle of
    length 1 where there is none.

    The steps of brightness between frames repeat with the cycle. Of all lengths the one
    with the best Bayesian information criterion (Schwarz 1978) under Laplace noise
    wins, so a multiple of the true length, which fits hardly better, loses.
    """
    return cycle_of_steps(brightness_steps(video, tuning), tuning)


def cycle_of_steps(steps: np.ndarray, tuning: ExposureCycleTuning = ExposureCycleTuning()) -> Cycle:
    """The exposure cycle of EV `steps` (T-1,) between frames, as `detect_cycle`."""
    count = len(steps)
    lengths = range(1, longest_cycle(count + 1, tuning) + 1)
    fits = {length: fit_cycle(steps, length, tuning) for length in lengths}

    length = min(lengths, key=lambda n: information_criterion(fits[n][0], count, n - 1))
    misfit, levels = fits[length]
    misfit_without = fits[1][0]
    too_small = levels.max() < tuning.min_step_ev
    briefly = count < 3 * length
    least = tuning.min_explained_briefly if briefly else tuning.min_explained
    if too_small or 1 - misfit / misfit_without < least:
        length = 1
        misfit, levels = fits[1]
    bracket_of_phase = share_brackets(levels, tuning)
    ev = [float(levels[bracket_of_phase == b].mean()) for b in range(bracket_of_phase.max() + 1)]
    return Cycle(
        length=length,
        brackets=[int(bracket_of_phase[t % length]) for t in range(count + 1)],
        order=np.argsort(ev, kind="stable").tolist(),
        ev=ev,
        confidence=1 - misfit / misfit_without,
    )


def longest_cycle(num_frames: int, tuning: ExposureCycleTuning = ExposureCycleTuning()) -> int:
    """The longest cycle looked for in so many frames: they must show it twice."""
    return max(1, min(tuning.max_cycle, num_frames // 2))


def without_cycle(change: float, num_frames: int) -> str:
    """A sentence on frames whose brightness changes by `change` EV in no cycle."""
    text = f"brightness changes by {change:.1f} EV from frame to frame, but "
    longest = longest_cycle(num_frames)
    if longest == 1:
        return text + f"{num_frames} frames are too few to show a cycle"
    return text + f"in no cycle of up to {longest} frames"


def information_criterion(misfit: float, count: int, parameters: int) -> float:
    """The Bayesian information criterion of `count` steps under Laplace noise, whose
    mean absolute misfit is `misfit` EV; the `parameters` of short clips cost more
    (McQuarrie 1999, "A small-sample correction for the Schwarz SIC").
    """
    correction = count / max(count - parameters - 1, 1)
    return float(2 * count * np.log(misfit) + correction * parameters * np.log(count))


def share_brackets(
    levels: np.ndarray, tuning: ExposureCycleTuning = ExposureCycleTuning()
) -> np.ndarray:
    """The bracket (length,) of each position of a cycle with these `levels` (length,)
    in EV, numbered in the order of appearance.

    A camera that goes up and down again (-2, 0, 2, 0 EV) shows one exposure at two
    positions. From the darkest on, positions within `min_step_ev` of a bracket's
    darkest join it, so a ramp of small steps never becomes one bracket.
    """
    rank = np.zeros(len(levels), int)  # of each position's bracket, 0 the darkest
    current, darkest = -1, -np.inf
    for k in np.argsort(levels, kind="stable"):
        if levels[k] - darkest >= tuning.min_step_ev:
            current += 1
            darkest = levels[k]
        rank[k] = current
    appearance = list(dict.fromkeys(rank.tolist()))
    return np.array([appearance.index(r) for r in rank])


def period(brackets: list[int]) -> int:
    """The smallest p with `brackets[t] == brackets[t + p]` throughout and seen at least
    twice, else the number of different brackets.
    """
    count = len(brackets)
    for p in range(1, count // 2 + 1):
        if brackets[p:] == brackets[: count - p]:
            return p
    return len(set(brackets))


def brackets_by_ev(ev: list[float]) -> tuple[list[int], list[float]]:
    """Brackets from the EV of every frame: (bracket per frame, EV per bracket).

    From the darkest on, frames within `SAME_EV` of a bracket's darkest join it;
    brackets are numbered in the order of their first frames.
    """
    darkest: list[float] = []  # of every bracket
    for value in sorted(ev):
        if not darkest or value - darkest[-1] > SAME_EV:
            darkest.append(value)
    ranks = (np.searchsorted(darkest, ev, side="right") - 1).tolist()
    occurring = list(dict.fromkeys(ranks))
    return [occurring.index(r) for r in ranks], [ev[ranks.index(r)] for r in occurring]


def contradictions(
    video: ArrayStack, ev: list[float], tuning: ExposureCycleTuning = ExposureCycleTuning()
) -> list[str]:
    """What in `video` (T, H, W, 3), recorded, contradicts the given `ev` per frame:
    sentences, none where they agree.
    """
    measured = brightness_steps(video, tuning)
    given = np.diff(ev)
    alternates = np.abs(given) >= tuning.min_step_ev
    if alternates.mean() < tuning.min_alternating:
        length = detect_cycle(video, tuning).length
        if length == 1:
            return []
        return [
            "the given exposures do not alternate, but the brightness repeats every "
            f"{length} frames"
        ]
    if np.abs(measured[alternates]).mean() < tuning.min_step_ev:
        return [
            f"exposure steps of {np.abs(given[alternates]).mean():.1f} EV are given, "
            "but all frames are about equally bright"
        ]
    same_sign = np.mean(np.sign(measured[alternates]) == np.sign(given[alternates]))
    if same_sign < tuning.min_same_sign:
        sentence = f"only {same_sign:.0%} of the exposure steps go the way the brightness goes"
        cycle = detect_cycle(video, tuning)
        if cycle.length > 1:
            sentence += (
                f"; the brightness repeats every {cycle.length} frames, "
                f"order from dark to bright {cycle.order}"
            )
        return [sentence]
    ratio = float(np.median(measured[alternates] / given[alternates]))
    if not 1 / tuning.max_ev_ratio < ratio < tuning.max_ev_ratio:
        return [
            f"a given step of 1 EV changes the brightness like {ratio:.1f} EV "
            "(measured with a gamma of 2.2)"
        ]
    return []


def reference_bracket(
    video: ArrayStack,
    brackets: list[int],
    tuning: ExposureCycleTuning = ExposureCycleTuning(),
) -> int:
    """The best-exposed bracket of `video` (T, H, W, 3): the one with the largest share
    of recorded values between `well_exposed_low` and `high`.
    """
    low, high = tuning.well_exposed_low, tuning.high
    shown = track(video, "exposure: levels", len(video))
    share = np.array([((frame > low) & (frame < high)).mean() for frame in shown])  # (T,)
    bracket = np.array(brackets)
    shares = np.zeros(bracket.max() + 1)
    for b in np.unique(bracket):
        shares[b] = share[bracket == b].mean()
    return int(np.argmax(shares))


def equalize(
    video: np.ndarray,
    groups: list[int],
    pool: np.ndarray | None = None,
    tuning: ExposureCycleTuning = ExposureCycleTuning(),
) -> tuple[np.ndarray, np.ndarray]:
    """All frames at one common brightness, for matching only.

    Returns the equalized frames (T, H, W, 3) in [0, 1] and where they are clipped (T,
    H, W) bool: at least two channels are only "darker than" or "brighter than".

    `groups` gives the exposure (and camera) of each frame of `video` (T, H, W, 3);
    `pool` (T,) bool the frames that the histograms are taken from (all).
    """
    equalizer = fit_equalizer(video, groups, pool, tuning)
    equalized = np.stack([equalizer.equalize(frame, t) for t, frame in enumerate(video)])
    clipped = np.stack([equalizer.clipped(frame, t) for t, frame in enumerate(video)])
    return equalized, clipped


@dataclass(frozen=True)
class Equalizer:
    """A monotone map of recorded values per frame's group and channel.

    Each group shows about the same content, so the value of rank r in one histogram
    corresponds to that of rank r in another: a monotone map per channel between any two
    exposures, without a response curve or exposure times (histogram specification,
    Grossberg and Nayar 2003). A pixel becomes the mean of its images in all groups,
    which keeps contrast wherever any exposure has some.
    """

    groups: list[int]  # of every frame
    # per group and channel: recorded values, increasing, and their images
    maps: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]
    black: dict[tuple[int, int], float]  # recorded values below it are clipped
    white: float  # recorded values above it are clipped

    def equalize(self, frame: np.ndarray, t: int) -> np.ndarray:
        """Frame `t` (H, W, 3), recorded in [0, 1] or as codes, at the common
        brightness.
        """
        result = np.empty(frame.shape, np.float32)
        for channel in range(3):
            recorded = frame[..., channel]
            value, image = self.maps[self.groups[t], channel]
            if frame.dtype.kind == "u":  # as many values as codes
                codes = np.arange(np.iinfo(frame.dtype).max + 1)
                table = np.interp(unit(codes.astype(frame.dtype)), value, image)
                result[..., channel] = table.astype(np.float32)[recorded]
            else:
                result[..., channel] = np.interp(recorded, value, image)
        return result

    def clipped(self, frame: np.ndarray, t: int) -> np.ndarray:
        """Pixels (H, W) of frame `t`, recorded in [0, 1] or as codes, with at least two
        channels that are only "darker than" or "brighter than".
        """
        count = np.zeros(frame.shape[:2], np.uint8)
        recorded = unit(frame)
        for channel in range(3):
            black = self.black[self.groups[t], channel]
            count += (recorded[..., channel] < black) | (recorded[..., channel] > self.white)
        return count >= 2


def unit(frame: np.ndarray) -> np.ndarray:
    """Recorded values as float32 in [0, 1], from codes where these are integers."""
    if frame.dtype.kind == "u":
        return frame.astype(np.float32) / np.iinfo(frame.dtype).max
    return frame


def fit_equalizer(
    video: ArrayStack,
    groups: list[int],
    pool: np.ndarray | None = None,
    tuning: ExposureCycleTuning = ExposureCycleTuning(),
) -> Equalizer:
    """The maps that bring frames (T, H, W, 3), recorded in [0, 1] or as codes, to one
    brightness. The other arguments are those of `equalize`.
    """
    group = np.array(groups)
    pool = np.ones(len(group), bool) if pool is None else pool
    counts = {(int(g), c): np.zeros(BINS, np.int64) for g in set(groups) for c in range(3)}
    without_pool = {int(g) for g in set(groups) if not pool[group == g].any()}
    for t, g in enumerate(groups):
        if pool[t] or g in without_pool:
            frame = unit(video[t])
            for channel in range(3):
                counts[g, channel] += value_counts(frame[..., channel])
    ranks = np.linspace(0, 1, 4 * BINS)
    maps, black = {}, {}
    for channel in range(3):
        histograms = {g: ranks_of(counts[g, channel], tuning) for g in sorted(set(groups))}
        values_at_ranks = [np.interp(ranks, rank, value) for value, rank in histograms.values()]
        common = np.mean(values_at_ranks, axis=0)  # (ranks,)
        for g, (value, rank) in histograms.items():
            maps[g, channel] = (value, np.interp(rank, ranks, common))
            black[g, channel] = tuning.low + np.interp(tuning.pedestal_quantile, rank, value)
    return Equalizer(list(groups), maps, black, tuning.high)


def equalized_stacks(codes: Stack, equalizer: Equalizer) -> tuple[Stack, Stack]:
    """Equalized frames (T, H, W, 3) and their clipped pixels (T, H, W), of recorded
    `codes` (T, H, W, 3), made when asked for.
    """
    frames = Stack(lambda t: equalizer.equalize(codes[t], t), codes.shape)
    clipped = Stack(lambda t: equalizer.clipped(codes[t], t), codes.shape[:3])
    return frames, clipped


def value_ranks(
    values: np.ndarray, tuning: ExposureCycleTuning = ExposureCycleTuning()
) -> tuple[np.ndarray, np.ndarray]:
    """The values in [0, 1] that occur, and the share of `values` below each."""
    return ranks_of(value_counts(values), tuning)


def value_counts(values: np.ndarray) -> np.ndarray:
    """How many of `values` in [0, 1] fall into each of `BINS` steps."""
    codes = np.rint(values.ravel() * (BINS - 1)).astype(np.int64)
    return np.bincount(codes, minlength=BINS)


def ranks_of(
    count: np.ndarray, tuning: ExposureCycleTuning = ExposureCycleTuning()
) -> tuple[np.ndarray, np.ndarray]:
    """The values in [0, 1] that occur, and the share of all below each.

    Values come in `BINS` steps (BINS,), increasing; ties count half. All saturated
    values are one tie, or codes 250 to 255 of a burnt sky would take half of the
    contrast.
    """
    count = count.copy()
    white = round(tuning.high * (BINS - 1))
    count[white] = count[white:].sum()
    count[white + 1 :] = 0
    share = count / count.sum()
    rank = np.cumsum(share) - share / 2
    return np.flatnonzero(count) / (BINS - 1), rank[count > 0]
