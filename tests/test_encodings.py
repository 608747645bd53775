"""Grids: the numba kernels against their plain-torch twin, interpolation worked by
hand, and the optimizer of touched rows.
"""

import numpy as np
import torch

from hdr_nsff.fields.nsff.encodings import AdditiveGrid, TouchedAdam, frequencies

SHAPES = [(4, 5, 6, 1), (9, 7, 8, 3), (20, 20, 20, 3)]


def grid(max_rows: int = 2**10) -> AdditiveGrid:
    g = AdditiveGrid(SHAPES, num_knots=5, max_rows=max_rows)
    g.table.data.normal_(generator=torch.Generator().manual_seed(1))
    return g


def coords(n: int = 500) -> torch.Tensor:
    """Points of which a tenth lies outside of the cube on every side."""
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(2)) * 1.2 - 0.1


def test_kernels_equal_plain_torch_in_values_and_gradients_dense_and_hashed() -> None:
    for knot in (0.0, 1.3, 4.0):
        g, x = grid(), coords().requires_grad_()
        out = g(x, knot)
        weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(3))
        (out * weight).sum().backward()
        table, point = g.table.grad.clone(), x.grad.clone()
        g.table.grad = x.grad = None
        twin = g.reference(x, *g.time_slices(knot))
        (twin * weight).sum().backward()
        torch.testing.assert_close(out, twin, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(table, g.table.grad, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(point, x.grad, atol=2e-3, rtol=1e-3)


def test_a_coordinate_that_is_not_a_number_gives_no_number_and_harms_no_other_point() -> None:
    g, x = grid(), coords(3)
    x[1, 2] = torch.nan
    for out in (g(x, 1.3), g.reference(x, *g.time_slices(1.3))):
        assert bool(out[1].isnan().all())
        torch.testing.assert_close(out[::2], g(x[::2], 1.3))
    g(x.requires_grad_(), 1.3).sum().backward()
    assert x.grad is not None and bool(x.grad[::2].isfinite().all())


def test_twin_gradient_agrees_with_finite_differences() -> None:
    g = grid().double()
    x = torch.tensor(
        [[0.31, 0.42, 0.53], [0.11, 0.77, 0.64]], dtype=torch.float64, requires_grad=True
    )
    slices = g.time_slices(1.3)
    assert torch.autograd.gradcheck(lambda p: g.reference(p, *slices), (x,), eps=1e-7, atol=1e-4)


def test_a_linear_ramp_is_reproduced_exactly() -> None:
    g = AdditiveGrid([(5, 4, 3, 1)])
    for z in range(3):
        for y in range(4):
            for x in range(5):
                g.table.data[(z * 4 + y) * 5 + x] = torch.tensor([x / 4, y / 3, z / 2, 1.0])
    points = torch.tensor([[0.1, 0.2, 0.3], [0.9, 0.5, 0.77]])
    torch.testing.assert_close(g(points), torch.cat([points, torch.ones(2, 1)], -1))


def test_time_blends_two_slices_linearly_and_a_knot_reads_one() -> None:
    g = AdditiveGrid([(4, 4, 4, 3)], num_knots=3)
    for s, value in enumerate((1.0, 3.0, 7.0)):
        g.table.data[64 * s : 64 * (s + 1)] = value
    point = torch.full((1, 3), 0.5)
    assert float(g(point, 1.0)[0, 0].detach()) == 3.0
    np.testing.assert_allclose(float(g(point, 1.25)[0, 0].detach()), 0.75 * 3 + 0.25 * 7)


def test_gradients_add_up_over_several_uses_of_one_grid() -> None:
    g, x = grid(), coords(50)
    g(x, 0.0).sum().backward()
    once = g.table.grad.clone()
    g(x, 0.0).sum().backward()
    torch.testing.assert_close(g.table.grad, 2 * once)


def marked(rows: int) -> torch.Tensor:
    return torch.ones(rows, dtype=torch.uint8)


def test_touched_adam_is_adam_where_every_row_has_a_gradient() -> None:
    a, b = torch.ones(3, 4, requires_grad=True), torch.ones(3, 4, requires_grad=True)
    marks = marked(3)
    ours = TouchedAdam([{"params": [a], "touched": [marks]}], lr=0.1, eps=1e-8)
    theirs = torch.optim.Adam([b], lr=0.1, betas=(0.9, 0.99), eps=1e-8)
    for step in range(1, 4):
        marks.fill_(1)
        a.grad, b.grad = torch.full((3, 4), 0.5 * step), torch.full((3, 4), 0.5 * step)
        ours.step()
        theirs.step()
    torch.testing.assert_close(a, b)


def test_touched_adam_leaves_unmarked_rows_alone_and_clears_what_it_used() -> None:
    p, marks = torch.ones(2, 4, requires_grad=True), marked(2)
    optimizer = TouchedAdam([{"params": [p], "touched": [marks]}], lr=0.1)
    p.grad = torch.ones(2, 4)
    optimizer.step()
    assert float(p.grad.abs().sum()) == 0 and int(marks.sum()) == 0
    before, moment = p.detach().clone(), optimizer.state[p]["exp_avg"].clone()
    p.grad[0] = 1.0
    marks[0] = 1
    optimizer.step()
    assert torch.equal(p[1], before[1]) and (p[0] < before[0]).all()
    assert torch.equal(optimizer.state[p]["exp_avg"][1], moment[1])


def test_backward_marks_every_row_with_a_gradient() -> None:
    g = grid()
    g(coords(20), 1.3).sum().backward()
    has = (g.table.grad != 0).any(-1)
    assert bool((g.touched[has] == 1).all()) and int(g.touched.sum()) < 0.5 * len(has)


def test_frequencies_hold_identity_sines_and_cosines() -> None:
    x = torch.tensor([[0.5, -1.0]])
    out = frequencies(x, 2)
    once, twice = np.array([0.5, -1.0]), np.array([1.0, -2.0])
    expected = np.concatenate([once, np.sin(once), np.cos(once), np.sin(twice), np.cos(twice)])
    torch.testing.assert_close(out[0], torch.from_numpy(expected).float())


def test_loading_a_state_keeps_the_marks_of_touched_rows() -> None:
    p, marks = torch.ones(1, 4, requires_grad=True), marked(1)
    optimizer = TouchedAdam([{"params": [p], "touched": [marks]}], lr=0.1)
    optimizer.load_state_dict(optimizer.state_dict())
    p.grad = torch.ones(1, 4)
    optimizer.step()
    assert float(p.detach().max()) < 1 and int(marks.sum()) == 0
