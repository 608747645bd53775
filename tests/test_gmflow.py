"""GMFlow: its parts against plain loops and closed forms, both directions in one pass,
and the published weights where they are found.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors import weights
from hdr_nsff.priors.flow import gmflow
from hdr_nsff.priors.flow.gmflow import GMFlow
from hdr_nsff.priors.flow.networks import load_network, predict_both_directions

rng = torch.Generator().manual_seed(0)


def small() -> GMFlow:
    """A tiny random network."""
    torch.manual_seed(0)
    return GMFlow(channels=16, blocks=2).eval()


def images(count: int = 2, height: int = 32, width: int = 64) -> torch.Tensor:
    """Random images (count, 3, H, W)."""
    return torch.rand(count, 3, height, width, generator=torch.Generator().manual_seed(1))


@torch.no_grad()
def test_swapping_the_images_swaps_the_flows():
    pair = images()
    assert torch.allclose(small()(pair), small()(pair.flip(0)).flip(0), atol=1e-4)


@torch.no_grad()
def test_pairs_of_a_batch_do_not_see_each_other():
    a, b = images(), 1 - images().flip(-1)
    together = small()(torch.stack([a[0], b[0], a[1], b[1]]))
    assert torch.allclose(together[[0, 2]], small()(a), atol=1e-4)
    assert torch.allclose(together[[1, 3]], small()(b), atol=1e-4)


def test_the_global_match_is_the_most_similar_position():
    """Each feature occurs once, at a length of 20: the softmax picks its position."""
    marks = torch.eye(24).view(1, 24, 4, 6) * 20
    moved = marks.roll((1, 2), (2, 3))  # row y goes to y + 1, column x to x + 2, around the edge
    flow = gmflow.match_globally(torch.cat([marks, moved]))
    assert torch.allclose(flow[0, :, 0, 0], torch.tensor([2.0, 1.0]), atol=1e-3)
    assert torch.allclose(flow[1, :, 1, 2], torch.tensor([-2.0, -1.0]), atol=1e-3)


def test_the_local_match_equals_a_loop_over_positions():
    own, other = torch.rand(2, 1, 8, 5, 6, generator=rng)
    found = gmflow.match_locally(own, other, 1)
    y, x = 0, 5  # a corner: four positions are inside the image
    near = [(v, u) for v in (0, 1) for u in (4, 5)]
    similarity = torch.stack(
        [(own[0, :, y, x] * other[0, :, v, u]).sum() / 8**0.5 for v, u in near]
    )
    expected = (
        torch.softmax(similarity, 0) @ torch.tensor([[u - x, v - y] for v, u in near]).float()
    )
    assert torch.allclose(found[0, :, y, x], expected, atol=1e-6)


def test_merging_windows_undoes_splitting():
    tokens = torch.rand(2, 4, 8, 3, generator=rng)
    split = gmflow.split_windows(tokens, 2)
    assert torch.equal(split[1, 1], tokens[1, :2, 4:].reshape(8, 3))  # second window: top right
    assert torch.equal(gmflow.merge_windows(split, tokens.shape, 2), tokens)


def test_shifted_windows_do_not_join_opposite_edges():
    """Four tokens in two windows, shifted by one: 1 2 | 3 0, where 3 and 0 are the two
    ends of the image.
    """
    allowed = gmflow.shifted_window_mask((2, 4), (0, 1), 2, torch.device("cpu"))  # windows of 1 x 2
    assert allowed[0].all() and torch.equal(allowed[1], torch.eye(2, dtype=torch.bool))


def test_the_position_encoding_repeats_in_every_window():
    field = gmflow.position_encoding(torch.zeros(1, 16, 8, 12), 2)
    assert torch.equal(field[:, :4, :6], field[:, 4:, 6:])
    last_row = field[0, 3, 0].item()
    assert last_row == pytest.approx(0, abs=1e-6)  # sin(2 pi)
    assert torch.equal(field[:8, :, 0], field[:8, :, 5])  # the first half is of y alone


@torch.no_grad()
def test_a_convex_combination_of_one_flow_is_that_flow():
    network = small()
    flow = torch.full((1, 2, 6, 8), 1.5)
    large = network.upsample_convex(flow, torch.rand(1, 16, 6, 8, generator=rng))
    assert large.shape == (1, 2, 24, 32)
    expected = torch.full((1, 2, 16, 24), 6.0)  # four times the pixels
    assert torch.allclose(large[..., 4:-4, 4:-4], expected, atol=1e-5)


def test_reading_features_through_a_flow_shifts_them():
    field = torch.rand(1, 3, 6, 8, generator=rng)
    flow = torch.tensor([2.0, -1.0]).view(1, 2, 1, 1).expand(1, 2, 6, 8)
    there = gmflow.warp(field, flow)
    assert torch.allclose(there[..., 1:, :-2], field[..., :-1, 2:], atol=1e-5)
    assert there[..., 0, :].abs().max() < 1e-6


def test_every_prediction_trains_the_stage_that_made_it():
    """The first prediction trains the encoder alone, the last also the upsampler."""
    network = small()
    first, *_, last = network.predictions(images())
    first.sum().backward(retain_graph=True)
    assert network.backbone.conv1.weight.grad is not None
    assert network.upsampler[0].weight.grad is None
    last.square().sum().backward()
    assert network.upsampler[0].weight.grad is not None


def published() -> Path:
    """The published weights, or a skip that names the places searched."""
    try:
        return weights.find("gmflow", download=False)
    except InputError as error:
        pytest.skip(str(error))


def test_published_weights_follow_a_sliding_texture_when_it_darkens():
    network = load_network("gmflow", published())
    noise = np.random.default_rng(0).random((168, 232, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 2)
    texture = (noise - noise.min()) / np.ptp(noise)
    a, b = texture[20:-20, 20:-20], texture[23:-17, 15:-25]  # (x, y) moves to (x + 5, y - 3)
    there, back = predict_both_directions(
        network, a, (b / 4) ** 2
    )  # darker by two stops, and another curve
    assert np.median(np.abs(there[8:-8, 8:-8] - [5, -3])) < 0.3
    assert np.median(np.abs(back[8:-8, 8:-8] - [-5, 3])) < 0.3


def test_sizes_that_do_not_divide_into_windows_are_refused():
    with pytest.raises(AssertionError, match="images"):
        small()(torch.zeros(2, 3, 32, 40))


def test_normalization_is_that_of_the_encoder():
    gray = gmflow.normalize_images(torch.full((1, 3, 1, 1), 0.485))
    assert gray[0, 0].item() == pytest.approx(0)
    assert gray[0, 1].item() == pytest.approx((0.485 - 0.456) / 0.224)
