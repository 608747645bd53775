"""Clips of cameras that take the frames in turn, and clips of one camera."""

import numpy as np
import pytest
from posed_clips import PLACES, panning, sliding
from test_prepare_footage import work_on

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.turns import TurnsTuning, find_cameras_in_turn, is_period
from hdr_nsff.prepare.prepare import prepare
from hdr_nsff.prepare.steps.footage import exposure_step
from hdr_nsff.prepare.work import PrepareConfig

CAMERAS = sliding(PLACES[::2])  # four of them


def in_turn(visits: int) -> np.ndarray:
    """The cameras' pictures, one after the other, with noise."""
    video = np.concatenate([CAMERAS] * visits)
    noise = np.random.default_rng(0).normal(0, 0.02, video.shape)
    return np.clip(video + noise, 0, 1).astype(np.float32)


def test_cameras_in_turn_are_counted():
    assert find_cameras_in_turn(in_turn(3)) == 4
    assert find_cameras_in_turn(in_turn(2)) == 4


def test_one_visit_of_each_camera_shows_no_turns():
    assert find_cameras_in_turn(in_turn(1)) == 1


def test_a_tripod_is_no_rig():
    assert find_cameras_in_turn(np.stack([CAMERAS[0]] * 12)) == 1


def test_a_pan_there_and_back_is_no_rig():
    there = np.linspace(0, 8, 6)
    assert find_cameras_in_turn(panning(np.concatenate([there, there[::-1]] * 2))) == 1


def test_a_period_is_alike_at_its_multiples_alone():
    alike = {1: 0.2, 2: 0.1, 3: 0.8, 4: 0.2, 5: 0.1, 6: 0.8}
    assert is_period(alike, 3)
    assert not is_period({**alike, 6: 0.1}, 3)
    assert not is_period({**alike, 1: TurnsTuning().max_other}, 3)


def test_the_scene_knows_its_rig_and_the_camera_of_each_frame(tmp_path):
    work = work_on(tmp_path, in_turn(3), hold_out=0)
    assert exposure_step(work).note.startswith("4 cameras in turn, no alternation")
    assert work.manifest.rig == 4
    assert work.manifest.places == [0, 1, 2, 3] * 3


def test_the_user_may_say_that_there_is_no_rig(tmp_path):
    work = work_on(tmp_path, in_turn(3), rig=1)
    exposure_step(work)
    assert work.manifest.rig == 1


def test_a_rig_of_more_cameras_than_frames_show_twice_is_refused(tmp_path):
    work = work_on(tmp_path, in_turn(2), rig=5)
    with pytest.raises(InputError, match="only 8 frames; each camera needs at least two"):
        exposure_step(work)


def test_numbers_of_a_lens_are_refused_for_cameras_in_turn(tmp_path):
    refused = "-0.3,0.05: 4 cameras take the frames in turn, and numbers"
    given = PrepareConfig(tmp_path, tmp_path / "scene", rig=4, lens_distortion="-0.3,0.05")
    with pytest.raises(InputError, match=refused):
        prepare(given)
    assert not given.out.exists()
    work = work_on(tmp_path / "found", in_turn(3), lens_distortion="-0.3,0.05")
    with pytest.raises(InputError, match=refused):
        exposure_step(work)
