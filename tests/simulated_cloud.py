"""The Gaussians of a moment by CUDA kernels, on a CPU by the simulator of numba-cuda:
against plain torch. `test_cuda_step.py` runs these tests in a process with
NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

from dataclasses import replace
from typing import Any

import pytest
import torch
from test_splat import BESIDE, TIMES, batch_of, scattered
from torch import Tensor

from hdr_nsff.fields.splat import draw, local_gaussians, training_view
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.fused_picture import fused_composite
from hdr_nsff.fields.splat.rasterize import Maps
from hdr_nsff.fields.splat.splat import Splat

NAMES = ("means", "quaternions", "scales", "opacities", "features")
ROUNDING = 2e-5  # of the largest number: plain torch computes in float32


@pytest.fixture(autouse=True)
def gaussians_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would be rasterized is the picture."""
    for module in (draw, training_view):
        monkeypatch.setattr(module, "rasterize", lambda *arguments: arguments[:5])


def random_field(seed: int = 0, **settings: Any) -> Splat:
    """Random Gaussians, some of them with dark, long or steep numbers."""
    field = scattered(seed)
    if settings:
        config = replace(field.config, **settings)
        other = Splat(config, torch.arange(TIMES), 1.0, 6.0, 1200)
        other.load_state_dict(
            {k: v for k, v in field.state_dict().items() if v.shape == other.state_dict()[k].shape},
            strict=False,
        )
        field = other
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        field.static.opacity_logits[::5] = -9.0
        field.moving.log_radiance[::7] = 17.0
        field.mixture_logits.add_(torch.randn(field.mixture_logits.shape, generator=generator))
    field.find_neighbors()
    return field


def values_and_gradients(
    field: Splat, knot: float, offset: int | None, rigidity: bool, fused: bool
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Gaussians and terms by name, and gradients and marks by parameters."""
    draw_view = training_view.draw_by_kernels if fused else training_view.draw_by_torch
    offsets = [] if offset is None else [offset]
    batch = batch_of(0, offset or 1)
    view = training_view.TrainingView(batch, knot, field.alive(knot), offsets, rigidity)
    made, _, terms = draw_view(field.model(), view)
    values = {**dict(zip(NAMES, made, strict=True)), **terms}
    generator = torch.Generator().manual_seed(3)
    loss = sum((torch.randn(v.shape, generator=generator) * v).sum() for v in values.values())
    field.zero_grad()
    loss.backward()
    found = {n: p.grad for n, p in field.named_parameters() if p.grad is not None}
    marks = {n: b.clone() for n, b in field.named_buffers() if n.endswith("touched")}
    for name, buffer in field.named_buffers():
        if name.endswith("touched"):
            buffer.zero_()
    return {k: v.detach() for k, v in values.items()}, {**found, **marks}


def compare(field: Splat, knot: float, offset: int | None, rigidity: bool) -> None:
    """The same by kernels and by plain torch."""
    expected = values_and_gradients(field, knot, offset, rigidity, fused=False)
    found = values_and_gradients(field, knot, offset, rigidity, fused=True)
    for ours, theirs in zip(found, expected, strict=True):
        for name, b in theirs.items():
            a = ours.get(name, torch.zeros_like(b))
            largest = float(b.float().abs().max()) if b.numel() else 0.0
            if b.numel():
                off = float((a.float() - b.float()).abs().max())
                assert off <= ROUNDING * largest + 1e-7, f"{name}: off by {off:.3g} of {largest}"


@pytest.mark.parametrize(("knot", "offset"), [(4.0, 1), (4.3, -1), (0.0, 1), (9.0, 1), (9.0, -1)])
def test_gaussians_with_flow_to_a_neighbor(knot: float, offset: int) -> None:
    compare(random_field(), knot, offset, rigidity=False)


@pytest.mark.parametrize("knot", [0.0, 2.0, 3.7, 9.0])
def test_gaussians_and_their_rigidity(knot: float) -> None:
    compare(random_field(1), knot, None, rigidity=True)


@pytest.mark.parametrize(
    "settings",
    [
        {"local": 0},
        {"moving": 0, "local": 0},
        {"radiance": "sigmoid"},
        {"brightness_knots": 1, "color_knots": 1, "opacity_knots": 1},
        {"bases": 1},
    ],
)
def test_settings(settings: dict[str, Any]) -> None:
    field = random_field(2, **settings)
    compare(field, 4.2, 1, rigidity=False)
    compare(field, 4.2, None, rigidity=True)


@pytest.mark.parametrize("num_times", [1, 2, 3])
def test_short_clips(num_times: int) -> None:
    config = SplatConfig(static=8, moving=6, local=0, bases=2)
    field = Splat(config, torch.arange(num_times), 1.0, 6.0, 1200)
    for p in field.parameters():
        p.data.add_(0.1)
    compare(field, float(num_times - 1), -1, rigidity=False)
    compare(field, 0.0, None, rigidity=True)


def drawn_maps(channels: int) -> list[Tensor]:
    """Planes, depth and alpha of a picture, alpha near its limit here and there."""
    generator = torch.Generator().manual_seed(0)
    alpha = torch.rand(9, 15, generator=generator)
    alpha[0], alpha[1], alpha[2] = 0.0, 1e-3, 0.9e-3
    depth = 3 * torch.rand(9, 15, generator=generator) * alpha
    return [torch.rand(channels, 9, 15, generator=generator), depth, alpha]


@pytest.mark.parametrize("radiance", ["exp", "sigmoid"])
@pytest.mark.parametrize("channels", [4, 6])
def test_maps_over_the_background(radiance: str, channels: int) -> None:
    field = random_field(radiance=radiance)
    found = []
    for fused in (True, False):
        leaves = [m.clone().requires_grad_() for m in drawn_maps(channels)]
        maps = Maps(leaves[0].permute(1, 2, 0), leaves[1], leaves[2])
        if fused:
            numbers = field.bounded, field.far, draw.MIN_DEPTH_SHARE, draw.MIN_ALPHA
            render, flow = fused_composite(maps, field.background, *numbers)
        else:
            render, drawn = draw.composite(field.model(), maps)
            flow = drawn / render.opacity.clamp_min(draw.MIN_ALPHA)[:, None]
        values = [render.radiance, render.depth, render.motion, flow]
        values = [v for v in values if v.numel()]
        generator = torch.Generator().manual_seed(1)
        loss = sum((torch.randn(v.shape, generator=generator) * v).sum() for v in values)
        gradients = torch.autograd.grad(loss, [*leaves, field.background])
        found.append([*(v.detach() for v in values), *gradients])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


def test_more_gaussians_than_a_block() -> None:
    field = scattered(5, static=130, moving=150)
    field.find_neighbors()
    compare(field, 5.0, 1, rigidity=False)


def test_flow_is_limited_near_the_camera() -> None:
    field = random_field(4)
    with torch.no_grad():
        field.static.means[:5, 2] = 1e-5
        field.static.means[5:8, 2] = -1.0
    assert float(BESIDE.project(field.static.means.detach())[0].abs().max()) > 100
    compare(field, 4.0, 1, rigidity=False)


@pytest.mark.parametrize("knot", [0.0, 2.4, 4.0])
def test_time_local_gaussians_that_are_alive(knot: float, monkeypatch: pytest.MonkeyPatch) -> None:
    field = random_field()
    with torch.no_grad():
        field.local.log_scales[:, 3] = -1.0
        field.local.means[:, 3] = torch.linspace(0, 4, len(field.local))
    expected = field.alive(knot)
    monkeypatch.setattr(local_gaussians, "kernels_on", lambda device: True)
    assert torch.equal(field.alive(knot), expected)
    assert 0 < len(expected) < len(field.local)
