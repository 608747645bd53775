"""Exposures from brightness alone, on clips made here: textures that pan, flicker,
light up; recorded with a gamma of 2.2.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdr_nsff.radiometry.exposure_cycle import (
    ExposureCycleTuning,
    brackets_by_ev,
    contradictions,
    cycle_of_steps,
    detect_cycle,
    equalize,
    period,
    reference_bracket,
    share_brackets,
    value_ranks,
    without_cycle,
)


def texture(width: int, seed: int = 0) -> np.ndarray:
    """Smooth positive radiance (48, width, 3), two decades of it."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(48, width, 3))
    kernel = np.hanning(13) / np.hanning(13).sum()
    for axis in (0, 1):
        noise = np.apply_along_axis(lambda v: np.convolve(v, kernel, "same"), axis, noise)
    return np.exp(noise / noise.std() * 1.1 - 2.5)


def clip(
    evs: list[float],
    frames: int = 24,
    pan: int = 0,
    flicker: float = 0.0,
    light_at: int | None = None,
    seed: int = 0,
) -> np.ndarray:
    """A recorded clip (T, 48, 64, 3) whose frame t has exposure `evs[t % n]`."""
    world, rng = texture(64 + pan * frames, seed), np.random.default_rng(seed + 1)
    shots = []
    for t in range(frames):
        ev = (
            evs[t % len(evs)]
            + flicker * rng.normal()
            + (1.5 if light_at is not None and t >= light_at else 0)
        )
        exposure = world[:, pan * t : pan * t + 64] * 2.0**ev + rng.normal(size=(48, 64, 3)) * 1e-3
        shots.append(np.rint(np.clip(exposure, 0, 1) ** (1 / 2.2) * 255) / 255)
    return np.stack(shots).astype(np.float32)


@pytest.mark.parametrize(
    "evs", [[-2, 0, 2], [2, 0, -2], [0, -3], [-2, 2, 0], [-1, 0, 1, 2], [-3, 0, -1.5, 1.5, 3]]
)
def test_cycle_and_order_are_found_from_brightness(evs):
    cycle = detect_cycle(clip(evs))
    assert cycle.length == len(evs)
    assert cycle.order == np.argsort(evs).tolist()
    assert cycle.brackets[: len(evs) + 1] == [*range(len(evs)), 0]


@pytest.mark.parametrize(
    ("evs", "brackets", "order"),
    [
        ([-2, 0, 2, 0], [0, 1, 2, 1], [0, 1, 2]),
        ([0, 2, 0, -2], [0, 1, 0, 2], [2, 0, 1]),
        ([-1, 0.5, 2, 0.5], [0, 1, 2, 1], [0, 1, 2]),
    ],
)
def test_positions_of_one_exposure_share_a_bracket(evs, brackets, order):
    cycle = detect_cycle(clip(evs))
    assert cycle.length == 4 and cycle.brackets[:8] == brackets * 2
    assert cycle.order == order and len(cycle.ev) == 3
    assert period(cycle.brackets) == 4


def test_a_ramp_of_small_steps_is_not_one_bracket():
    assert share_brackets(np.array([0.0, 0.2, 0.4, 0.6])).tolist() == [0, 0, 1, 1]
    assert share_brackets(np.array([2.0, 0.0, 2.1, 4.0])).tolist() == [0, 1, 0, 2]


def test_steps_below_the_least_one_are_flicker():
    """Brackets 4 EV apart are a cycle by default, and flicker if it takes 5 EV."""
    video = clip([-2, 0, 2])
    assert detect_cycle(video, ExposureCycleTuning(min_step_ev=5.0)).length == 1


def test_cycle_survives_a_pan_flicker_and_a_light_switched_on():
    assert detect_cycle(clip([-2, 0, 2], pan=3)).length == 3
    assert detect_cycle(clip([0, 2], flicker=0.15)).length == 2
    assert detect_cycle(clip([-2, 0, 2], light_at=10)).length == 3


def test_steps_of_two_stops_measure_about_two_ev():
    assert np.allclose(detect_cycle(clip([-2, 0, 2])).ev, [0, 2, 4], atol=0.3)


def test_auto_exposure_of_a_few_frames_is_no_cycle():
    """Steps of eleven frames that happen to repeat after five, by 69 %."""
    hunting = np.array([-1.4, -1.27, -0.2, 1.3, -0.12, -0.99, -0.95, -0.15, 1.31, 2.03])
    assert cycle_of_steps(hunting).length == 1
    cycle = np.array([-1.4, -1.27, -0.2, 1.3, 1.57] * 2)  # one that returns
    assert cycle_of_steps(cycle).length == 5


def test_ordinary_clips_have_no_cycle():
    assert detect_cycle(clip([0])).length == 1
    assert detect_cycle(clip([0], pan=3, flicker=0.1)).length == 1
    assert detect_cycle(clip([0], light_at=12)).length == 1
    assert detect_cycle(np.zeros((8, 8, 8, 3), np.float32)).length == 1


def test_a_cycle_is_never_a_multiple_of_itself():
    assert [
        detect_cycle(clip([-2, 0, 2], frames=n, seed=n)).length for n in (7, 9, 12, 13, 40)
    ] == [3] * 5


def test_noise_hardly_ever_makes_the_cycle_of_a_short_clip_longer():
    """Six levels explain much of the noise of twelve frames."""
    steps = np.diff(np.array([0.0, 2.0, -2.0])[np.arange(12) % 3])
    noise = np.random.default_rng(0).laplace(scale=0.4, size=(200, 11))
    lengths = [cycle_of_steps(steps + of_clip).length for of_clip in noise]
    assert np.mean(np.array(lengths) == 3) > 0.95


def test_too_few_frames_for_a_cycle_find_none():
    assert detect_cycle(clip([-2, 0, 2], frames=3)).length == 1


@given(st.integers(1, 4), st.integers(2, 5))
def test_period_of_a_repeated_sequence_divides_it(length, repeats):
    sequence = list(range(length)) * repeats
    assert period(sequence) == length


def test_equal_values_share_a_bracket():
    brackets, ev = brackets_by_ev([-2, 0, 2, 0, -2])
    assert brackets == [0, 1, 2, 1, 0]
    assert ev == [-2, 0, 2]


@given(st.lists(st.floats(-0.0045, 0.0045), min_size=8, max_size=8), st.floats(-3, 3))
def test_jitter_never_splits_a_bracket(jitter, level):
    evs = [level + 2 * (t % 2) + own for t, own in enumerate(jitter)]
    brackets, ev = brackets_by_ev(evs)
    assert brackets == [0, 1] * 4 and ev == evs[:2]


def test_a_correct_list_causes_no_warning_and_wrong_ones_do():
    video = clip([-2, 0, 2])
    assert contradictions(video, [-2, 0, 2] * 8) == []
    assert "go the way" in contradictions(video, [2, 0, -2] * 8)[0]
    assert "changes the brightness like" in contradictions(video, [-0.5, 0, 0.5] * 8)[0]
    assert "equally bright" in contradictions(clip([0]), [-2, 0, 2] * 8)[0]
    assert "repeats every 3" in contradictions(video, [0.0] * 24)[0]


def test_a_single_jump_of_a_list_is_no_alternation():
    """As of auto exposure, which keeps the brightness where the light changes."""
    assert contradictions(clip([0]), [0.0] * 12 + [0.5] * 12) == []
    assert "repeats every 2" in contradictions(clip([0, 2]), [0.0] * 12 + [0.5] * 12)[0]


def test_reference_is_the_best_exposed_bracket():
    assert reference_bracket(clip([-7, 0.5, 5]), [0, 1, 2] * 8) == 1


def test_equalized_exposures_agree_where_both_recorded():
    video = clip([-2, 0, 2], frames=9)
    equalized, clipped = equalize(video, [0, 1, 2] * 3)
    for a, b in ((0, 1), (1, 2)):
        both = ~clipped[a] & ~clipped[b]
        before, after = (np.abs(v[a] - v[b])[both].mean() for v in (video, equalized))
        assert after < 0.02 < 0.1 < before


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=2, max_size=3), st.integers(0, 5))
def test_equalizing_keeps_the_order_of_values_in_every_frame(evs, seed):
    video = clip(evs, frames=6, seed=seed)
    equalized, _ = equalize(video, [t % len(evs) for t in range(6)])
    for t in range(6):
        order = np.argsort(video[t, ..., 1].ravel(), kind="stable")
        assert (np.diff(equalized[t, ..., 1].ravel()[order]) >= -1e-6).all()
    assert equalized.min() >= 0 and equalized.max() <= 1


def test_one_exposure_is_left_as_it_is():
    video = clip([-1], frames=4)
    equalized, _ = equalize(video, [0] * 4)
    assert np.abs(equalized - video)[video < 0.97].max() < 3 / 255


def test_saturated_and_black_pixels_are_marked():
    video = np.full((2, 4, 4, 3), 0.5, np.float32)
    video[0, 0, 0], video[0, 1, 1], video[0, 2, 2] = 1.0, 0.0, (1.0, 0.5, 0.5)
    video[1, :2] = 0.1
    _, clipped = equalize(video, [0, 0])
    assert clipped[0, 0, 0] and clipped[0, 1, 1]
    assert not clipped[0, 2, 2] and clipped.sum() == 2


def test_held_out_frames_do_not_shape_the_histograms():
    video, pool = clip([-2, 2], frames=8), np.arange(8) != 3
    changed = video.copy()
    changed[3] = 0.7
    a, b = (equalize(v, [0, 1] * 4, pool)[0] for v in (video, changed))
    assert np.array_equal(a[pool], b[pool])


def test_ranks_count_ties_half():
    value, rank = value_ranks(np.array([0.0, 0.0, 1023 / 1023 * 0.5, 0.5]))
    assert np.allclose(rank, [0.25, 0.75])
    assert np.allclose(value, [0, 0.5], atol=1e-3)


def test_a_short_clip_is_not_said_to_have_no_cycle_that_it_is_too_short_to_show():
    assert "3 frames are too few to show a cycle" in without_cycle(2.0, 3)
    assert "no cycle of up to 3 frames" in without_cycle(2.0, 7)
    assert "no cycle of up to 6 frames" in without_cycle(2.0, 40)
