"""The terms of whole frames by kernels: picture, depth, moving mask and flow in one
pass, their gradients in another. The plain-torch twin is `Objective.terms`.
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
from hdr_nsff.fields.kernels.cuda.launch import blocks_for, few_blocks, few_zeros, launch
from hdr_nsff.fields.kernels.cuda.layout import PICTURE_SUMS, THREADS
from hdr_nsff.fields.splat.cuda_backends import kernels_on
from hdr_nsff.maths.losses import MASK_MARGIN
from hdr_nsff.scene.batch import PixelBatch

TERM_NAMES = ("photometric", "depth", "mask", "flow")


def can_fuse(render: Render, batch: PixelBatch) -> bool:
    """Whether these are all terms that there are: of a whole frame that a field without
    branches draws, with flow to one neighbor at most.
    """
    warps = [warp for warp in render.warps if warp.offset in batch.flow]
    branches = render.dynamic_radiance is not None or render.scene_flow
    warped = any(warp.radiance is not None for warp in render.warps)
    return batch.whole and len(warps) <= 1 and not branches and not warped


def losses_by_kernels(rgb: Tensor) -> type[torch.autograd.Function] | None:
    """Which kernels compare a picture `rgb` with its recording, if any."""
    if kernels_on(rgb.device):
        return CudaLosses
    on_cpu = rgb.device.type == "cpu" and rgb.dtype == torch.float32
    return NumbaLosses if on_cpu else None


def fused_terms(
    losses: type[torch.autograd.Function],
    render: Render,
    rgb: Tensor,
    batch: PixelBatch,
    near: float,
    fade: float,
    limit: float,
) -> dict[str, Tensor]:
    """The terms of a whole frame whose picture is `rgb` (N, 3), by `CudaLosses` or, on
    the CPU, `NumbaLosses`.
    """
    nothing = rgb.detach()[:0, 0]
    no_flow, no_mask = rgb.detach()[:0, :2], rgb.new_empty(0, dtype=torch.uint8)
    flow, target, valid = no_flow, no_flow, no_mask
    for warp in render.warps:
        if warp.offset in batch.flow:
            flow, target = warp.flow, batch.flow[warp.offset]
            valid = batch.flow_valid[warp.offset].view(torch.uint8)
    known = (
        nothing if batch.disparity is None else batch.disparity,
        nothing if batch.disparity_confidence is None else batch.disparity_confidence,
        no_mask if batch.moving is None else batch.moving.view(torch.uint8),
        no_mask if batch.outline is None else batch.outline.view(torch.uint8),
        target,
        valid,
    )
    numbers = float(near), float(fade), MASK_MARGIN, float(limit)
    rendered = rgb, render.depth, render.motion, flow
    terms = losses.apply(*rendered, batch.rgb, known, numbers).unbind()[: len(TERM_NAMES)]
    has = True, batch.disparity is not None, batch.moving is not None, len(valid) > 0
    return {name: term for name, term, h in zip(TERM_NAMES, terms, has, strict=True) if h}


class CudaLosses(torch.autograd.Function):
    """The four terms of `TERM_NAMES`, 0 where what they compare with is missing, and
    two numbers that the kernels need (PICTURE_SUMS,).
    """

    @staticmethod
    def forward(
        ctx: Any,
        rgb: Tensor,
        depth: Tensor,
        motion: Tensor,
        flow: Tensor,
        recorded: Tensor,
        known: tuple[Tensor, ...],
        numbers: tuple[float, ...],
    ) -> Tensor:
        disparity, confidence, moving, outline, target, valid = known
        tensors = (
            *(rgb, recorded, depth, disparity, confidence, motion, moving, outline),
            *(flow, target, valid),
        )
        sums = few_zeros(rgb, PICTURE_SUMS)
        # `detach`: a result itself would hold on to its own graph
        ctx.given = *(t.detach().contiguous() for t in tensors), *numbers, sums.detach()
        grid = few_blocks(len(rgb))
        launch("losses", grid, THREADS, *ctx.given)
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_terms: Tensor) -> Any:
        rgb, flow = ctx.given[0], ctx.given[8]
        g_rgb, g_flow = torch.empty_like(rgb), torch.empty_like(flow)
        g_depth, g_motion = (torch.empty_like(rgb[:, 0]) for _ in range(2))
        made = g_rgb, g_depth, g_motion, g_flow
        grid = blocks_for(len(rgb))
        launch("losses_backward", grid, THREADS, *ctx.given, d_terms.contiguous(), *made)
        return *made, None, None, None


class NumbaLosses(torch.autograd.Function):
    """The four terms of `TERM_NAMES`, 0 where what they compare with is missing."""

    @staticmethod
    def forward(
        ctx: Any,
        rgb: Tensor,
        depth: Tensor,
        motion: Tensor,
        flow: Tensor,
        recorded: Tensor,
        known: tuple[Tensor, ...],
        numbers: tuple[float, ...],
    ) -> Tensor:
        near, fade, margin, limit = numbers
        given = [by_channel(t) for t in (rgb, depth, motion, flow)]
        given += [t.contiguous().numpy() for t in (recorded, *known)]
        sums = np.empty((kernels.CHUNKS, len(TERM_NAMES) + 1))
        kernels.losses(*given, margin, limit, sums)
        *totals, num_valid = sums.sum(0)
        num_valid = max(num_valid, 1.0)
        count = len(rgb)
        shares = 1 / (3 * count), near * fade / count, 1 / count, fade / num_valid
        ctx.given = *given, *numbers, num_valid
        return rgb.new_tensor([t * share for t, share in zip(totals, shares, strict=True)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_terms: Tensor) -> Any:
        made = [torch.from_numpy(np.empty_like(a)) for a in ctx.given[:4]]
        given = *ctx.given, d_terms.contiguous().numpy()
        kernels.losses_backward(*given, *(t.numpy() for t in made))
        return *made, None, None, None
