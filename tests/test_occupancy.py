"""The culling grids: cells, memory, exploration, where motion is allowed."""

import torch

from hdr_nsff.fields.nsff.occupancy import Occupancy

CENTER = torch.tensor([[0.45, 0.45, 0.45]])  # cell (4, 4, 4) of ten


def test_cells_are_counted_x_fastest_and_slices_slowest() -> None:
    grid = Occupancy((4, 3, 2), slices=2)
    coords = torch.tensor([[0.3, 0.9, 0.6], [-1.0, 0.0, 0.0], [1.0, 1.0, 7.0]])
    assert grid.cells(coords).tolist() == [(1 * 3 + 2) * 4 + 1, 0, 23]
    assert grid.cells(coords, 0.8).tolist() == [24 + 21, 24, 47]  # the nearest slice


def test_centers_lie_in_their_own_cells_in_order() -> None:
    grid = Occupancy((4, 3, 2))
    assert grid.cells(grid.centers()).tolist() == list(range(24))


def test_everything_is_asked_until_refreshed_then_only_around_what_was_seen() -> None:
    grid = Occupancy((10, 10, 10))
    assert bool(grid.asks(grid.centers(), 0.0, 0.0, None).all())
    grid.observe(CENTER, torch.tensor([0.5]))
    grid.refresh(threshold=0.1, decay=0.5)
    asked = grid.asks(grid.centers(), 0.0, 0.0, None).view(10, 10, 10)
    assert int(asked.sum()) == 27 and bool(asked[3:6, 3:6, 3:6].all())


def test_the_largest_weight_is_remembered_and_fades() -> None:
    grid = Occupancy((10, 10, 10))
    grid.observe(CENTER.expand(2, 3), torch.tensor([0.8, 0.2]))
    for count, kept in (
        (1, 27),
        (2, 27),
        (3, 27),
        (4, 0),
    ):  # 0.8, 0.4, 0.2, 0.1: the fourth is not above the threshold
        grid.refresh(threshold=0.1001, decay=0.5)
        assert int(grid.mask.sum()) == kept, count


def test_exploration_asks_its_share_of_the_others_but_never_where_it_is_not_allowed() -> None:
    grid = Occupancy((40, 40, 40))
    grid.mask.zero_()
    grid.allowed[:, :20] = False  # the near half
    coords, generator = (
        torch.rand(20000, 3, generator=torch.Generator().manual_seed(0)),
        torch.Generator().manual_seed(1),
    )
    asked = grid.asks(coords, 0.0, 0.1, generator)
    assert not bool(asked[coords[:, 2] < 0.5].any())
    share = float(asked[coords[:, 2] >= 0.5].float().mean())
    assert 0.09 < share < 0.11


def test_what_is_not_allowed_stays_culled_however_bright() -> None:
    grid = Occupancy((10, 10, 10))
    grid.allowed[0, 4, 4, 4] = False
    grid.observe(CENTER, torch.tensor([1.0]))
    grid.refresh(threshold=0.1, decay=0.5)
    assert int(grid.mask.sum()) == 26 and not bool(grid.asks(CENTER, 0.0, 0.0, None))


def test_slices_do_not_see_each_other() -> None:
    grid = Occupancy((10, 10, 10), slices=3)
    grid.observe(CENTER, torch.tensor([1.0]), knot=1.0)
    grid.refresh(threshold=0.1, decay=0.5)
    assert grid.mask.flatten(1).sum(1).tolist() == [0, 27, 0]
