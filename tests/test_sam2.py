"""Masks by SAM 2: outlines of objects are combined, and a tiny network with random
weights gets the prompts that are meant.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from masks_of_discs import HEIGHT, WIDTH, disc, two_discs
from tiny_networks import tiny_sam2

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.masks import sam2
from hdr_nsff.priors.masks.prompts import Prompt, PromptedObject, find_objects
from hdr_nsff.priors.pretrained import pretrained


def test_coordinates_scale_with_pixel_centers_kept():
    """A network that adds 0.5 sees the corners of the box at its corners, the first
    point at 2 x its x and 3 x its y, and the middle in the middle.
    """
    inputs = sam2.prompt_inputs(
        np.array([[0.5, 0.5], [60, 40]]),
        np.array([1, 0]),
        np.array([0, 0, 120, 80]),
        (HEIGHT, WIDTH),
        240,
    )
    coordinates = (inputs["point_coords"][0, 0] + 0.5).tolist()
    assert coordinates == [[0, 0], [240, 240], [1, 1.5], [120, 120]]
    assert inputs["point_labels"].tolist() == [[[2, 3, 1, 0]]]


class Oracle:
    """Replaces the network by known outlines of each object number."""

    def __init__(self, outlines: dict[int, np.ndarray]) -> None:
        self.outlines = outlines
        self.numbers: list[int] = []

    def track_object(self, network, video, prompted):
        self.numbers.append(prompted.number)
        return self.outlines[prompted.number]


def test_an_outline_of_another_object_keeps_the_motion_mask_and_is_reported(monkeypatch, capsys):
    """The network outlines the second object as the whole frame."""
    moving = two_discs()
    large, small = find_objects(moving)
    better = np.stack([disc(30 + 4 * t, 25, 11 + min(t, 12 - t)) for t in range(9)])
    oracle = Oracle({1: better, 2: np.ones_like(moving)})
    monkeypatch.setattr(sam2, "track_object", oracle.track_object)
    result = sam2.sam2_mask(None, np.zeros((*moving.shape, 3)), [large, small])
    below = np.indices(moving.shape)[1] > 50
    assert (result == np.where(below, moving, better)).all()
    assert "object 2" in capsys.readouterr().err


def test_an_object_that_others_cover_is_skipped(monkeypatch):
    moving = two_discs()
    large, _ = find_objects(moving)
    oracle = Oracle({1: np.stack([large.masks[t] for t in range(9)])})
    monkeypatch.setattr(sam2, "track_object", oracle.track_object)
    sam2.sam2_mask(None, np.zeros((*moving.shape, 3)), [large, replace(large, number=2)])
    assert oracle.numbers == [1]


def test_a_user_may_prompt_an_object_in_a_frame_before_its_motion_mask(monkeypatch):
    """Then there is no motion mask to compare the outline with."""
    moving = two_discs()
    large, _ = find_objects(moving)
    del large.masks[0]
    early = Prompt(0, np.array([[30.0, 25.0]]), np.array([1]))
    prompted = replace(large, prompts=(early, *large.prompts))
    oracle = Oracle({1: moving})
    monkeypatch.setattr(sam2, "track_object", oracle.track_object)
    assert (sam2.sam2_mask(None, np.zeros((*moving.shape, 3)), [prompted]) == moving).all()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A tiny SAM 2."""
    return tiny_sam2(tmp_path_factory.mktemp("sam2"))


def test_a_tiny_network_outlines_every_frame_both_ways_from_its_prompts(tiny):
    network = pretrained("Sam2VideoModel", str(tiny))
    video = np.random.default_rng(0).random((5, HEIGHT, WIDTH, 3)).astype(np.float32)
    outputs: list[tuple[int, torch.Tensor]] = []
    network.register_forward_hook(
        lambda module, args, out: outputs.append((out.frame_idx, out.pred_masks))
    )
    box = np.array([20.0, 20, 60, 60])
    prompt = Prompt(2, np.array([[40.0, 40.0]]), np.array([1]), box)
    outline = sam2.track_object(network, video, PromptedObject(1, (prompt,)))
    assert outline.shape == (5, HEIGHT, WIDTH) and outline.dtype == bool
    assert [frame for frame, _ in outputs] == [2, 2, 3, 4, 2, 1, 0]
    elsewhere = replace(prompt, points=np.array([[100.0, 5.0]]))
    sam2.track_object(network, video, PromptedObject(1, (elsewhere,)))
    assert not torch.equal(outputs[0][1], outputs[7][1])  # another point, another outline


def test_the_clip_is_resized_one_frame_at_a_time():
    video = np.full((2, 40, 60, 3), [0.485, 0.456, 0.406], np.float32)
    frames = sam2.ResizedFrames(video, 32)
    assert len(frames) == 2 and frames[1].shape == (3, 32, 32)
    assert float(frames[1].abs().max()) < 1e-5


def test_a_folder_of_another_network_is_refused_in_a_sentence(tiny, tmp_path):
    with pytest.raises(InputError, match="Dinov2Model"):
        pretrained("Dinov2Model", str(tiny))
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "model.safetensors").write_bytes(b"broken")
    with pytest.raises(InputError, match="Sam2VideoModel"):
        pretrained("Sam2VideoModel", str(tmp_path))
