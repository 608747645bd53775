"""Lens, recording and losses of a picture by CUDA kernels, on a CPU by the simulator of
numba-cuda: against plain torch. `test_cuda_step.py` runs these tests in a process with
NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

import pytest
import torch
from pictures import CAMERA, PRIORS, N, compare, compare_losses
from torch import Tensor

from hdr_nsff.tonemap.curve import GAMMA, knot_positions, leaky_ends, piecewise_linear
from hdr_nsff.tonemap.kernel_cuda import RespondCuda, ShadeCuda
from hdr_nsff.tonemap.vignetting import MIN_TRANSMISSION, Vignetting
from hdr_nsff.training.fused_losses import CudaLosses


@pytest.mark.parametrize("leak", [0.01, None])
@pytest.mark.parametrize("spacing", ["gamma", "even"])
def test_recordings(leak: float | None, spacing: str) -> None:
    generator = torch.Generator().manual_seed(0)
    knots = knot_positions(spacing)
    values = torch.rand(3, len(knots), generator=generator).cumsum(1) / 128
    radiance = 3 * torch.rand(N, 3, generator=generator) ** 2 - 0.2
    radiance[0], radiance[1] = 0.0, 0.6204
    gain = torch.tensor([0.4, 1.0, 1.6])
    power = 1 / GAMMA if spacing == "gamma" else 1.0

    def plain(radiance: Tensor, gain: Tensor, values: Tensor) -> Tensor:
        x = radiance * gain
        y = piecewise_linear(x, values, knots, power)
        return y if leak is None else leaky_ends(x, y, leak)

    def ours(radiance: Tensor, gain: Tensor, values: Tensor) -> Tensor:
        return RespondCuda.apply(radiance, gain, values, knots, leak)

    compare(ours, plain, radiance, gain, values)


def test_a_radiance_that_is_not_a_number_shows_in_the_curve() -> None:
    knots = knot_positions("even")
    values = knots.expand(3, -1).clone().requires_grad_()
    radiance = torch.full((2, 3), torch.nan)
    rgb = RespondCuda.apply(radiance, torch.ones(3), values, knots, 0.01)
    rgb.sum().backward()
    assert rgb.isnan().all() and values.grad is not None and values.grad.isnan().any()


def test_lenses() -> None:
    vignetting = Vignetting((0.4, 0.5))
    generator = torch.Generator().manual_seed(0)
    pixels = CAMERA.pixel_grid()

    def plain(radiance: Tensor, coefficients: Tensor) -> Tensor:
        return radiance * torch.func.functional_call(
            vignetting, {"coefficients": coefficients}, (CAMERA, pixels, 1)
        )

    def ours(radiance: Tensor, coefficients: Tensor) -> Tensor:
        lens = pixels, CAMERA.K, vignetting.corners, 1, MIN_TRANSMISSION
        return ShadeCuda.apply(radiance, coefficients, *lens)

    coefficients = torch.tensor([[0.0, 0, 0], [-0.5, 0.2, -2.0]])  # dark corners are held
    compare(ours, plain, torch.rand(N, 3, generator=generator), coefficients)


@pytest.mark.parametrize("names", PRIORS)
def test_losses(names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    compare_losses(CudaLosses, names, monkeypatch)
