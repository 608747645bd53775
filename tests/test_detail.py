"""Static Gaussians start closer where the pictures have detail."""

import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.point_cloud import PointCloud
from hdr_nsff.fields.splat.detail import (
    HALF_DENSITY_DETAIL,
    SIZES_PER_OCTAVE,
    cell_sizes,
    detail_density,
    scale_by_size,
)

WIDTH = 64


def half_noisy(contrast: float) -> Tensor:
    """A picture that is flat on the left and random on the right (32, 64, 3)."""
    image = torch.full((32, WIDTH, 3), 0.5)
    noise = torch.randn(32, WIDTH // 2, 1, generator=torch.Generator().manual_seed(0))
    image[:, WIDTH // 2 :] += contrast * noise
    return image


def plane() -> Tensor:
    """One point for every pixel of a picture of 64 x 32 (2048, 3)."""
    y, x = torch.meshgrid(torch.arange(32.0), torch.arange(float(WIDTH)), indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)], -1).flatten(0, 1)


def cloud(positions: Tensor, trust: Tensor | None = None) -> PointCloud:
    ones = torch.ones(len(positions))
    return PointCloud(positions, positions, ones if trust is None else trust, ones)


def test_a_flat_picture_asks_for_nothing_and_more_contrast_for_more() -> None:
    weak, strong = (detail_density(half_noisy(c)).view(32, WIDTH) for c in (0.02, 0.2))
    assert float(weak[:, : WIDTH // 4].max()) < 1e-3
    assert 0.3 < float(weak[:, -WIDTH // 4 :].mean()) < 0.6 < float(strong[:, -WIDTH // 4 :].mean())
    assert float(strong.max()) < 1


def test_a_checkerboard_of_the_half_density_detail_asks_for_half() -> None:
    y, x = torch.meshgrid(torch.arange(32), torch.arange(32), indexing="ij")
    board = ((x + y) % 2 * 2.0 - 1)[..., None].expand(-1, -1, 3)
    # each of the two boxes leaves 1 / 9 of it: 5 pixels of one sign and 4 of the other
    image = 0.5 + HALF_DENSITY_DETAIL / (1 - 1 / 81) * board
    middle = detail_density(image).view(32, 32)[8:-8, 8:-8]
    torch.testing.assert_close(middle, torch.full_like(middle, 0.5), atol=1e-4, rtol=0)


@pytest.mark.parametrize(("density", "octaves"), [(1.0, 0.0), (0.25, 1.0), (0.0, 3.0)])
def test_cells_are_larger_by_the_root_of_the_density(density: float, octaves: float) -> None:
    points = plane()
    size = cell_sizes(cloud(points), points, torch.full((len(points),), density), WIDTH)
    assert set(size.tolist()) == {round(octaves * SIZES_PER_OCTAVE)}


def test_points_of_one_place_agree_by_their_trust() -> None:
    points = plane().repeat(2, 1)  # in two frames, of which one is clipped and flat
    density = torch.tensor([1.0, 0.0]).repeat_interleave(len(points) // 2)
    trust = torch.tensor([1.0, 1e-3]).repeat_interleave(len(points) // 2)
    assert set(cell_sizes(cloud(points, trust), points, density, WIDTH).tolist()) == {0}


def test_two_octaves_shrink_distances_to_a_quarter() -> None:
    coords = torch.tensor([[1.0, 2.0, 3.0], [5.0, 2.0, 7.0]])
    size = torch.tensor([0, 2 * SIZES_PER_OCTAVE])
    expected = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
    torch.testing.assert_close(scale_by_size(coords, size), expected)


def test_no_points_have_no_sizes() -> None:
    none = torch.zeros(0, 3)
    assert len(cell_sizes(cloud(none), none, torch.zeros(0), WIDTH)) == 0
