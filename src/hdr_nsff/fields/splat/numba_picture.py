"""Drawn planes over the background by numba kernels on the CPU, one pass forward and
one back: the twin of `draw.py:composite` in training, and of `fused_picture.py`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.core.tensors import by_channel
from hdr_nsff.fields.base import Render
from hdr_nsff.fields.kernels import picture as kernels
from hdr_nsff.fields.splat.rasterize import Planes


def numba_composite(
    drawn: Planes,
    background: Tensor,
    late: tuple[Tensor, Tensor] | None,
    with_flow: bool,
    numbers: tuple[float, ...],
) -> tuple[Render, Tensor]:
    """The render of what was `drawn`, and flow (N or 0, 2). The features are radiance,
    motion, flow, and what is recorded of the Gaussians.

    `background` (3,) is stored radiance. `late` is what is recorded of it (3,), and the
    share (1,) of late mixing; None without. `numbers` are whether radiance is bounded,
    the background's z-depth, the least z-depth, and the least alpha that has a depth.
    """
    alpha = drawn.alpha.reshape(-1)
    mixing = late or (background[:0], background[:0])
    made = Compose.apply(drawn.planes.flatten(1), alpha, background, *mixing, with_flow, numbers)
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
        alphas: Tensor,
        background: Tensor,
        behind: Tensor,
        share: Tensor,
        with_flow: bool,
        numbers: tuple[float, ...],
    ) -> tuple[Tensor, ...]:
        count = len(alphas)
        mixed = count if len(share) else 0
        made = (
            torch.empty(3, count).T,
            torch.empty(count),
            torch.empty(count),
            torch.empty(2, count if with_flow else 0).T,
            torch.empty(3, mixed).T,
            torch.empty(mixed, 1),
        )
        given = planes, alphas, background, behind, share
        ctx.given = [t.detach().contiguous().numpy() for t in given]
        ctx.numbers = [float(n) for n in numbers]
        kernels.compose(*ctx.given, *ctx.numbers, *(t.numpy() for t in made))
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:
        *drawn, share = ctx.given
        planes, alphas, *_ = drawn
        given = [by_channel(g) for g in grads]
        g_planes, g_alphas = torch.empty(planes.shape), torch.empty(alphas.shape)
        sums = np.empty((kernels.CHUNKS, 7))
        bounded, _, *least = ctx.numbers
        made = g_planes.numpy(), g_alphas.numpy(), sums
        kernels.compose_backward(*drawn, bounded, *least, *given, *made)
        totals = torch.from_numpy(sums.sum(0).astype(np.float32))
        of_late = (totals[3:6], totals[6:]) if len(share) else (None, None)
        return g_planes, g_alphas, totals[:3], *of_late, None, None
