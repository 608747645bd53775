"""The points file: merged into the prompts, read as written, mistakes in a sentence."""

import json

import numpy as np
import pytest
from masks_of_discs import HEIGHT, WIDTH, two_discs

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.masks.points_file import (
    PointsFile,
    merge_prompts,
    read_points,
    to_points_file,
)
from hdr_nsff.priors.masks.prompts import find_objects

SIZE = (HEIGHT, WIDTH)


def test_points_are_added_to_their_object_and_new_numbers_make_new_objects(tmp_path):
    """The clip starts at frame 10 of the scene."""
    found = find_objects(two_discs())
    points = [
        {"frame": 14, "object": 1, "x": 50.0, "y": 26.0, "label": 1},
        {"frame": 10, "object": 7, "x": 3.0, "y": 4.5, "label": 1},
    ]
    (tmp_path / "points.json").write_text(json.dumps({"points": points}))
    given = read_points(tmp_path / "points.json", 19, SIZE)
    first, second, new = merge_prompts(found, given, range(10, 19))
    assert [prompt.frame for prompt in first.prompts] == [4, 6]
    assert first.prompts[0].points.tolist() == [[50, 26]]
    assert second == found[1]
    assert new.number == 7 and new.prompts[0].frame == 0 and not new.masks
    assert merge_prompts(found, given, range(20, 29)) == found  # another camera's frames


def test_an_empty_points_file_changes_nothing():
    found = find_objects(two_discs())
    assert merge_prompts(found, PointsFile(), range(9)) == found


def test_prompts_that_are_written_read_back_the_same(tmp_path):
    found = find_objects(two_discs())
    path = tmp_path / "prompts.json"
    path.write_text(json.dumps(to_points_file(found, range(9))))
    again = merge_prompts([], read_points(path, 9, SIZE), range(9))
    for a, b in zip(found, again, strict=True):
        np.testing.assert_allclose(a.prompts[0].points, b.prompts[0].points, atol=0.01)
        np.testing.assert_allclose(a.prompts[0].box, b.prompts[0].box, atol=0.01)
        assert a.prompts[0].labels.tolist() == b.prompts[0].labels.tolist()


POINT = {"frame": 1, "object": 1, "x": 1.0, "y": 1.0, "label": 1}
BOX = {"frame": 1, "object": 1, "left": 5.0, "top": 1.0, "right": 6.0, "bottom": 3.0}


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        ({"points": [{k: v for k, v in POINT.items() if k != "label"}]}, "label"),
        ({"points": [POINT | {"label": 2}]}, "label"),
        ({"points": [POINT | {"x": 500.0}]}, "120x80"),
        ({"points": [POINT | {"frame": 9}]}, "9 frames"),
        ({"boxes": [BOX | {"right": 4.0}]}, "empty"),
        ({"boxes": [BOX | {"frame": 9}]}, "9 frames"),
        ({"boxes": [BOX | {"left": 120.0, "right": 130.0}]}, "120x80"),
    ],
)
def test_a_points_file_with_a_mistake_is_one_sentence(contents: dict, words: str, tmp_path):
    path = tmp_path / "points.json"
    path.write_text(json.dumps(contents))
    with pytest.raises(InputError, match=words):
        read_points(path, 9, SIZE)


def test_a_points_file_that_is_no_json_is_one_sentence(tmp_path):
    (tmp_path / "points.json").write_text("{")
    with pytest.raises(InputError, match="not a JSON"):
        read_points(tmp_path / "points.json", 9, SIZE)


def test_a_missing_points_file_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_points(tmp_path / "nowhere.json", 9, SIZE)
