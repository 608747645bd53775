"""Gain, response curve and vignetting on NVIDIA GPUs, one launch forward and two back:
the twins of `kernel.py` and `vignetting.py` that our CUDA kernels compute.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.fields.kernels.cuda.launch import blocks_for, few_zeros, launch
from hdr_nsff.fields.kernels.cuda.layout import MAX_BLOCKS, MAX_KNOTS, THREADS


def few_blocks(count: int) -> tuple[int, int]:
    """The grid of a kernel whose threads may take several of `count` pixels each."""
    return min(blocks_for(count)[0], MAX_BLOCKS), 1


class RespondCuda(torch.autograd.Function):
    """`kernel.Respond` on a GPU, without its table of bins."""

    @staticmethod
    def forward(
        ctx: Any,
        radiance: Tensor,
        gain: Tensor,
        values: Tensor,
        knots: Tensor,
        leak: float | None,
    ) -> Tensor:
        assert len(knots) <= MAX_KNOTS, len(knots)
        saved = [t.detach().contiguous() for t in (radiance, gain, values, knots)]
        ctx.save_for_backward(*saved)
        ctx.ends = int(leak is not None), float(leak or 0)
        rgb = torch.empty_like(saved[0])
        launch("respond", blocks_for(len(rgb)), THREADS, *saved, *ctx.ends, rgb)
        return rgb

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_rgb: Tensor) -> Any:
        radiance, gain, values, knots = ctx.saved_tensors
        g_radiance = torch.empty_like(radiance)
        g_gain, g_values = few_zeros(gain, 3), few_zeros(values, *values.shape)
        given = radiance, gain, values, knots, *ctx.ends, d_rgb.contiguous()
        grid = few_blocks(len(radiance))
        launch("respond_backward", grid, THREADS, *given, g_radiance, g_gain, g_values)
        return g_radiance, g_gain, g_values, None, None


class ShadeCuda(torch.autograd.Function):
    """Radiance (N, 3) at `pixels` (N, 2) that the lens of camera `camera_id` passes.

    `corners` and `coefficients` are those of `Vignetting`, `K` (3, 3) is the camera's;
    no less than the share `least` passes.
    """

    @staticmethod
    def forward(
        ctx: Any,
        radiance: Tensor,
        coefficients: Tensor,
        pixels: Tensor,
        K: Tensor,
        corners: Tensor,
        camera_id: int,
        least: float,
    ) -> Tensor:
        tensors = radiance, pixels, K, corners, coefficients
        ctx.given = *(t.detach().contiguous() for t in tensors), camera_id, least
        shaded = torch.empty_like(ctx.given[0])
        launch("shade", blocks_for(len(shaded)), THREADS, *ctx.given, shaded)
        return shaded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_shaded: Tensor) -> Any:
        radiance, coefficients = ctx.given[0], ctx.given[4]
        g_radiance, g = torch.empty_like(radiance), few_zeros(radiance, *coefficients.shape)
        grid = few_blocks(len(radiance))
        given = *ctx.given, d_shaded.contiguous(), g_radiance, g
        launch("shade_backward", grid, THREADS, *given)
        return g_radiance, g, None, None, None, None, None
