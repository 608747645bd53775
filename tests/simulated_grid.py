"""Grid interpolation by CUDA kernels, on a CPU by the simulator of numba-cuda: against
plain torch and the CPU's kernels. `test_cuda_step.py` runs these tests in a process
with NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

from collections.abc import Callable

import pytest
import torch
from test_encodings import coords, grid
from torch import Tensor

from hdr_nsff.fields.nsff.encodings import AdditiveGrid
from hdr_nsff.fields.nsff.fused_grid import GridFunctionCuda

CLOSE = {"rtol": 1e-5, "atol": 1e-5}


def simulated(g: AdditiveGrid, points: Tensor, knot: float) -> Tensor:
    layout = g.layout_on(points.device, *g.time_slices(knot))
    values: Tensor = GridFunctionCuda.apply(points, g.table, g.touched, layout)
    return values


def plain(g: AdditiveGrid, points: Tensor, knot: float) -> Tensor:
    return g.reference(points, *g.time_slices(knot))


def by_cpu(g: AdditiveGrid, points: Tensor, knot: float) -> Tensor:
    return g(points, knot)


def values_and_gradients(
    read: Callable[..., Tensor], points: Tensor, knot: float, max_rows: int
) -> tuple[Tensor, ...]:
    """Values, gradients of table and points, and the marks of rows."""
    g, leaf = grid(max_rows), points.clone().requires_grad_()
    values = read(g, leaf, knot)
    weight = torch.randn(values.shape, generator=torch.Generator().manual_seed(3))
    (values * weight).sum().backward()
    assert g.table.grad is not None and leaf.grad is not None
    return values.detach(), g.table.grad, leaf.grad, g.touched


@pytest.mark.parametrize(("knot", "max_rows"), [(0.0, 2**10), (1.3, 2**10), (4.0, 2**17)])
def test_values_and_gradients(knot: float, max_rows: int) -> None:
    points = coords(60)
    ours = values_and_gradients(simulated, points, knot, max_rows)
    theirs = values_and_gradients(plain, points, knot, max_rows)
    torch.testing.assert_close(ours[0], theirs[0], **CLOSE)
    torch.testing.assert_close(ours[1], theirs[1], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours[2], theirs[2], rtol=1e-3, atol=2e-3)
    marked = values_and_gradients(by_cpu, points, knot, max_rows)[3]
    assert torch.equal(ours[3], marked)


def test_points_on_the_border_on_grid_points_and_outside() -> None:
    places = torch.tensor([-0.3, 0.0, 1 / 3, 1.0, 1.0 + 1e-7, torch.inf])
    points = torch.cartesian_prod(places, places, places[1:5])
    ours = values_and_gradients(simulated, points, 2.0, 2**10)
    theirs = values_and_gradients(by_cpu, points, 2.0, 2**10)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5 * float(b.abs().max()))
    torch.testing.assert_close(ours[0], plain(grid(), points, 2.0).detach(), **CLOSE)


def test_a_coordinate_that_is_not_a_number_gives_no_number() -> None:
    points = torch.tensor([[0.3, torch.nan, 0.4], [0.2, 0.5, 0.9]])
    ours = values_and_gradients(simulated, points, 1.3, 2**10)
    theirs = values_and_gradients(by_cpu, points, 1.3, 2**10)
    assert bool(ours[0][0].isnan().all()) and bool(ours[0][1].isfinite().all())
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-4, equal_nan=True)


def test_gradients_add_up_over_several_uses_of_one_grid_and_no_points_are_fine() -> None:
    g, points = grid(), coords(5)
    simulated(g, points, 0.0).sum().backward()
    assert g.table.grad is not None
    once = g.table.grad.clone()
    simulated(g, points, 0.0).sum().backward()
    torch.testing.assert_close(g.table.grad, 2 * once)
    assert simulated(g, points[:0], 0.0).shape == (0, 4)
