"""Exposure cycles in clips from which frames are missing."""

import numpy as np
import pytest

from hdr_nsff.radiometry.dropped_frames import find_cycle
from hdr_nsff.radiometry.exposure_cycle import cycle_of_steps


def steps_of(evs: list[float], kept: np.ndarray, seed: int = 0) -> np.ndarray:
    """EV steps between the frames `kept` of an alternating clip, with some noise."""
    ev = np.array(evs)[kept % len(evs)]
    return np.diff(ev + np.random.default_rng(seed).normal(0, 0.1, len(ev)))


def ones(steps: np.ndarray) -> np.ndarray:
    return np.ones(len(steps), int)


@pytest.mark.parametrize("evs", [[0.0, 3.0], [-2.0, 0.0, 2.0], [-2.0, 0.0, 2.0, 0.0]])
def test_frames_that_are_missing_are_found_exactly(evs: list[float]) -> None:
    kept = np.delete(np.arange(48), [11, 29])
    found = find_cycle(steps_of(evs, kept), np.ones(45, int))
    assert found.slots.tolist() == kept.tolist()
    assert found.gaps == (11, 28) and found.period() == len(evs)
    shown = np.array(evs)[kept % len(evs)]
    assert len(set(zip(found.cycle.brackets, shown.tolist(), strict=True))) == len(set(evs))


def test_a_clip_without_gaps_keeps_its_cycle() -> None:
    for evs in ([0.0, 3.0], [-2.0, 0.0, 2.0], [-2.0, 0.0, 2.0, 0.0], [0.0]):
        steps = steps_of(evs, np.arange(40))
        found = find_cycle(steps, ones(steps))
        assert found.cycle == cycle_of_steps(steps) and not found.gaps
        assert found.slots.tolist() == list(range(40))


def test_random_exposures_are_no_cycle_with_gaps() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        steps = np.diff(rng.choice([-2.0, 0.0, 2.0], 40))
        assert find_cycle(steps, ones(steps)).gaps == ()


def test_a_scene_that_turns_dark_at_once_drops_no_frames() -> None:
    steps = steps_of([0.0, 3.0], np.arange(40))
    steps[19] -= 2.0
    assert find_cycle(steps, ones(steps)).gaps == ()


def test_gaps_that_timestamps_show_advance_the_cycle() -> None:
    kept = np.delete(np.arange(40), [9, 20, 21])
    steps = steps_of([-2.0, 0.0, 2.0], kept)
    found = find_cycle(steps, np.diff(kept))
    assert found.slots.tolist() == kept.tolist() and found.gaps == ()
    assert found.cycle.brackets == (kept % 3).tolist()


def test_a_camera_that_paused_its_cycle_is_found_beside_timestamps() -> None:
    steps = steps_of([-2.0, 0.0, 2.0], np.arange(40))
    known = ones(steps)
    known[14] = 2  # a gap in time after which the cycle goes on where it was
    found = find_cycle(steps, known)
    assert found.cycle.brackets == (np.arange(40) % 3).tolist() and found.gaps == (15,)


def test_no_exposure_is_made_up_that_no_frame_has() -> None:
    """Five exposures in turn, and a pause of one frame after each five."""
    slots = np.delete(np.arange(46), np.s_[5::6])
    levels = np.array([3.0, 2.0, -1.0, -3.0, -4.0])[slots % 6]
    steps = np.diff(levels + np.random.default_rng(0).normal(0, 0.02, len(levels)))
    cycle = find_cycle(steps, np.diff(slots)).cycle
    assert set(cycle.brackets) == set(range(len(cycle.ev)))
    assert len({*zip(cycle.brackets, levels.tolist(), strict=True)}) == 5
