"""The culling grids: cells, remembered weights, exploration, forbidden cells."""

import torch

from hdr_nsff.fields.nsff.occupancy import Occupancy

CENTER = torch.tensor([[0.45, 0.45, 0.45]])  # cell (4, 4, 4) of ten


def test_cells_are_counted_x_fastest_and_slices_slowest() -> None:
    grid = Occupancy((4, 3, 2), slices=2)
    coords = torch.tensor([[0.3, 0.9, 0.6], [-1.0, 0.0, 0.0], [1.0, 1.0, 7.0]])
    assert grid.cell_index(coords).tolist() == [(1 * 3 + 2) * 4 + 1, 0, 23]
    assert grid.cell_index(coords, 0.8).tolist() == [24 + 21, 24, 47]  # the nearest slice


def test_centers_lie_in_their_cells_in_order() -> None:
    grid = Occupancy((4, 3, 2))
    assert grid.cell_index(grid.cell_centers()).tolist() == list(range(24))


def test_every_cell_is_selected_until_a_refresh_and_then_the_neighborhood_of_weights() -> None:
    grid = Occupancy((10, 10, 10))
    assert bool(grid.select(grid.cell_centers(), 0.0, 0.0, None).all())
    grid.observe(CENTER, torch.tensor([0.5]))
    grid.refresh(threshold=0.1, decay=0.5)
    selected = grid.select(grid.cell_centers(), 0.0, 0.0, None).view(10, 10, 10)
    assert int(selected.sum()) == 27 and bool(selected[3:6, 3:6, 3:6].all())


def test_the_largest_weight_is_remembered_and_fades() -> None:
    grid = Occupancy((10, 10, 10))
    grid.observe(CENTER.expand(2, 3), torch.tensor([0.8, 0.2]))
    # 0.8, 0.4, 0.2, 0.1: the fourth is not above the threshold
    for count, kept in ((1, 27), (2, 27), (3, 27), (4, 0)):
        grid.refresh(threshold=0.1001, decay=0.5)
        assert int(grid.mask.sum()) == kept, count


def test_exploration_selects_its_share_of_the_other_allowed_cells() -> None:
    grid = Occupancy((40, 40, 40))
    grid.mask.zero_()
    grid.allowed[:, :20] = False  # the near half
    coords = torch.rand(20000, 3, generator=torch.Generator().manual_seed(0))
    selected = grid.select(coords, 0.0, 0.1, torch.Generator().manual_seed(1))
    assert not bool(selected[coords[:, 2] < 0.5].any())
    share = float(selected[coords[:, 2] >= 0.5].float().mean())
    assert 0.09 < share < 0.11


def test_a_forbidden_cell_stays_culled_at_any_weight() -> None:
    grid = Occupancy((10, 10, 10))
    grid.allowed[0, 4, 4, 4] = False
    grid.observe(CENTER, torch.tensor([1.0]))
    grid.refresh(threshold=0.1, decay=0.5)
    assert int(grid.mask.sum()) == 26 and not bool(grid.select(CENTER, 0.0, 0.0, None))


def test_slices_are_independent() -> None:
    grid = Occupancy((10, 10, 10), slices=3)
    grid.observe(CENTER, torch.tensor([1.0]), knot=1.0)
    grid.refresh(threshold=0.1, decay=0.5)
    assert grid.mask.flatten(1).sum(1).tolist() == [0, 27, 0]
