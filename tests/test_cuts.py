"""Cuts between scenes, and what is none."""

import numpy as np
import pytest
from posed_clips import panning
from test_prepare_footage import work_on

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.cuts import find_cuts
from hdr_nsff.prepare.steps.footage import exposure_step

SLOW = panning(np.linspace(0, 4, 8))


def test_a_change_to_another_scene_is_a_cut():
    both = np.concatenate([SLOW, SLOW[:, ::-1, ::-1]])
    assert find_cuts(both) == [8]


def test_a_fast_pan_and_a_flash_are_no_cuts():
    flash = SLOW.copy()
    flash[4] = 1 - flash[4]
    assert find_cuts(panning(np.linspace(0, 60, 8))) == []
    assert find_cuts(flash) == []


def test_black_frames_hide_no_cut():
    black = np.full_like(SLOW[:2], 0.01)
    assert find_cuts(np.concatenate([SLOW, black, SLOW[:2, ::-1, ::-1]])) == [8]
    assert find_cuts(np.concatenate([black, SLOW[:4], black, SLOW[4:], black])) == []
    assert find_cuts(black) == []


def test_footage_with_a_cut_is_refused_in_one_sentence(tmp_path):
    work = work_on(tmp_path, np.concatenate([SLOW, SLOW[:, ::-1, ::-1]]))
    with pytest.raises(InputError, match=r"cuts between frames 7 and 8; .* `--end 8`"):
        exposure_step(work)
