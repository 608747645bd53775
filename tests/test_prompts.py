"""Prompts follow laws from motion masks: which objects, which frame, which points."""

import numpy as np
from masks_of_discs import HEIGHT, WIDTH, X, Y, disc, two_discs

from hdr_nsff.priors.masks.prompts import find_objects


def test_two_discs_are_two_objects_the_larger_first_each_in_its_clearest_frame():
    large, small = find_objects(two_discs())
    assert [large.number, small.number] == [1, 2]
    assert len(large.masks) == len(small.masks) == 9
    assert large.prompts[0].frame == 6
    assert all(mask[60:].sum() == 0 for mask in large.masks.values())


def test_points_on_an_object_lie_on_it_and_points_beside_it_on_nothing_that_moves():
    moving = two_discs()
    objects = find_objects(moving)
    assert len(objects) == 2
    for found in objects:
        (prompt,) = found.prompts
        columns, rows = np.floor(prompt.points).astype(int).T
        on, beside = prompt.labels == 1, prompt.labels == 0
        assert on.any() and beside.any()
        assert found.masks[prompt.frame][rows[on], columns[on]].all()
        assert not moving[prompt.frame, rows[beside], columns[beside]].any()


def test_the_box_encloses_its_object_tightly():
    objects = find_objects(two_discs())
    assert len(objects) == 2
    for found in objects:
        (prompt,) = found.prompts
        rows, columns = np.nonzero(found.masks[prompt.frame])
        left, top, right, bottom = prompt.box
        assert left <= columns.min() and right >= columns.max() + 1
        assert top <= rows.min() and bottom >= rows.max() + 1
        assert (right - left) * (bottom - top) < 1.3 * (np.ptp(rows) + 1) * (np.ptp(columns) + 1)


def test_the_first_point_is_the_middle_of_a_disc():
    (found,) = find_objects(np.stack([disc(40 + 3 * t, 40, 15) for t in range(4)]))
    prompt = found.prompts[0]
    assert np.linalg.norm(prompt.points[0] - [40 + 3 * prompt.frame, 40]) < 1.5


def test_a_frame_whose_outline_fits_its_neighbors_is_preferred_over_a_larger_ragged_one():
    """A spike makes frame 3 larger, but unlike the frames around it."""
    moving = np.stack([disc(40 + 2 * t, 40, 12) for t in range(7)])
    moving[3] |= (np.abs(X - 46) < 2) & (Y < 76)
    assert find_objects(moving)[0].prompts[0].frame not in (2, 3, 4)


def test_there_is_no_object_without_motion_or_in_two_frames_alone():
    moving = np.zeros((6, HEIGHT, WIDTH), bool)
    assert find_objects(moving) == []
    moving[2:4] |= disc(40, 40, 12)
    assert find_objects(moving) == []


def test_an_object_at_the_edge_of_the_frame_gets_its_points_inside_the_frame():
    (found,) = find_objects(np.stack([disc(2, 40 + t, 14) for t in range(3)]))
    prompt = found.prompts[0]
    assert (prompt.points >= 0).all() and (prompt.points <= [WIDTH, HEIGHT]).all()
    beside = prompt.points[prompt.labels == 0]
    assert len(beside) and (np.floor(beside[:, 0]) > 2).all()
