"""Encodings: multiresolution grids whose levels add up (numba on the CPU, plain torch
elsewhere) and frequency features.

Coordinates are in [0, 1]^3. PROTOTYPES: at equal CPU time, dense and hashed grids that
add up, with no network behind them, beat hash features with an MLP by 5-9 dB.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hdr_nsff.fields.kernels import grid as kernels

Shape = tuple[int, int, int, int]  # x, y, z grid points and time slices


class AdditiveGrid(nn.Module):
    """Four values at a point and a time: the sum over levels of trilinear (and linear
    in time) interpolation.

    `shapes` are the levels' grid points (x, y, z, slices); a level with more points
    than `max_rows` is hashed into `max_rows` rows. Slices are spread evenly over the
    knots 0 .. num_knots - 1; a static grid has one slice.
    """

    def __init__(self, shapes: list[Shape], num_knots: int = 1, max_rows: int = 2**19) -> None:
        super().__init__()
        self.num_knots = num_knots
        points = [math.prod(s) for s in shapes]
        rows = [min(n, max_rows) for n in points]
        self.res = np.array([s[:3] for s in shapes], np.int32)
        self.slices = [s[3] for s in shapes]
        self.size = np.array(rows, np.int64)
        assert max_rows & (max_rows - 1) == 0, f"max_rows must be a power of two, got {max_rows}"
        self.offset = np.concatenate([[0], np.cumsum(rows)[:-1]]).astype(np.int64)
        self.hashed = np.array([n > max_rows for n in points])
        self.table = nn.Parameter(torch.zeros(sum(rows), kernels.C))
        self.register_buffer(
            "touched", torch.zeros(sum(rows), dtype=torch.uint8), persistent=False
        )  # rows with a gradient

    touched: Tensor

    def at(self, knot: float) -> tuple[np.ndarray, np.ndarray]:
        """The two time slices (L, 2) of every level around `knot` and their weights (L,
        2).
        """
        index, weight = (
            np.zeros((len(self.res), 2), np.int32),
            np.zeros((len(self.res), 2), np.float32),
        )
        for level, count in enumerate(self.slices):
            position = min(max(knot / max(self.num_knots - 1, 1), 0.0), 1.0) * (count - 1)
            low = min(int(position), max(count - 2, 0))
            fraction = position - low
            if fraction < 1e-5 or fraction > 1 - 1e-5:  # on a knot: one slice, half the work
                low, fraction = round(position), 0.0
            index[level] = low, min(low + 1, count - 1)
            weight[level] = 1 - fraction, fraction
        return index, weight

    def forward(self, coords: Tensor, knot: float = 0.0) -> Tensor:
        """Values (N, 4) at `coords` (N, 3) in [0, 1] (outside values clamp) and one
        time, in knots.
        """
        slices, weights = self.at(knot)
        if coords.device.type == "cpu" and coords.dtype == torch.float32:
            return GridFunction.apply(coords, self.table, self.touched, self, slices, weights)
        return self.reference(coords, slices, weights)

    def spread_to(self, level: int, coords: Tensor, values: Tensor, knot: float = 0.0) -> Tensor:
        """Sum of `values` (N, 4) over the rows of one level, each shared among its
        eight grid points by trilinear weight: (rows, 4). CPU only.
        """
        slices, weights = self.at(knot)
        one = slice(level, level + 1)
        out = torch.zeros(int(self.size[level]), kernels.C)
        layout = (
            self.res[one],
            np.zeros(1, np.int64),
            self.size[one],
            self.hashed[one],
            slices[one],
            weights[one],
        )
        kernels.backward_table(
            coords.contiguous().numpy(),
            values.contiguous().numpy(),
            *layout,
            out.numpy(),
            np.zeros(len(out), np.uint8),
        )
        return out

    def rows_of(self, level: int) -> Tensor:
        """The rows of one level in the table, a view: (rows, 4)."""
        start = int(self.offset[level])
        return self.table.data[start : start + int(self.size[level])]

    def reference(self, coords: Tensor, slices: np.ndarray, weights: np.ndarray) -> Tensor:
        """The plain-torch twin of the kernels, for every device and dtype."""
        out = coords.new_zeros(len(coords), kernels.C)
        for level, resolution in enumerate(self.res):
            top = torch.as_tensor(resolution, device=coords.device) - 1
            position = coords.clamp(0, 1) * top
            low = torch.minimum(position.floor().long(), top - 1)
            fraction = position - low
            for s, w in zip(slices[level], weights[level], strict=True):
                if w == 0:
                    continue
                for corner in range(8):
                    d = torch.tensor(
                        [corner & 1, (corner >> 1) & 1, corner >> 2], device=coords.device
                    )
                    weight = float(w) * torch.where(d > 0, fraction, 1 - fraction).prod(-1)
                    out = out + weight[:, None] * self.table[self.rows(low + d, int(s), level)].to(
                        coords
                    )
        return out

    def rows(self, points: Tensor, s: int, level: int) -> Tensor:
        """Table rows of integer grid `points` (N, 3) of slice `s`."""
        x, y, z = points.unbind(-1)
        if self.hashed[level]:
            h = x ^ (y * kernels.PRIMES[1]) ^ (z * kernels.PRIMES[2]) ^ (s * kernels.PRIMES[3])
            row = h & (int(self.size[level]) - 1)
        else:
            nx, ny, nz = (int(n) for n in self.res[level])
            row = ((s * nz + z) * ny + y) * nx + x
        return row + int(self.offset[level])


class GridFunction(torch.autograd.Function):
    """Grid interpolation by numba, with gradients to the table and, where asked for, to
    the coordinates.

    The table's gradient is added to `table.grad` in place instead of being returned: a
    step asks the same large table several times, and a fresh gradient each time would
    cost more than the interpolation. Hence `backward()` only, not
    `torch.autograd.grad`.
    """

    @staticmethod
    def forward(
        ctx: Any,
        coords: Tensor,
        table: Tensor,
        touched: Tensor,
        grid: AdditiveGrid,
        slices: np.ndarray,
        weights: np.ndarray,
    ) -> Tensor:
        coords = coords.contiguous()
        ctx.save_for_backward(coords, table)
        ctx.touched = touched
        ctx.layout = (grid.res, grid.offset, grid.size, grid.hashed, slices, weights)
        out = torch.empty(len(coords), table.shape[1])
        kernels.forward(coords.detach().numpy(), table.detach().numpy(), *ctx.layout, out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        coords, table = ctx.saved_tensors
        grad_out = grads[0].contiguous().numpy()
        grad_coords = None
        if ctx.needs_input_grad[1]:
            if table.grad is None:
                table.grad = torch.zeros_like(table)
            kernels.backward_table(
                coords.detach().numpy(),
                grad_out,
                *ctx.layout,
                table.grad.numpy(),
                ctx.touched.numpy(),
            )
        if ctx.needs_input_grad[0]:
            grad_coords = torch.empty_like(coords)
            kernels.backward_coords(
                coords.detach().numpy(),
                table.detach().numpy(),
                grad_out,
                *ctx.layout,
                grad_coords.numpy(),
            )
        return grad_coords, None, None, None, None, None


class TouchedAdam(torch.optim.Optimizer):
    """Adam (Kingma & Ba 2015) that moves only table rows some ray crossed; the others
    keep their values and moments.

    Each group comes with `touched`, a list of (rows,) uint8 marks beside its
    parameters; a step clears marks and gradients.
    """

    def __init__(
        self,
        params: Any,
        lr: float = 1e-2,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-12,
    ) -> None:
        groups = [dict(g) for g in params]
        # outside the groups: `load_state_dict` copies those, and the marks must stay
        # the grids' own
        self.marks = {
            p: marks for g in groups for p, marks in zip(g["params"], g.pop("touched"), strict=True)
        }
        super().__init__(groups, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One step on every parameter that has a gradient."""
        assert closure is None
        for group in self.param_groups:
            (beta1, beta2), lr, eps = group["betas"], group["lr"], group["eps"]
            for p in group["params"]:
                state = self.state[p]
                if not state:
                    state.update(
                        step=torch.zeros(()),
                        exp_avg=torch.zeros_like(p),
                        exp_avg_sq=torch.zeros_like(p),
                    )
                state["step"] += (
                    # with or without a gradient, so that a resumed run counts like an
                    # unbroken one
                    1
                )
                if p.grad is None:
                    continue
                t = float(state["step"])
                c1, c2 = 1 - beta1**t, 1 - beta2**t
                m, v = state["exp_avg"], state["exp_avg_sq"]
                if p.device.type == "cpu":
                    table, grad, first, second, marks = (
                        a.detach().numpy() for a in (p, p.grad, m, v, self.marks[p])
                    )
                    kernels.adam_rows(
                        table, grad, first, second, marks, lr, beta1, beta2, eps, c1, c2
                    )
                    continue
                rows = (p.grad != 0).any(-1, keepdim=True)
                m.copy_(torch.where(rows, beta1 * m + (1 - beta1) * p.grad, m))
                v.copy_(torch.where(rows, beta2 * v + (1 - beta2) * p.grad**2, v))
                p.sub_(
                    torch.where(rows, lr * (m / c1) / ((v / c2).sqrt() + eps), torch.zeros_like(p))
                )
                p.grad.zero_()


def frequencies(x: Tensor, octaves: int) -> Tensor:
    """NeRF's position encoding with identity: (N, D) to (N, D * (1 + 2 * octaves)),
    frequencies 2^0 .. 2^(octaves - 1).
    """
    scaled = (
        x[..., None, :] * (2.0 ** torch.arange(octaves, device=x.device, dtype=x.dtype))[:, None]
    )
    return torch.cat([x, torch.cat([scaled.sin(), scaled.cos()], -1).flatten(-2)], -1)
