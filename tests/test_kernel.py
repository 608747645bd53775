"""The numba recording and its plain-torch twin: the same values and gradients, where
the curve's slope jumps, at its ends and beyond.
"""

import hashlib
import math
import os
import subprocess
import sys

import numba
import pytest
import torch
from torch import Tensor

from hdr_nsff.tonemap.curve import (
    GAMMA,
    knot_positions,
    leaky_ends,
    piecewise_linear,
    record,
)
from hdr_nsff.tonemap.kernel import Respond, bin_of, bin_table

LEAK = 0.01
POWER = {"gamma": 1 / GAMMA, "even": 1.0}
SPECIAL = [0.0, -0.0, 1.0, 1e-40, 1 + 2**-23, 1 - 2**-24, -1e-7, 4.0, 1e30, -4.0, -1e30]


def every_kind(test):
    """The test for both spacings of the knots, with the ends of eq. 11 and clamped."""
    return pytest.mark.parametrize("spacing", POWER)(
        pytest.mark.parametrize("leak", [LEAK, None])(test)
    )


def plain(
    radiance: Tensor, gain: Tensor, values: Tensor, knots: Tensor, spacing: str, leak: float | None
) -> Tensor:
    x = radiance * gain
    y = piecewise_linear(x, values, knots, POWER[spacing])
    return y if leak is None else leaky_ends(x, y, leak)


def fused(
    radiance: Tensor, gain: Tensor, values: Tensor, knots: Tensor, _: str, leak: float | None
) -> Tensor:
    return Respond.apply(radiance, gain, values, knots, bin_table(knots), leak)


def inputs(seed: int = 0, count: int = 3001) -> list[Tensor]:
    """Radiance (N, 3) from below black to beyond saturation, gain (3,) and a curve (3,
    256) that rises and falls.
    """
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(count, 3, generator=generator) * 1.2 - 0.02
    return [u * u.abs(), torch.tensor([0.7, 1.0, 1.9]), torch.rand(3, 256, generator=generator)]


def answers(function, tensors: list[Tensor], weight: Tensor, *rest) -> list[Tensor]:
    """The values and the gradients of their weighted sum."""
    leaves = [t.clone().requires_grad_() for t in tensors]
    y = function(*leaves, *rest)
    return [y.detach(), *torch.autograd.grad((y * weight).sum(), leaves)]


@every_kind
def test_values_and_gradients_are_the_twins(spacing: str, leak: float | None) -> None:
    tensors, knots = inputs(), knot_positions(spacing)
    weight = torch.randn(3001, 3, generator=torch.Generator().manual_seed(1))
    ours, theirs = (answers(f, tensors, weight, knots, spacing, leak) for f in (fused, plain))
    for name, a, b in zip(("rgb", "radiance", "gain", "values"), ours, theirs, strict=True):
        torch.testing.assert_close(
            a, b, atol=2e-5, rtol=1e-4, msg=lambda m, name=name: f"{name}: {m}"
        )


@every_kind
def test_at_the_ends_and_far_beyond_them_the_twins_agree(spacing: str, leak: float | None) -> None:
    radiance = torch.tensor([*SPECIAL, math.inf])[:, None].expand(-1, 3)  # not contiguous
    tensors, knots, weight = (
        [radiance, torch.ones(3), inputs()[2]],
        knot_positions(spacing),
        torch.ones(len(radiance), 3),
    )
    ours, theirs = (answers(f, tensors, weight, knots, spacing, leak) for f in (fused, plain))
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(
            a, b, atol=1e-6, rtol=1e-5, equal_nan=True
        )  # gain: 0 * inf is not a number, in both


@every_kind
def test_at_a_knot_the_curve_is_its_value_and_the_slope_that_of_a_neighbor(
    spacing: str, leak: float | None
) -> None:
    knots, (_, gain, values) = knot_positions(spacing), inputs()
    tensors = [knots[:, None].expand(-1, 3), torch.ones_like(gain), values]
    y, to_radiance, _, to_values = answers(fused, tensors, torch.ones(256, 3), knots, spacing, leak)
    torch.testing.assert_close(y, values.T)
    torch.testing.assert_close(to_values, torch.ones(3, 256))
    slopes = (values.diff() / knots.diff()).T
    neighbors = torch.cat([slopes[:1], slopes]), torch.cat([slopes, slopes[-1:]])
    assert torch.stack([torch.isclose(to_radiance, s, rtol=1e-4) for s in neighbors]).any(0).all()


@every_kind
def test_gradients_are_finite_differences_of_the_float64_twin(
    spacing: str, leak: float | None
) -> None:
    tensors, knots, step = inputs(seed=2, count=300), knot_positions(spacing), 1e-9
    weight = torch.randn(300, 3, generator=torch.Generator().manual_seed(3))
    _, *gradients = answers(fused, tensors, weight, knots, spacing, leak)

    def cost(tensors: list[Tensor]) -> float:
        return float((plain(*tensors, knots.double(), spacing, leak) * weight).sum())

    generator = torch.Generator().manual_seed(4)
    for k, gradient in enumerate(gradients):
        for _ in range(5):
            way = torch.randn(tensors[k].shape, generator=generator, dtype=torch.float64)
            ahead, back = (
                [t.double() + h * way if i == k else t.double() for i, t in enumerate(tensors)]
                for h in (step, -step)
            )
            expected = (cost(ahead) - cost(back)) / (2 * step)
            size = float((gradient * way).norm())
            assert float((gradient * way).sum()) == pytest.approx(expected, abs=1e-4 * size)


@every_kind
def test_a_value_that_is_no_number_stays_none_and_moves_no_other_pixel(
    spacing: str, leak: float | None
) -> None:
    radiance, gain, values = inputs()
    spoilt = radiance.clone()
    spoilt[5, 1] = math.nan
    weight = torch.ones_like(radiance)
    knots = knot_positions(spacing)
    y, to_radiance, _, to_values = answers(
        fused, [spoilt, gain, values], weight, knots, spacing, leak
    )
    clean, clean_radiance, _, clean_values = answers(
        fused, [radiance, gain, values], weight, knots, spacing, leak
    )
    here = spoilt.isnan()
    assert torch.equal(y.isnan(), here) and torch.equal(y[~here], clean[~here])
    assert to_radiance[5, 1] == 0 and torch.equal(to_radiance[~here], clean_radiance[~here])
    assert to_values[1].isnan().any() and torch.equal(to_values[[0, 2]], clean_values[[0, 2]])
    assert plain(spoilt, gain, values, knots, spacing, leak).isnan().equal(here)


@pytest.mark.parametrize("spacing", POWER)
def test_every_value_is_in_the_bin_that_holds_it(spacing: str) -> None:
    knots = knot_positions(spacing)
    one = torch.ones(())
    beside = [
        knots,
        torch.nextafter(knots, 2 * one),
        torch.nextafter(knots, -one),
        torch.rand(5000),
        torch.rand(5000) ** 8,
    ]
    x = torch.cat(beside).clamp(0, 1)
    table, bounds = bin_table(knots).numpy(), knots.numpy()
    found = torch.tensor([int(bin_of.py_func(v, bounds, table)) for v in x.numpy()])
    assert torch.equal(found, (torch.searchsorted(knots, x) - 1).clamp_min(0))


def test_knots_too_dense_for_the_table_are_refused() -> None:
    with pytest.raises(AssertionError, match="two knots"):
        bin_table(torch.linspace(0, 1, 2000))


def test_no_pixels_are_an_empty_answer() -> None:
    tensors = [torch.zeros(0, 3), *inputs()[1:]]
    y, *gradients = answers(
        fused, tensors, torch.ones(0, 3), knot_positions("gamma"), "gamma", LEAK
    )
    assert y.shape == (0, 3) and not any(g.any() for g in gradients)


def test_recording_takes_the_kernel_for_float32_and_the_twin_for_the_rest() -> None:
    knots, tensors = knot_positions("gamma"), inputs()
    bins = bin_table(knots)
    leaves = [t.requires_grad_() for t in tensors]
    fast = record(*leaves, knots, bins, 1 / GAMMA, LEAK)
    assert "Respond" in type(fast.grad_fn).__name__
    slow = record(*(t.double() for t in leaves), knots.double(), bins, 1 / GAMMA, LEAK)
    assert slow.dtype == torch.float64
    torch.testing.assert_close(fast, slow.float(), atol=1e-5, rtol=1e-5)


def fingerprints() -> None:
    """Print a hash of values and gradients for 1, 2, 2 and 1 threads."""
    for threads in (1, 2, 2, 1):
        numba.set_num_threads(threads)
        said = answers(fused, inputs(), torch.ones(3001, 3), knot_positions("gamma"), "gamma", LEAK)
        print(hashlib.sha256(b"".join(t.numpy().tobytes() for t in said)).hexdigest())


def test_the_result_is_the_same_to_the_bit_for_any_number_of_threads() -> None:
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2", "PYTHONPATH": os.pathsep.join(sys.path)}
    code = "import test_kernel; test_kernel.fingerprints()"
    said = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    hashes = said.stdout.split()
    assert len(hashes) == 4 and len(set(hashes)) == 1
