"""Drawn maps over the background by CUDA kernels, one launch forward and two back: the
twin of `draw.py:composite` in training.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.kernels.cuda.launch import blocks_for, few_blocks, few_zeros, launch
from hdr_nsff.fields.kernels.cuda.layout import THREADS
from hdr_nsff.fields.splat.rasterize import Maps


def fused_composite(
    maps: Maps,
    background: Tensor,
    late: tuple[Tensor, Tensor] | None,
    with_flow: bool,
    numbers: tuple[float, ...],
) -> tuple[Render, Tensor]:
    """The render of drawn `maps`, and flow (N or 0, 2); the arguments are those of
    `numba_picture.py:numba_composite`.
    """
    planes = maps.features.permute(2, 0, 1).flatten(1)
    alpha = maps.alpha.reshape(-1)
    mixing = late or (background.detach()[:0], background.detach()[:0])
    bounded, *lengths = numbers
    given = planes, maps.depth.reshape(-1), alpha, background, *mixing
    made = Compose.apply(*given, with_flow, (int(bounded), *map(float, lengths)))
    radiance, depth, motion, flow, *mixed = made
    render = Render(radiance, depth, alpha, motion)
    if late is not None:
        render = replace(render, late=mixed[0], late_share=mixed[1])
    return render, flow


class Compose(torch.autograd.Function):
    """Radiance (N, 3), depth (N,), motion (N,), flow, and what is recorded late with
    its share, of planes (D, N).
    """

    @staticmethod
    def forward(
        ctx: Any,
        planes: Tensor,
        depths: Tensor,
        alphas: Tensor,
        background: Tensor,
        behind: Tensor,
        share: Tensor,
        with_flow: bool,
        numbers: tuple[int | float, ...],
    ) -> tuple[Tensor, ...]:
        tensors = planes, depths, alphas, background, behind, share
        given = [t.detach().contiguous() for t in tensors]
        count = len(alphas)
        mixed = count if len(share) else 0
        made = (
            planes.new_empty(count, 3),
            planes.new_empty(count),
            planes.new_empty(count),
            planes.new_empty(count if with_flow else 0, 2),
            planes.new_empty(mixed, 3),
            planes.new_empty(mixed, 1),
        )
        launch("compose", blocks_for(count), THREADS, *given, *numbers, *made)
        ctx.given = *given, *numbers
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:
        planes, depths, alphas, background, behind, share, *_ = ctx.given
        made = [torch.empty_like(t) for t in (planes, depths, alphas)]
        sums = [few_zeros(t, len(t)) for t in (background, behind, share)]
        given = *ctx.given, *(g.contiguous() for g in grads)
        grid = few_blocks(len(alphas))
        launch("compose_backward", grid, THREADS, *given, *made, *sums)
        return *made, *sums, None, None
