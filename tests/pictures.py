"""Training pictures and their losses, by kernels and by plain torch."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from moments import random_field
from torch import Tensor

from hdr_nsff.fields.base import Render, Warp
from hdr_nsff.fields.splat import draw
from hdr_nsff.fields.splat.late_mixing import LateMixing, Parts
from hdr_nsff.fields.splat.rasterize import Maps
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig
from hdr_nsff.tonemap.identity import IdentityToneMapper
from hdr_nsff.training import objective as objectives
from hdr_nsff.training.fused_losses import can_fuse, fused_terms
from hdr_nsff.training.objective import FLOW_LIMIT_PX, Objective

CAMERA = Camera(torch.tensor([[20.0, 0, 9], [0, 18, 8], [0, 0, 1]]), torch.eye(4)[:3], 19, 15)
N = CAMERA.width * CAMERA.height  # more than two blocks
EVERY = ("moving", "outline", "disparity", "disparity_confidence", "flow", "flow_valid")
PRIORS = [EVERY, EVERY[:1], EVERY[2:3], EVERY[4:], ()]


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


def compare_losses(
    losses: type[torch.autograd.Function], names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The terms of a picture with these priors, by kernels and by plain torch."""
    monkeypatch.setattr(objectives, "losses_by_kernels", lambda rgb: None)
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
        terms = fused_terms(losses, render, maps[0], batch, 0.7, objective.fade, FLOW_LIMIT_PX)
        return torch.stack([terms[name] for name in sorted(terms)])

    shapes = (N, 3), (N,), (N,), (N, 2)
    drawn = [torch.rand(shape, generator=generator) for shape in shapes]
    maps = [drawn[0], 1 + drawn[1], drawn[2], 30 * drawn[3]]
    expected = sorted(objective.terms(rendered(*maps), batch, tonemap, 0.0))
    assert sorted(fused_terms(losses, rendered(*maps), maps[0], batch, 0.7, 1.0, 1.0)) == expected
    compare(ours, plain, *maps)


def drawn_maps(channels: int) -> list[Tensor]:
    """Planes, depth and alpha of a picture, alpha near its limit here and there."""
    generator = torch.Generator().manual_seed(0)
    alpha = torch.rand(9, 15, generator=generator)
    alpha[0], alpha[1], alpha[2] = 0.0, 1e-3, 0.9e-3
    depth = 3 * torch.rand(9, 15, generator=generator) * alpha
    return [torch.rand(channels, 9, 15, generator=generator), depth, alpha]


def compare_composites(
    ours: Callable[[Splat, list[Tensor]], tuple[Render, Tensor]], field: Splat, channels: int
) -> None:
    """Drawn maps over a field's background, and flow, by kernels and by plain torch."""

    def plain(field: Splat, drawn: list[Tensor]) -> tuple[Render, Tensor]:
        maps = Maps(drawn[0].permute(1, 2, 0), drawn[1], drawn[2])
        render, extra = draw.composite(field.model(), maps)
        return render, extra / render.opacity.clamp_min(draw.MIN_ALPHA)[:, None]

    found = []
    for composite in (ours, plain):
        leaves = [m.clone().requires_grad_() for m in drawn_maps(channels)]
        render, flow = composite(field, leaves)
        values = [render.radiance, render.depth, render.motion, flow]
        values = [v for v in values if v.numel()]
        generator = torch.Generator().manual_seed(1)
        loss = sum((torch.randn(v.shape, generator=generator) * v).sum() for v in values)
        gradients = torch.autograd.grad(loss, [*leaves, field.background])
        found.append([*(v.detach() for v in values), *gradients])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


def compare_mixing(composite: Callable[..., tuple[Render, Tensor]], with_flow: bool) -> None:
    """What is recorded late, and its share, by kernels and by plain torch.

    `composite` takes a field, drawn maps, what is recorded of the background with the
    share of late mixing, and whether the maps hold flow.
    """
    first = 6 if with_flow else 4
    field, generator = random_field(), torch.Generator().manual_seed(2)

    def plain(planes: Tensor, depth: Tensor, alpha: Tensor, behind: Tensor, s: Tensor) -> Tensor:
        mixing = LateMixing()
        del mixing.share
        mixing.share = s
        render, extra = draw.composite(field.model(), Maps(planes.permute(1, 2, 0), depth, alpha))
        parts = Parts(extra, behind[None])
        late, share = mixing(parts, extra[:, first - 4 :], render)
        return torch.cat([render.radiance, late, share], 1)

    def ours(planes: Tensor, depth: Tensor, alpha: Tensor, behind: Tensor, s: Tensor) -> Tensor:
        render, flow = composite(field, [planes, depth, alpha], (behind, s), with_flow)
        assert render.late is not None and render.late_share is not None
        assert flow.shape == (len(render.late) if with_flow else 0, 2)
        return torch.cat([render.radiance, render.late, render.late_share], 1)

    behind, share = torch.rand(3, generator=generator), torch.tensor([0.3])
    compare(ours, plain, *drawn_maps(first + 3), behind, share)
