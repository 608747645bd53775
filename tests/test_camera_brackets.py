"""Brackets of synchronized cameras, on clips made as for the exposure cycle."""

import itertools

import pytest
from test_exposure_cycle import clip

from hdr_nsff.radiometry.camera_brackets import common_brackets, exposure_groups
from hdr_nsff.radiometry.exposure_cycle import detect_cycle


def test_cameras_of_a_rig_that_start_elsewhere_in_the_cycle_share_brackets():
    a, b = detect_cycle(clip([-2, 0, 2])), detect_cycle(clip([0, 2, -2]))
    first, second = common_brackets([a, b], [0, 0])
    assert first[:3] == [0, 1, 2]
    assert second[:3] == [1, 2, 0]


def test_cameras_share_the_brackets_of_a_cycle_that_rises_and_falls():
    a, b = detect_cycle(clip([-2, 0, 2, 0])), detect_cycle(clip([0, 2, 0, -2]))
    assert [brackets[:4] for brackets in common_brackets([a, b], [0, 0])] == [
        [0, 1, 2, 1],
        [1, 2, 1, 0],
    ]


@pytest.mark.parametrize(
    ("exposures", "groups"),
    [
        ([[0], [-2], [2], [0]], [0, 1, 2, 0]),
        ([[-2, 0, 2], [0, 2, -2]], [0, 0]),
        ([[-2, 0, 2], [0, 2, 4], [2, -2, 0]], [0, 1, 0]),
        ([[-2, 0, 2], [0]], [0, 0]),
    ],
)
def test_cameras_with_their_own_exposures_get_their_own_brackets(exposures, groups):
    videos = [clip(ev, seed=k) for k, ev in enumerate(exposures)]
    cycles = [detect_cycle(video) for video in videos]
    found = exposure_groups(videos, cycles)
    assert found == groups
    brackets = [set(own) for own in common_brackets(cycles, found)]
    for i, j in itertools.combinations(range(len(videos)), 2):
        assert (brackets[i] == brackets[j]) == (groups[i] == groups[j])


def test_a_camera_without_a_cycle_takes_that_of_the_others():
    a, b = detect_cycle(clip([-2, 0, 2, 0])), detect_cycle(clip([0]))
    assert [brackets[:5] for brackets in common_brackets([a, a, b], [0, 0, 0])] == [
        [0, 1, 2, 1, 0]
    ] * 3
