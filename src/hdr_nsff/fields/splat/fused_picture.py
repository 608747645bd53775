"""Drawn maps over the background by CUDA kernels, one launch forward and two back: the
twin of `draw.py:composite` in training.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.kernels.cuda.launch import blocks_for, few_zeros, launch
from hdr_nsff.fields.kernels.cuda.layout import MAX_BLOCKS, THREADS
from hdr_nsff.fields.splat.rasterize import Maps


def fused_composite(
    maps: Maps, background: Tensor, bounded: bool, far: float, least: float, least_alpha: float
) -> tuple[Render, Tensor]:
    """The render of drawn `maps`, and the flow (N, 2) where they hold it.

    `background` (3,) is stored radiance; where alpha is at most `least_alpha`, the
    depth is `far`, and nowhere is it below `least`.
    """
    planes = maps.features.permute(2, 0, 1).flatten(1)
    alpha = maps.alpha.reshape(-1)
    numbers = int(bounded), float(far), float(least), float(least_alpha)
    made = Compose.apply(planes, maps.depth.reshape(-1), alpha, background, numbers)
    radiance, depth, motion, flow = made
    return Render(radiance, depth, alpha, motion), flow


class Compose(torch.autograd.Function):
    """Radiance (N, 3), depth (N,), motion (N,) and flow (N, 2), of planes (D, N)."""

    @staticmethod
    def forward(
        ctx: Any,
        planes: Tensor,
        depths: Tensor,
        alphas: Tensor,
        background: Tensor,
        numbers: tuple[int | float, ...],
    ) -> tuple[Tensor, ...]:
        given = [t.detach().contiguous() for t in (planes, depths, alphas, background)]
        count = len(alphas)
        flow = planes.new_empty(count if len(planes) > 4 else 0, 2)
        made = planes.new_empty(count, 3), planes.new_empty(count), planes.new_empty(count), flow
        launch("compose", blocks_for(count), THREADS, *given, *numbers, *made)
        ctx.given = *given, *numbers
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:
        planes, depths, alphas, background, *_ = ctx.given
        made = [torch.empty_like(t) for t in (planes, depths, alphas)]
        g_background = few_zeros(background, 3)
        given = *ctx.given, *(g.contiguous() for g in grads)
        grid = min(blocks_for(len(alphas))[0], MAX_BLOCKS), 1
        launch("compose_backward", grid, THREADS, *given, *made, g_background)
        return *made, g_background, None
