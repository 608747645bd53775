"""Frames that are held out of training."""

import numpy as np
import pytest

from hdr_nsff.footage.hold_out import hold_out_every, hold_out_spacing, widest_hold_out


def test_held_out_frames_cover_all_exposures():
    chosen = hold_out_every(100, 8, 4)
    assert np.diff(chosen).tolist() == [9] * (len(chosen) - 1)
    assert {k % 4 for k in chosen} == {0, 1, 2, 3}
    assert hold_out_every(100, 0, 3) == []
    assert 0 not in hold_out_every(9, 2, 1)
    assert 8 not in hold_out_every(9, 2, 1)


@pytest.mark.parametrize("every", range(2, 12))
@pytest.mark.parametrize("cycle", [1, 2, 3])
def test_the_spacing_of_held_out_frames_is_found_again(every: int, cycle: int) -> None:
    """For a clip of any length, the spacing found holds out the same frames."""
    for count in range(every + 2, 40):
        frames = hold_out_every(count, every, cycle)
        if frames:
            found = hold_out_spacing(frames)
            assert found is not None
            assert hold_out_every(frames[-1] + 2, found, cycle) == frames


def test_unevenly_spaced_frames_have_no_spacing() -> None:
    assert hold_out_spacing([0, 8]) is None
    assert hold_out_spacing([4, 8]) is None
    assert hold_out_spacing([1, 2, 4]) is None


@pytest.mark.parametrize("cycle", [1, 2, 3])
def test_the_spacing_that_is_advised_holds_something_out(cycle: int) -> None:
    for count in range(4, 12):
        every = widest_hold_out(count, cycle)
        assert every is not None and hold_out_every(count, every, cycle)
    assert hold_out_every(5, 8, 2) == [] and widest_hold_out(5, 2) == 7
    assert widest_hold_out(100, cycle) == 8 and widest_hold_out(2, cycle) is None
