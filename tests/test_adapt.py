"""Features fitted to a clip: each loss by hand, no gradient to frozen features, and
training lowers its losses.
"""

import cv2
import numpy as np
import pytest
import torch

from hdr_nsff.priors.flow.adapt import (
    ADAPT_TUNING,
    ResidualNetwork,
    Track,
    TrainingClip,
    adapt_features,
    best_buddies,
    buddies_loss,
    build_refiner,
    cell_colors,
    closeness_loss,
    cycle_loss,
    trajectory_loss,
    with_published_network,
)
from hdr_nsff.priors.flow.correlation import Search, cell_positions
from hdr_nsff.priors.flow.features import Features


def sliding(frames: int = 3, step: int = 4, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """A texture (frames, H, W, 3) that slides to the right, `step` pixels per frame."""
    height, width = size
    noise = np.random.default_rng(0).random((height, width + step * frames, 3))
    wide = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), 2)
    wide = (wide - wide.min()) / np.ptp(wide)
    starts = [step * (frames - t) for t in range(frames)]
    return np.stack([wide[:, start : start + width] for start in starts])


def training_clip() -> TrainingClip:
    """A clip whose features are its colors with noise, which slides one cell per frame,
    with a track from the first frame to the third.
    """
    video = sliding()
    grid = Features(torch.zeros(3, 1, 12, 16), 4.0, 2.0)
    maps = cell_colors(video, grid, 2) - 0.5
    noise = 0.2 * torch.randn(maps.shape, generator=torch.Generator().manual_seed(0))
    positions = cell_positions(12, 16)
    inner = positions[(positions[:, 0] > 2) & (positions[:, 0] < 12)]
    tracks = [Track((0, 2), inner, inner + torch.tensor([2.0, 0.0]))]
    features = Features(maps + noise, 4.0, 2.0)
    search = Search(reach=5, radius=1, temperature=0.05)
    return TrainingClip(features, video, tracks, [(0, 1), (1, 2)], search)


def test_the_network_starts_as_the_identity():
    maps = torch.randn(2, 5, 6, 7)
    colors = torch.rand(2, 3 * ADAPT_TUNING.colors_per_cell**2, 6, 7)
    assert torch.equal(ResidualNetwork(5, 2.0)(maps, colors), maps)


def test_the_published_network_has_its_size_and_starts_as_the_identity():
    tuning = with_published_network(ADAPT_TUNING)
    network = build_refiner(1024, 2.0, tuning)
    weights = [layer.weight for layer in network.layers]
    assert [w.shape[0] for w in weights] == [64, 128, 256, 1024]
    assert {tuple(w.shape[2:]) for w in weights} == {(5, 5)}
    maps, colors = torch.randn(1, 1024, 4, 5), torch.rand(1, 3 * 8**2, 4, 5)
    assert torch.equal(network(maps, colors), maps)


def test_the_published_network_keeps_cells_in_place():
    """Colors of one cell change the features around it alone: within four cells."""
    torch.manual_seed(0)
    network = build_refiner(6, 1.0, with_published_network(ADAPT_TUNING))
    torch.nn.init.normal_(network.layers[-1].weight)
    maps, colors = torch.zeros(1, 6, 13, 15), torch.full((1, 3 * 8**2, 13, 15), 0.5)
    changed = colors.clone()
    changed[:, :, 6, 8] = 1.0
    difference = (network(maps, changed) - network(maps, colors)).abs().sum(1)[0]
    center = (cell_positions(13, 15) * difference.reshape(-1, 1)).sum(0) / difference.sum()
    assert center.tolist() == pytest.approx([8, 6], abs=0.3)
    assert float(difference[0].max()) == 0 and float(difference[6, 8]) > 0


def test_colors_are_read_at_the_centers_of_cells():
    """A ramp of value x (pixel centers): with cells of 4 pixels whose first center is
    at 2, cell k sees 4 k + 2.
    """
    row = (np.arange(32) + 0.5)[None, None, :, None] / 32
    ramp = np.broadcast_to(row, (1, 16, 32, 3)).astype(np.float32)
    colors = cell_colors(ramp, Features(torch.zeros(1, 1, 4, 8), 4.0, 2.0), 1)
    assert colors.shape == (1, 3, 4, 8)
    assert np.allclose(colors[0, 0, 1, 2:6] * 32, [10, 14, 18, 22], atol=0.05)


def test_best_buddies_are_mutual():
    a, b = torch.randn(8, 5, 6), torch.randn(8, 5, 6)
    cells_of_a, cells_of_b = best_buddies(a, b, 9)
    reverse_of_b, reverse_of_a = best_buddies(b, a, 9)
    pairs = set(zip(cells_of_a.tolist(), cells_of_b.tolist(), strict=True))
    assert pairs == set(zip(reverse_of_a.tolist(), reverse_of_b.tolist(), strict=True))
    assert 0 < len(pairs) < 30


def test_buddies_do_not_push_their_neighbors_away():
    """A distant cell with the query's features costs; one near the buddy does not."""
    target, query = torch.zeros(2, 5, 6), torch.tensor([[1.0, 0.0]])
    target[1], target[:, 2, 2] = 1, torch.tensor([1.0, 0.0])
    buddy = torch.tensor([2 * 6 + 2])
    before = buddies_loss(query, target, buddy, 0.1)
    adjacent, distant = target.clone(), target.clone()
    adjacent[:, 2, 3], distant[:, 2, 5] = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 0.0])
    assert torch.allclose(buddies_loss(query, adjacent, buddy, 0.1), before)
    # two cells that fit equally well: about log 2
    assert buddies_loss(query, distant, buddy, 0.1) > before + 0.5


def test_small_errors_count_as_squares_and_lost_points_not_at_all():
    """Huber with 0.5: 0.5 * 0.3^2 = 0.045; 0.5 * (1 - 0.25) = 0.375."""
    end = torch.zeros(3, 2)
    found = torch.tensor([[0.3, 0.0], [0.0, 1.0], [5.0, 0.0]])
    assert torch.allclose(trajectory_loss(found, end), torch.tensor([0.045, 0.375, 0.0]))
    assert torch.allclose(cycle_loss(end, found), trajectory_loss(found, end))


def test_closeness_counts_angle_and_length():
    """Twice the length: (2 - 1)^2 = 1; a right angle: 1."""
    original = torch.tensor([1.0, 0.0]).view(1, 2, 1, 1)
    assert closeness_loss(2 * original, original).item() == pytest.approx(1)
    assert closeness_loss(original.flip(1), original).item() == pytest.approx(1)


def test_frozen_features_get_no_gradient_and_every_loss_reaches_the_network():
    clip = training_clip()
    network = ResidualNetwork(clip.maps.shape[1], clip.feature_norm)
    weight = network.outer.weight
    torch.nn.init.normal_(weight, std=0.01)
    for name, loss in clip.losses(network, np.random.default_rng(0)).items():
        network.zero_grad()
        loss.backward(retain_graph=True)
        assert weight.grad is not None and weight.grad.abs().sum() > 0, name
    assert not clip.maps.requires_grad


def mean_losses(maps: torch.Tensor) -> dict[str, float]:
    """The losses of features as they are, the mean of many draws."""
    clip = training_clip()
    clip.maps = maps
    network = ResidualNetwork(maps.shape[1], clip.feature_norm)
    rng = np.random.default_rng(7)
    with torch.no_grad():
        draws = [clip.losses(network, rng) for _ in range(30)]
    return {name: float(np.mean([d[name] for d in draws])) for name in draws[0]}


def test_training_lowers_its_losses_and_repeats_itself():
    clip = training_clip()
    frozen = clip.maps.clone()
    refined = adapt_features(clip, 80, 0)
    assert torch.equal(clip.maps, frozen)
    before, after = mean_losses(frozen), mean_losses(refined)
    assert after["trajectory"] < 0.9 * before["trajectory"]
    assert after["buddies"] < before["buddies"]
    assert torch.equal(adapt_features(training_clip(), 80, 0), refined)
