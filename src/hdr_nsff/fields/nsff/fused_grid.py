"""Grid interpolation by CUDA kernels, one launch forward and two back: the twin of
`encodings.GridFunction` on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.fields.kernels.cuda.launch import blocks_for, launch
from hdr_nsff.fields.kernels.cuda.layout import THREADS
from hdr_nsff.fields.kernels.grid import CHANNELS


@dataclass(frozen=True)
class Layout:
    """Where in its table a grid keeps what is read at one time, on the device."""

    levels: Tensor  # (L, 6) int64, as in `grid_kernels.py`
    slices: Tensor  # (L, 2) int64
    weights: Tensor  # (L, 2) of the slices

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """All of them, in this order."""
        return self.levels, self.slices, self.weights


class GridFunctionCuda(torch.autograd.Function):
    """Values (N, 4) of a `table` at `coords` (N, 3), and gradients of both.

    As on the CPU, the table's gradient is added to `table.grad` in place, and rows that
    get one are marked in `touched` (rows,). It is a sum in no fixed order.
    """

    @staticmethod
    def forward(ctx: Any, coords: Tensor, table: Tensor, touched: Tensor, layout: Layout) -> Tensor:
        coords = coords.contiguous()
        ctx.save_for_backward(coords, table)
        ctx.touched, ctx.layout = touched, layout
        out = coords.new_empty(len(coords), CHANNELS)
        given = coords.detach(), table.detach(), *layout.tensors()
        launch("interpolate", blocks_for(len(coords)), THREADS, *given, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_out: Tensor) -> Any:
        coords, table = ctx.saved_tensors
        d_out, layout = d_out.float().contiguous(), ctx.layout.tensors()
        needs_coords, needs_table = ctx.needs_input_grad[:2]
        blocks, _ = blocks_for(len(coords))
        if needs_table:
            if table.grad is None:
                table.grad = torch.zeros_like(table)
            grid = blocks, len(layout[0])
            made = table.grad, ctx.touched
            launch("table_backward", grid, THREADS, coords, d_out, *layout, *made)
        if not needs_coords:
            return None, None, None, None
        g_coords = torch.empty_like(coords)
        given = coords, table.detach(), d_out, *layout
        launch("coords_backward", (blocks, 1), THREADS, *given, g_coords)
        return g_coords, None, None, None
