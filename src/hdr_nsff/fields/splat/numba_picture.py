"""Drawn planes over the background by numba kernels on the CPU, one pass forward and
one back: the twin of `draw.py:composite` in training, and of `fused_picture.py`.
"""

from __future__ import annotations

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
    with_flow: bool,
    with_late: bool,
    numbers: tuple[float, ...],
) -> tuple[Render, Tensor, Tensor]:
    """The render of what was `drawn`, flow (N or 0, 2), and what is recorded of the
    Gaussians (N or 0, 3). The features are radiance, motion, flow, recorded.

    `background` (3,) is stored radiance; `numbers` are whether it is bounded, the
    background's z-depth, the least z-depth, and the least alpha that has a depth.
    """
    alpha = drawn.alpha.reshape(-1)
    parts = with_flow, with_late
    made = Compose.apply(drawn.planes.flatten(1), alpha, background, parts, numbers)
    radiance, depth, motion, flow, late = made
    return Render(radiance, depth, alpha, motion), flow, late


class Compose(torch.autograd.Function):
    """Radiance (N, 3), depth (N,), motion (N,), flow and recorded, of planes (D, N)."""

    @staticmethod
    def forward(
        ctx: Any,
        planes: Tensor,
        alphas: Tensor,
        background: Tensor,
        parts: tuple[bool, bool],
        numbers: tuple[float, ...],
    ) -> tuple[Tensor, ...]:
        count = len(alphas)
        with_flow, with_late = parts
        made = (
            torch.empty(3, count).T,
            torch.empty(count),
            torch.empty(count),
            torch.empty(2, count if with_flow else 0).T,
            torch.empty(3, count if with_late else 0).T,
        )
        ctx.given = [t.detach().contiguous().numpy() for t in (planes, alphas, background)]
        ctx.numbers = [float(n) for n in numbers]
        kernels.compose(*ctx.given, *ctx.numbers, *(t.numpy() for t in made))
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:
        planes, alphas, _ = ctx.given
        given = [by_channel(g) for g in grads]
        g_planes, g_alphas = torch.empty(planes.shape), torch.empty(alphas.shape)
        g_background = np.empty((kernels.CHUNKS, 3))
        bounded, _, *least = ctx.numbers
        made = g_planes.numpy(), g_alphas.numpy(), g_background
        kernels.compose_backward(*ctx.given, bounded, *least, *given, *made)
        of_background = torch.from_numpy(g_background.sum(0).astype(np.float32))
        return g_planes, g_alphas, of_background, None, None
