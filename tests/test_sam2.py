"""Prompts come from motion masks by laws; a tiny SAM 2 with random weights runs on
them; points of a file correct them.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_networks import tiny_sam2

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.masks import sam2
from hdr_nsff.priors.masks.prompts import (
    Mover,
    PointsFile,
    Prompt,
    as_file,
    corrected,
    movers,
    read_points,
)
from hdr_nsff.priors.pretrained import pretrained

HEIGHT, WIDTH = 80, 120
Y, X = np.indices((HEIGHT, WIDTH)) + 0.5


def disc(x: float, y: float, radius: float) -> np.ndarray:
    return np.hypot(X - x, Y - y) < radius


def clip_of_two(count: int = 9) -> np.ndarray:
    """A disc that grows until frame 6 while it moves right, and a smaller one that
    moves left below it.
    """
    return np.stack(
        [disc(30 + 4 * t, 25, 10 + min(t, 12 - t)) | disc(90 - 5 * t, 65, 8) for t in range(count)]
    )


def test_two_discs_are_two_things_the_larger_first_each_in_its_best_frame():
    large, small = movers(clip_of_two())
    assert [large.number, small.number] == [1, 2] and len(large.seen) == len(small.seen) == 9
    assert large.prompts[0].frame == 6
    assert all(mask[60:].sum() == 0 for mask in large.seen.values())


def test_points_on_a_thing_lie_on_it_and_points_beside_lie_on_nothing_that_moves():
    moving = clip_of_two()
    for mover in movers(moving):
        (prompt,) = mover.prompts
        at = np.floor(prompt.points).astype(int)
        assert (prompt.labels == 1).any() and (prompt.labels == 0).any()
        mask = mover.seen[prompt.frame]
        assert mask[at[prompt.labels == 1, 1], at[prompt.labels == 1, 0]].all()
        assert not moving[prompt.frame, at[prompt.labels == 0, 1], at[prompt.labels == 0, 0]].any()
        rows, columns = np.nonzero(mask)
        left, top, right, bottom = prompt.box
        assert (
            left <= columns.min()
            and right >= columns.max() + 1
            and top <= rows.min()
            and bottom >= rows.max() + 1
        )
        assert (right - left) * (bottom - top) < 1.3 * (np.ptp(rows) + 1) * (np.ptp(columns) + 1)


def test_the_first_point_is_the_middle_of_a_disc():
    (mover,) = movers(np.stack([disc(40 + 3 * t, 40, 15) for t in range(4)]))
    prompt = mover.prompts[0]
    assert np.linalg.norm(prompt.points[0] - [40 + 3 * prompt.frame, 40]) < 1.5


def test_a_frame_whose_outline_fits_its_neighbors_is_preferred_over_a_larger_ragged_one():
    moving = np.stack([disc(40 + 2 * t, 40, 12) for t in range(7)])
    moving[3] |= (np.abs(X - 46) < 2) & (
        Y < 76
    )  # a spike: larger, but nothing like the frames around it
    assert movers(moving)[0].prompts[0].frame not in (2, 3, 4)


def test_a_flash_of_two_frames_is_no_thing_and_nothing_moving_asks_nothing():
    moving = np.zeros((6, HEIGHT, WIDTH), bool)
    assert movers(moving) == []
    moving[2:4] |= disc(40, 40, 12)
    assert movers(moving) == []


def test_a_thing_at_the_edge_of_the_frame_gets_its_points_inside_the_frame():
    (mover,) = movers(np.stack([disc(2, 40 + t, 14) for t in range(3)]))
    points = mover.prompts[0].points
    assert (points >= 0).all() and (points <= [WIDTH, HEIGHT]).all()
    assert set(np.floor(points[mover.prompts[0].labels == 0][:, 0]) > 2) == {True}


def test_points_of_a_file_are_added_to_their_object_and_new_numbers_are_new_objects(tmp_path):
    found = movers(clip_of_two())
    text = {
        "points": [
            {"frame": 14, "object": 1, "x": 50.0, "y": 26.0, "label": 1},
            {"frame": 10, "object": 7, "x": 3.0, "y": 4.5, "label": 1},
        ]
    }
    (tmp_path / "points.json").write_text(json.dumps(text))
    given = read_points(tmp_path / "points.json", 19, (HEIGHT, WIDTH))
    first, second, new = corrected(found, given, range(10, 19))  # a clip that starts at frame 10
    assert [p.frame for p in first.prompts] == [4, 6] and first.prompts[0].points.tolist() == [
        [50, 26]
    ]
    assert second == found[1]
    assert new.number == 7 and new.prompts[0].frame == 0 and not new.seen
    assert corrected(found, given, range(20, 29)) == found  # another camera's frames


def test_what_is_written_of_the_prompts_reads_back_the_same(tmp_path):
    found = movers(clip_of_two())
    (tmp_path / "prompts.json").write_text(json.dumps(as_file(found, range(9))))
    again = corrected([], read_points(tmp_path / "prompts.json", 9, (HEIGHT, WIDTH)), range(9))
    for a, b in zip(found, again, strict=True):
        np.testing.assert_allclose(a.prompts[0].points, b.prompts[0].points, atol=0.01)
        np.testing.assert_allclose(a.prompts[0].box, b.prompts[0].box, atol=0.01)
        assert a.prompts[0].labels.tolist() == b.prompts[0].labels.tolist()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not a JSON"),
        ('{"points": [{"frame": 1, "object": 1, "x": 1.0, "y": 1.0}]}', "label"),
        ('{"points": [{"frame": 1, "object": 1, "x": 1.0, "y": 1.0, "label": 2}]}', "label"),
        ('{"points": [{"frame": 1, "object": 1, "x": 500.0, "y": 1.0, "label": 1}]}', "120x80"),
        ('{"points": [{"frame": 9, "object": 1, "x": 5.0, "y": 1.0, "label": 1}]}', "9 frames"),
        (
            '{"boxes": [{"frame": 1, "object": 1, "left": 5.0, "top": 1.0, "right": 4.0, "bottom": 3.0}]}',
            "empty",
        ),
    ],
)
def test_a_points_file_with_a_mistake_is_one_sentence(text: str, words: str, tmp_path):
    (tmp_path / "points.json").write_text(text)
    with pytest.raises(InputError, match=words):
        read_points(tmp_path / "points.json", 9, (HEIGHT, WIDTH))


def test_a_missing_points_file_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_points(tmp_path / "nowhere.json", 9, (HEIGHT, WIDTH))


def test_coordinates_scale_with_pixel_centers_kept():
    inputs = sam2.coordinates(
        np.array([[0.5, 0.5], [60, 40]]),
        np.array([1, 0]),
        np.array([0, 0, 120, 80]),
        (HEIGHT, WIDTH),
        240,
    )
    # a network that adds 0.5 sees 2 x the first in x and 3 x in y, the middle in the
    # middle, the box's corners at the corners
    assert (inputs["point_coords"][0, 0] + 0.5).tolist() == [
        [0, 0],
        [240, 240],
        [1, 1.5],
        [120, 120],
    ]
    assert inputs["point_labels"].tolist() == [[[2, 3, 1, 0]]]


class Oracle:
    """Stands for the network where only the combining of objects is looked at: outlines
    by object number.
    """

    def __init__(self, outlines: dict[int, np.ndarray]) -> None:
        self.outlines = outlines
        self.asked: list[int] = []

    def follow(self, network, video, mover):
        self.asked.append(mover.number)
        return self.outlines[mover.number]


def test_an_outline_of_something_else_leaves_the_motion_mask_and_says_so(monkeypatch, capsys):
    moving = clip_of_two()
    large, small = movers(moving)
    better = np.stack([disc(30 + 4 * t, 25, 11 + min(t, 12 - t)) for t in range(9)])
    oracle = Oracle({1: better, 2: np.ones_like(moving)})  # the second: the whole frame
    monkeypatch.setattr(sam2, "follow", oracle.follow)
    result = sam2.sam2_mask(None, np.zeros((*moving.shape, 3)), [large, small])
    below = np.indices(moving.shape)[1] > 50
    assert (result == np.where(below, moving, better)).all()
    assert "object 2" in capsys.readouterr().err


def test_what_is_covered_already_is_not_asked_about_again(monkeypatch):
    moving = clip_of_two()
    large, _ = movers(moving)
    oracle = Oracle({1: np.stack([large.seen[t] for t in range(9)])})
    monkeypatch.setattr(sam2, "follow", oracle.follow)
    sam2.sam2_mask(None, np.zeros((*moving.shape, 3)), [large, replace(large, number=2)])
    assert oracle.asked == [1]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A tiny SAM 2."""
    return tiny_sam2(tmp_path_factory.mktemp("sam2"))


def test_a_tiny_network_answers_in_every_frame_both_ways_and_hears_the_prompts(tiny):
    network = pretrained("Sam2VideoModel", str(tiny))
    video = np.random.default_rng(0).random((5, HEIGHT, WIDTH, 3)).astype(np.float32)
    seen: list[tuple[int, torch.Tensor]] = []
    network.register_forward_hook(
        lambda module, args, out: seen.append((out.frame_idx, out.pred_masks))
    )
    mover = Mover(
        1, (Prompt(2, np.array([[40.0, 40.0]]), np.array([1]), np.array([20.0, 20, 60, 60])),)
    )
    outlined = sam2.follow(network, video, mover)
    assert outlined.shape == (5, HEIGHT, WIDTH) and outlined.dtype == bool
    assert [frame for frame, _ in seen] == [2, 2, 3, 4, 2, 1, 0]
    there = replace(mover, prompts=(replace(mover.prompts[0], points=np.array([[100.0, 5.0]])),))
    sam2.follow(network, video, there)
    assert not torch.equal(seen[0][1], seen[7][1])  # another point, another answer


def test_the_clip_is_made_into_pictures_one_at_a_time():
    video = np.full((2, 40, 60, 3), [0.485, 0.456, 0.406], np.float32)
    pictures = sam2.Pictures(video, 32)
    assert len(pictures) == 2 and pictures[1].shape == (3, 32, 32)
    assert float(pictures[1].abs().max()) < 1e-5


def test_a_folder_of_another_network_is_refused_in_a_sentence(tiny, tmp_path):
    with pytest.raises(InputError, match="Dinov2Model"):
        pretrained("Dinov2Model", str(tiny))
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "model.safetensors").write_bytes(b"broken")
    with pytest.raises(InputError, match="Sam2VideoModel"):
        pretrained("Sam2VideoModel", str(tmp_path))


def test_an_empty_points_file_changes_nothing():
    found = movers(clip_of_two())
    assert corrected(found, PointsFile(), range(9)) == found
