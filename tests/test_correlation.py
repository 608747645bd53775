"""Cosine cost volumes and their soft-argmax: a known shift is found to a fraction of a
cell.
"""

import numpy as np
import pytest
import torch

from hdr_nsff.priors.flow.correlation import (
    Search,
    cell_positions,
    feature_motion,
    locate,
    sample_features,
    soft_argmax,
)


def shifted(
    dx: float, dy: float, size: tuple[int, int] = (20, 28), channels: int = 48
) -> torch.Tensor:
    """Smooth random features (channels, h, w), shifted by (dx, dy) cells without any
    interpolation (by phase), periodic.
    """
    rng = np.random.default_rng(0)
    fy, fx = np.fft.fftfreq(size[0])[:, None], np.fft.fftfreq(size[1])
    low = np.exp(-((fx**2 + fy**2) * (2 * np.pi * 1.0) ** 2) / 2)  # a blur of one cell
    phase = np.exp(-2j * np.pi * (fx * dx + fy * dy))
    spectrum = np.fft.fft2(rng.normal(size=(channels, *size))) * low * phase
    return torch.from_numpy(np.fft.ifft2(spectrum).real.astype(np.float32))


@pytest.mark.parametrize(
    ("dx", "dy"), [(0.0, 0.0), (2.0, -1.0), (0.5, 0.0), (1.3, -0.7), (-2.25, 1.5)]
)
def test_a_shift_is_found_to_a_twentieth_of_a_cell(dx: float, dy: float):
    search = Search(reach=5, radius=3, temperature=0.12)
    found = feature_motion(shifted(0, 0), shifted(dx, dy), search)[5:-5, 5:-5]
    assert (found.mean((0, 1)) - torch.tensor([dx, dy])).abs().max() < 0.05


def test_the_maximum_of_a_parabola_is_found():
    """softmax(similarity / temperature) of a parabola is a Gaussian, whose mean is the
    parabola's top.
    """
    positions, top = cell_positions(15, 15), torch.tensor([7.3, 6.6])
    similarity = 1 - 0.02 * ((positions - top) ** 2).sum(-1)[None]
    found = soft_argmax(similarity.view(1, 15, 15), radius=5, temperature=0.04)[0]
    assert torch.allclose(found, top, atol=1e-3)


def test_no_match_lies_beyond_the_search_range():
    search = Search(reach=3, radius=0, temperature=0.03)
    found = feature_motion(shifted(0, 0), shifted(6, 0), search)
    assert found.abs().max() <= 3


def test_sampling_at_a_cell_gives_the_cell_and_between_two_their_mean():
    maps = torch.rand(4, 5, 6)
    found = sample_features(maps, torch.tensor([[2.0, 3.0], [2.5, 3.0]]))
    assert torch.allclose(found[0], maps[:, 3, 2], atol=1e-5)
    assert torch.allclose(found[1], (maps[:, 3, 2] + maps[:, 3, 3]) / 2, atol=1e-5)


def test_positions_carry_a_gradient_to_the_features():
    a = shifted(0, 0).requires_grad_()
    start = torch.tensor([[8.0, 9.0]])
    found = locate(sample_features(a, start), start, shifted(0.4, 0), Search(4, 2, 0.05))
    found.sum().backward()
    assert a.grad is not None and a.grad.abs().sum() > 0


def test_chunks_do_not_change_the_result(monkeypatch):
    a, b, search = shifted(0, 0), shifted(1.5, 0.5), Search(4, 2, 0.05)
    whole = feature_motion(a, b, search)
    monkeypatch.setattr("hdr_nsff.priors.flow.correlation.CHUNK", 37)
    assert torch.allclose(feature_motion(a, b, search), whole, atol=1e-5)


def test_positions_are_those_of_a_search_cell_by_cell():
    a, b, search = shifted(0, 0), shifted(1.3, -0.6), Search(reach=2.5, radius=1, temperature=0.05)
    starts = torch.tensor([[0.0, 0.0], [27.0, 19.0], [9.4, 7.8], [3.0, 12.5]])
    queries = sample_features(a, starts)
    unit = torch.nn.functional.normalize(b, dim=0)
    for start, query, found in zip(
        starts, queries, locate(queries, starts, b, search), strict=True
    ):
        cosines = {
            (x, y): float(query / query.norm() @ unit[:, y, x])
            for x in range(28)
            for y in range(20)
            if abs(x - start[0]) <= 2.5 and abs(y - start[1]) <= 2.5
        }
        best = max(cosines, key=lambda place: cosines[place])
        near = [p for p in cosines if max(abs(p[0] - best[0]), abs(p[1] - best[1])) <= 1]
        weights = np.exp([(cosines[p] - cosines[best]) / 0.05 for p in near])
        expected = weights @ np.array(near) / weights.sum()
        assert np.allclose(found.numpy(), expected, atol=1e-4)
