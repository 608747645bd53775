"""Lens, recording and losses of a picture by CUDA kernels, on a CPU by the simulator of
numba-cuda: against plain torch. `test_cuda_step.py` runs these tests in a process with
NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.base import Render, Warp
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig
from hdr_nsff.tonemap.curve import GAMMA, knot_positions, leaky_ends, piecewise_linear
from hdr_nsff.tonemap.identity import IdentityToneMapper
from hdr_nsff.tonemap.kernel_cuda import RespondCuda, ShadeCuda
from hdr_nsff.tonemap.vignetting import MIN_TRANSMISSION, Vignetting
from hdr_nsff.training.fused_losses import can_fuse, fused_terms
from hdr_nsff.training.objective import FLOW_LIMIT_PX, Objective

CAMERA = Camera(torch.tensor([[20.0, 0, 9], [0, 18, 8], [0, 0, 1]]), torch.eye(4)[:3], 19, 15)
N = CAMERA.width * CAMERA.height  # more than two blocks


def gradients_of(value: Tensor, leaves: list[Tensor]) -> tuple[Tensor, ...]:
    """Gradients, 0 where there is none."""
    return torch.autograd.grad(value, leaves, allow_unused=True, materialize_grads=True)


def compare(ours: Callable[..., Tensor], theirs: Callable[..., Tensor], *inputs: Tensor) -> None:
    """The same values and gradients of the inputs."""
    found = []
    for function in (ours, theirs):
        leaves = [t.clone().requires_grad_() for t in inputs]
        value = function(*leaves)
        weight = torch.randn(value.shape, generator=torch.Generator().manual_seed(1))
        found.append([value.detach(), *gradients_of((value * weight).sum(), leaves)])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


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


def batch_with(names: tuple[str, ...]) -> PixelBatch:
    """A whole frame with these priors."""
    generator = torch.Generator().manual_seed(2)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    priors = {
        "moving": draw(N) < 0.3,
        "outline": draw(N) < 0.2,
        "disparity": draw(N),
        "disparity_confidence": draw(N),
        "flow": {1: 30 * draw(N, 2)},
        "flow_valid": {1: draw(N) < 0.6},
    }
    every = torch.ones(N, dtype=torch.bool)
    pixels = CAMERA.pixel_grid()
    batch = PixelBatch(0, 0.0, CAMERA, 0, 0, {1: CAMERA}, pixels, draw(N, 3), every, whole=True)
    return replace(batch, **{name: priors[name] for name in names})


EVERY = ("moving", "outline", "disparity", "disparity_confidence", "flow", "flow_valid")


@pytest.mark.parametrize("names", [EVERY, EVERY[:1], EVERY[2:3], EVERY[4:], ()])
def test_losses(names: tuple[str, ...]) -> None:
    batch = batch_with(names)
    objective = Objective({}, "scene", near=0.7)
    tonemap = IdentityToneMapper(ToneMapConfig(), Recordings((0,), (0,), (0.0,), 0, 1))
    generator = torch.Generator().manual_seed(0)

    def rendered(rgb: Tensor, depth: Tensor, motion: Tensor, flow: Tensor) -> Render:
        warp = Warp(1, flow, motion, None)
        return Render(rgb, depth, motion, motion, warps=(warp,), rgb=rgb)

    def plain(*maps: Tensor) -> Tensor:
        terms = objective.terms(rendered(*maps), batch, tonemap, 1.3)
        return torch.stack([terms[name] for name in sorted(terms)])

    def ours(*maps: Tensor) -> Tensor:
        render = rendered(*maps)
        assert can_fuse(render, batch)
        terms = fused_terms(render, maps[0], batch, 0.7, objective.fade, FLOW_LIMIT_PX)
        return torch.stack([terms[name] for name in sorted(terms)])

    shapes = (N, 3), (N,), (N,), (N, 2)
    drawn = [torch.rand(shape, generator=generator) for shape in shapes]
    maps = [drawn[0], 1 + drawn[1], drawn[2], 30 * drawn[3]]
    expected = sorted(objective.terms(rendered(*maps), batch, tonemap, 0.0))
    assert sorted(fused_terms(rendered(*maps), maps[0], batch, 0.7, 1.0, 1.0)) == expected
    compare(ours, plain, *maps)
