"""Features fitted to a clip: each term by hand, no gradient to what is frozen, and
training lowers what it is to lower.
"""

import cv2
import numpy as np
import pytest
import torch

from hdr_nsff.priors.flow.adapt import (
    DETAIL,
    AdaptWeights,
    Lesson,
    Matching,
    Residual,
    Track,
    adapt,
    best_buddies,
    buddies_term,
    colors,
    cycle_term,
    near_term,
    trajectory_term,
)
from hdr_nsff.priors.flow.correlation import cells
from hdr_nsff.priors.flow.features import Features


def sliding(frames: int = 3, step: int = 4, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """A texture (frames, H, W, 3) that slides to the right by `step` pixels per frame."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(
        rng.random((size[0], size[1] + step * frames, 3)).astype(np.float32), (0, 0), 2
    )
    wide = (wide - wide.min()) / np.ptp(wide)
    return np.stack(
        [wide[:, step * (frames - t) : step * (frames - t) + size[1]] for t in range(frames)]
    )


def lesson() -> Lesson:
    """A clip whose features are its colors with noise, slides one cell per frame, and
    is followed from the first frame to the third.
    """
    video = sliding()
    bare = Features(torch.zeros(3, 1, 12, 16), 4.0, 2.0)
    maps = colors(video, bare, 2) - 0.5
    noise = 0.2 * torch.randn(maps.shape, generator=torch.Generator().manual_seed(0))
    place = cells(12, 16)
    inner = place[(place[:, 0] > 2) & (place[:, 0] < 12)]
    tracks = [Track((0, 2), inner, inner + torch.tensor([2.0, 0.0]))]
    return Lesson(
        Features(maps + noise, 4.0, 2.0), video, tracks, [(0, 1), (1, 2)], Matching(reach=5)
    )


def test_the_network_starts_as_the_identity():
    maps, detail = torch.randn(2, 5, 6, 7), torch.rand(2, 3 * DETAIL**2, 6, 7)
    assert torch.equal(Residual(5, 2.0)(maps, detail), maps)


def test_a_cells_colors_are_read_where_it_looks():
    """A ramp of value x (pixel centers): with cells of 4 pixels whose first middle is
    at 2, cell k sees 4 k + 2.
    """
    ramp = np.broadcast_to((np.arange(32) + 0.5)[None, None, :, None] / 32, (1, 16, 32, 3)).astype(
        np.float32
    )
    seen = colors(ramp, Features(torch.zeros(1, 1, 4, 8), 4.0, 2.0), 1)
    assert seen.shape == (1, 3, 4, 8)
    assert np.allclose(seen[0, 0, 1, 2:6] * 32, [10, 14, 18, 22], atol=0.05)


def test_best_buddies_are_each_others():
    a, b = torch.randn(8, 5, 6), torch.randn(8, 5, 6)
    there, back = best_buddies(a, b, 9), best_buddies(b, a, 9)
    assert {(int(i), int(j)) for i, j in zip(*there, strict=True)} == {
        (int(j), int(i)) for i, j in zip(*back, strict=True)
    }
    assert 0 < len(there[0]) < 30


def test_buddies_do_not_push_their_neighbors_away():
    """With features that only one far cell shares, making that cell alike costs; making
    a cell beside the buddy alike does not.
    """
    target, query = torch.zeros(2, 5, 6), torch.tensor([[1.0, 0.0]])
    target[1], target[:, 2, 2] = 1, torch.tensor([1.0, 0.0])
    buddy = torch.tensor([2 * 6 + 2])
    before = buddies_term(query, target, buddy, 0.1)
    beside, far = target.clone(), target.clone()
    beside[:, 2, 3], far[:, 2, 5] = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 0.0])
    assert torch.allclose(buddies_term(query, beside, buddy, 0.1), before)
    assert buddies_term(query, far, buddy, 0.1) > before + 0.5  # two that fit as well: about log 2


def test_small_errors_count_as_squares_and_lost_points_not_at_all():
    """Huber with 0.5: 0.5 * 0.3^2 = 0.045; 0.5 * (1 - 0.25) = 0.375."""
    end = torch.zeros(3, 2)
    found = torch.tensor([[0.3, 0.0], [0.0, 1.0], [5.0, 0.0]])
    assert torch.allclose(trajectory_term(found, end), torch.tensor([0.045, 0.375, 0.0]))
    assert torch.allclose(cycle_term(end, found), trajectory_term(found, end))


def test_nearness_counts_angle_and_length():
    """Twice the length: (2 - 1)^2 = 1; a right angle: 1."""
    original = torch.tensor([1.0, 0.0]).view(1, 2, 1, 1)
    assert near_term(2 * original, original).item() == pytest.approx(1)
    assert near_term(original.flip(1), original).item() == pytest.approx(1)


def test_frozen_features_get_no_gradient_and_every_term_reaches_the_network():
    clip = lesson()
    network = Residual(clip.maps.shape[1], clip.size)
    torch.nn.init.normal_(network.outer.weight, std=0.01)
    for name, term in clip.terms(network, np.random.default_rng(0)).items():
        network.zero_grad()
        term.backward(retain_graph=True)
        assert (
            network.outer.weight.grad is not None and network.outer.weight.grad.abs().sum() > 0
        ), name
    assert not clip.maps.requires_grad


def measured(maps: torch.Tensor) -> dict[str, float]:
    """The terms of features as they are, the mean of many draws."""
    clip = lesson()
    clip.maps = maps
    network, rng = Residual(maps.shape[1], clip.size), np.random.default_rng(7)
    with torch.no_grad():
        draws = [clip.terms(network, rng) for _ in range(30)]
    return {name: float(np.mean([d[name] for d in draws])) for name in draws[0]}


def test_training_lowers_what_it_is_to_lower_and_repeats_itself():
    clip = lesson()
    frozen = clip.maps.clone()
    refined = adapt(clip, 80, 0, AdaptWeights())
    assert torch.equal(clip.maps, frozen)
    before, after = measured(frozen), measured(refined)
    assert after["trajectory"] < 0.9 * before["trajectory"]
    assert after["buddies"] < before["buddies"]
    assert torch.equal(adapt(lesson(), 80, 0, AdaptWeights()), refined)
