"""An exposure cycle in a clip from which frames are missing: the frame after a gap does
not have the next exposure of the cycle.

The position of every frame in the cycle is the cheapest path through all positions
(Viterbi 1967): a change of brightness costs its distance in EV from that of the cycle,
and a frame that does not follow the one before costs a penalty. Levels and path are
found in turns. A cycle with gaps has to be worth its gaps by the Bayesian information
criterion of `exposure_cycle.detect_cycle`, so clips without gaps keep their cycle.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hdr_nsff.radiometry.exposure_cycle import (
    Cycle,
    ExposureCycleTuning,
    cycle_of_steps,
    fit_cycle,
    information_criterion,
    longest_cycle,
    share_brackets,
)


@dataclass(frozen=True)
class DroppedFramesTuning:
    """When a cycle has gaps (hand-chosen on recorded clips with frames removed)."""

    max_share: float = 0.1  # of the frames after which some are missing
    min_gaps: int = 1  # that are always allowed
    rounds: int = 4  # of levels and positions in turns
    window_cycles: int = 3  # of the parts of a clip that levels are first fitted to
    gap_parameters: int = 3  # of the information criterion: a place and a size
    cycle: ExposureCycleTuning = field(default_factory=ExposureCycleTuning)


TUNING = DroppedFramesTuning()


@dataclass(frozen=True)
class GappedCycle:
    """A cycle, and where every frame stands in it."""

    cycle: Cycle
    # (T,) numbers of the frames if none were missing, the first one 0; what is missing
    # is known up to whole cycles
    slots: np.ndarray
    gaps: tuple[int, ...]  # positions of the first frames after gaps

    def period(self) -> int:
        """The smallest number of slots after which all exposures repeat."""
        return period_in_time(self.cycle.brackets, self.slots.tolist())


def period_in_time(brackets: list[int], times: list[float]) -> int:
    """The smallest time in frames after which all `brackets` (T,) of frames at `times`
    (T,), the first one 0, repeat; else the number of different brackets.
    """
    of_time = dict(zip(times, brackets, strict=True))
    for p in range(1, int(times[-1]) // 2 + 1):
        later = {time: round(time + p, 6) for time in times}  # as times are stored
        pairs = [(b, of_time[later[time]]) for time, b in of_time.items() if later[time] in of_time]
        if pairs and all(a == b for a, b in pairs):
            return p
    return len(set(brackets))


def find_cycle(
    steps: np.ndarray, known: np.ndarray, tuning: DroppedFramesTuning = TUNING
) -> GappedCycle:
    """The exposure cycle of EV `steps` (T-1,) between frames, of which some may be
    missing; `known` (T-1,) integers: by how many frames each frame follows the one
    before as far as is known, 1 where nothing is missing.
    """
    plain = cycle_of_steps(steps, tuning.cycle)
    slots = np.concatenate([[0], np.cumsum(known)])
    count = len(steps)
    best, lowest = GappedCycle(plain, slots, ()), np.inf
    without_gaps = bool((known == 1).all())
    if without_gaps:
        lowest = criterion(fit_cycle(steps, plain.length, tuning.cycle)[0], plain.length, 0, count)
    misfit_without = fit_cycle(steps, 1, tuning.cycle)[0]
    for length in range(2, longest_cycle(count + 1, tuning.cycle) + 1):
        phases, levels = fit_phases(steps, known, length, tuning)
        if len(np.unique(phases)) < length:
            continue  # an exposure that no frame has
        advance = (np.diff(phases) - known) % length  # frames that are missing beyond `known`
        misfit = mean_misfit(steps, phases, levels, tuning)
        gaps = int(np.count_nonzero(advance))
        value = criterion(misfit, length, gaps, count, tuning)
        explained = 1 - misfit / misfit_without
        too_small = levels.max() < tuning.cycle.min_step_ev
        if too_small or explained < tuning.cycle.min_explained or value >= lowest:
            continue
        if not plausible(advance, length, tuning):
            continue
        if without_gaps and not advance.any():
            continue  # `plain` found as much
        lowest = value
        found = cycle_of_phases(phases, levels, explained, tuning)
        slots = np.concatenate([[0], np.cumsum(known + advance)])
        best = GappedCycle(found, slots, tuple((np.flatnonzero(advance) + 1).tolist()))
    return best


def criterion(
    misfit: float, length: int, gaps: int, count: int, tuning: DroppedFramesTuning = TUNING
) -> float:
    """The information criterion of a cycle of `length` with `gaps`."""
    return information_criterion(misfit, count, length - 1 + tuning.gap_parameters * gaps)


def plausible(advance: np.ndarray, length: int, tuning: DroppedFramesTuning) -> bool:
    """Whether gaps `advance` (T-1,) are few, with a whole cycle between them."""
    gaps = np.flatnonzero(advance) + 1
    if len(gaps) > max(tuning.min_gaps, tuning.max_share * len(advance)):
        return False
    runs = np.diff([0, *gaps, len(advance) + 1])
    return bool(runs.min() >= length)


def fit_phases(
    steps: np.ndarray, known: np.ndarray, length: int, tuning: DroppedFramesTuning
) -> tuple[np.ndarray, np.ndarray]:
    """The position (T,) of every frame in a cycle of `length`, and the levels (length,)
    of its positions in EV above the darkest.
    """
    levels = first_levels(steps, length, tuning)
    phases = np.arange(len(steps) + 1) % length
    for _ in range(tuning.rounds):
        phases = cheapest_phases(steps, known, levels, tuning)
        levels = fit_levels(steps, phases, levels, tuning)
    first = phases[0]  # the first frame begins the cycle
    return (phases - first) % length, np.roll(levels, -first)


def first_levels(steps: np.ndarray, length: int, tuning: DroppedFramesTuning) -> np.ndarray:
    """Levels (length,) of the part of the clip that a cycle explains best."""
    size = min(len(steps), tuning.window_cycles * length)
    starts = range(0, len(steps) - size + 1)
    fits = [fit_cycle(steps[a : a + size], length, tuning.cycle) for a in starts]
    return min(fits, key=lambda fit: fit[0])[1]


def cheapest_phases(
    steps: np.ndarray, known: np.ndarray, levels: np.ndarray, tuning: DroppedFramesTuning
) -> np.ndarray:
    """The positions (T,) in a cycle of `levels` (length,) that explain steps best."""
    length, count = len(levels), len(steps)
    change = levels[None] - levels[:, None]  # from one position to another
    advance = (np.arange(length)[None] - np.arange(length)[:, None]) % length
    penalty = tuning.cycle.noise_ev * tuning.gap_parameters * np.log(count) / 2
    cost, before = np.zeros(length), np.zeros((count, length), int)
    for t, step in enumerate(steps):
        unexpected = advance != known[t] % length
        total = cost[:, None] + np.abs(step - change) + penalty * unexpected
        before[t] = total.argmin(0)
        cost = total.min(0)
    phases = [int(cost.argmin())]
    for t in range(count - 1, -1, -1):
        phases.append(int(before[t, phases[-1]]))
    return np.array(phases[::-1])


def fit_levels(
    steps: np.ndarray, phases: np.ndarray, levels: np.ndarray, tuning: DroppedFramesTuning
) -> np.ndarray:
    """Levels (length,) from the steps between frames that follow each other, like
    `fit_cycle`; those of `levels` where a position has none.
    """
    length = len(levels)
    fitted = np.roll(levels, -1) - levels
    follows = np.diff(phases) % length == 1 % length
    for phase in range(length):
        own = steps[follows & (phases[:-1] == phase)]
        if len(own):
            fitted[phase] = np.median(own)
    fitted -= fitted.mean()
    found = np.concatenate([[0.0], np.cumsum(fitted[:-1])])
    return found - found.min()


def mean_misfit(
    steps: np.ndarray, phases: np.ndarray, levels: np.ndarray, tuning: DroppedFramesTuning
) -> float:
    """The mean absolute EV that positions in a cycle leave unexplained."""
    misfit = float(np.abs(steps - np.diff(levels[phases])).mean())
    return max(misfit, tuning.cycle.noise_ev)


def cycle_of_phases(
    phases: np.ndarray, levels: np.ndarray, explained: float, tuning: DroppedFramesTuning
) -> Cycle:
    """The cycle with these `levels` (length,) whose frames stand at `phases` (T,)."""
    bracket_of_phase = share_brackets(levels, tuning.cycle)
    of_brackets = [levels[bracket_of_phase == b] for b in range(bracket_of_phase.max() + 1)]
    ev = [float(own.mean()) for own in of_brackets]
    return Cycle(
        length=len(levels),
        brackets=bracket_of_phase[phases].tolist(),
        order=np.argsort(ev, kind="stable").tolist(),
        ev=ev,
        confidence=explained,
    )
