"""Encodings: multiresolution grids whose levels add up, and frequency features.

Coordinates are in [0, 1]^3. No network follows a grid: at equal CPU time, dense and
hashed grids that add up beat hash features with an MLP (Müller et al. 2022) by 5 to 9
dB on rendered scenes. Grids run as numba kernels on the CPU, as CUDA kernels on GPUs,
and as plain torch elsewhere.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hdr_nsff.core.tensors import constant
from hdr_nsff.fields.kernels import grid as kernels
from hdr_nsff.fields.kernels.cuda.launch import blocks_for, launch
from hdr_nsff.fields.kernels.cuda.layout import ADAM_TABLES, THREADS
from hdr_nsff.fields.nsff.fused_grid import GridFunctionCuda, Layout
from hdr_nsff.fields.splat.cuda_backends import kernels_on

Shape = tuple[int, int, int, int]  # x, y, z grid points and time slices
ON_SLICE = 1e-5  # of a slice's distance: a time this near to a slice reads it alone


class AdditiveGrid(nn.Module):
    """Four values at a point and a time: a sum of interpolations over levels.

    Interpolation is trilinear in space and linear in time. `shapes` are the levels'
    grid points (x, y, z, slices); a level with more points than `max_rows` (a power of
    two) is hashed into `max_rows` rows. Slices are spread evenly over the knots 0 ..
    num_knots - 1; a static grid has one slice.
    """

    touched: Tensor

    def __init__(self, shapes: list[Shape], num_knots: int = 1, max_rows: int = 2**19) -> None:
        super().__init__()
        assert max_rows & (max_rows - 1) == 0, f"max_rows must be a power of two, got {max_rows}"
        self.num_knots = num_knots
        points = [math.prod(s) for s in shapes]
        rows = [min(n, max_rows) for n in points]
        self.res = np.array([s[:3] for s in shapes], np.int32)
        self.slices = [s[3] for s in shapes]
        self.size = np.array(rows, np.int64)
        self.offset = np.concatenate([[0], np.cumsum(rows)[:-1]]).astype(np.int64)
        self.hashed = np.array([n > max_rows for n in points])
        self.table = nn.Parameter(torch.zeros(sum(rows), kernels.CHANNELS))
        touched = torch.zeros(sum(rows), dtype=torch.uint8)  # rows with a gradient
        self.register_buffer("touched", touched, persistent=False)

    def time_slices(self, knot: float) -> tuple[np.ndarray, np.ndarray]:
        """Two time slices (L, 2) of every level around `knot`, and weights (L, 2)."""
        index = np.zeros((len(self.res), 2), np.int32)
        weight = np.zeros((len(self.res), 2), np.float32)
        share = min(max(knot / max(self.num_knots - 1, 1), 0.0), 1.0)
        for level, count in enumerate(self.slices):
            position = share * (count - 1)
            low = min(int(position), max(count - 2, 0))
            fraction = position - low
            if fraction < ON_SLICE or fraction > 1 - ON_SLICE:  # one slice is half the work
                low, fraction = round(position), 0.0
            index[level] = low, min(low + 1, count - 1)
            weight[level] = 1 - fraction, fraction
        return index, weight

    def forward(self, coords: Tensor, knot: float = 0.0) -> Tensor:
        """Values (N, 4) at `coords` (N, 3) and one time, in knots.

        Coordinates are in [0, 1]; others are clamped.
        """
        slices, weights = self.time_slices(knot)
        if coords.device.type == "cpu" and coords.dtype == torch.float32:
            return GridFunction.apply(coords, self.table, self.touched, self, slices, weights)
        if coords.dtype == torch.float32 and kernels_on(coords.device):
            layout = self.layout_on(coords.device, slices, weights)
            return GridFunctionCuda.apply(coords, self.table, self.touched, layout)
        return self.reference(coords, slices, weights)

    def layout_on(self, device: torch.device, slices: np.ndarray, weights: np.ndarray) -> Layout:
        """Where CUDA kernels find what is read of these time slices (L, 2)."""
        rows = self.offset, self.size, self.hashed
        levels = np.column_stack([self.res.astype(np.int64), *rows])

        def table(values: np.ndarray, dtype: torch.dtype) -> Tensor:
            numbers = tuple(values.ravel().tolist())
            return constant(numbers, device, dtype).view(values.shape)

        whole = torch.int64
        return Layout(table(levels, whole), table(slices, whole), table(weights, torch.float32))

    def scatter_level(
        self, level: int, coords: Tensor, values: Tensor, knot: float = 0.0
    ) -> Tensor:
        """The transpose of interpolation at one level: (rows, 4).

        `values` (N, 4) at `coords` (N, 3) are each shared among their eight grid points
        by trilinear weight and added up. CPU only.
        """
        slices, weights = self.time_slices(knot)
        one = slice(level, level + 1)
        out = torch.zeros(int(self.size[level]), kernels.CHANNELS)
        kernels.backward_table(
            coords.contiguous().numpy(),
            values.contiguous().numpy(),
            self.res[one],
            np.zeros(1, np.int64),  # the level's offset in `out`
            self.size[one],
            self.hashed[one],
            slices[one],
            weights[one],
            out.numpy(),
            np.zeros(len(out), np.uint8),
        )
        return out

    def rows_of(self, level: int) -> Tensor:
        """The rows of one level, a view of the table: (rows, 4)."""
        start = int(self.offset[level])
        return self.table.data[start : start + int(self.size[level])]

    def reference(self, coords: Tensor, slices: np.ndarray, weights: np.ndarray) -> Tensor:
        """The plain-torch twin of the kernels, for every device and dtype."""
        out = coords.new_zeros(len(coords), kernels.CHANNELS)
        for level, resolution in enumerate(self.res):
            top = constant(tuple(resolution.tolist()), coords.device, torch.int64) - 1
            position = coords.clamp(0, 1) * top
            low = torch.minimum(position.nan_to_num().floor().long(), top - 1)
            fraction = position - low
            for s, slice_weight in zip(slices[level], weights[level], strict=True):
                if slice_weight == 0:
                    continue
                for corner in range(8):
                    upper = (corner & 1, (corner >> 1) & 1, corner >> 2)
                    d = constant(upper, coords.device, torch.int64)
                    along = torch.where(d > 0, fraction, 1 - fraction)
                    weight = float(slice_weight) * along.prod(-1)
                    values = self.table[self.table_rows(low + d, int(s), level)].to(coords)
                    out = out + weight[:, None] * values
        return out

    def table_rows(self, points: Tensor, s: int, level: int) -> Tensor:
        """Table rows (N,) of integer grid `points` (N, 3) of slice `s`."""
        x, y, z = points.unbind(-1)
        if self.hashed[level]:
            _, prime_y, prime_z, prime_time = kernels.PRIMES
            h = x ^ (y * prime_y) ^ (z * prime_z) ^ (s * prime_time)
            row = h & (int(self.size[level]) - 1)
        else:
            nx, ny, nz = (int(n) for n in self.res[level])
            row = ((s * nz + z) * ny + y) * nx + x
        return row + int(self.offset[level])


class GridFunction(torch.autograd.Function):
    """Grid interpolation by numba, with gradients of the table and the coordinates.

    The table's gradient is added to `table.grad` in place instead of being returned: a
    step reads the same large table several times, and a fresh gradient each time would
    cost more than the interpolation. Hence `backward()` only, not
    `torch.autograd.grad`. Coordinates get a gradient where they require one.
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
        saved_coords, saved_table = ctx.saved_tensors
        coords, table = saved_coords.detach().numpy(), saved_table.detach().numpy()
        grad_out = grads[0].contiguous().numpy()
        needs_coords, needs_table = ctx.needs_input_grad[:2]
        if needs_table:
            if saved_table.grad is None:
                saved_table.grad = torch.zeros_like(saved_table)
            grad_table, touched = saved_table.grad.numpy(), ctx.touched.numpy()
            kernels.backward_table(coords, grad_out, *ctx.layout, grad_table, touched)
        grad_coords = None
        if needs_coords:
            grad_coords = torch.empty_like(saved_coords)
            kernels.backward_coords(coords, table, grad_out, *ctx.layout, grad_coords.numpy())
        return grad_coords, None, None, None, None, None


class TouchedAdam(torch.optim.Optimizer):
    """Adam (Kingma and Ba 2015) that moves only table rows that have a gradient.

    The others keep their values and moments. Each group comes with `touched`, a list of
    (rows,) uint8 marks, one for each of its parameters (rows, 4); a step clears marks
    and gradients.
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
        self.marks: dict[Tensor, Tensor] = {}
        for group in groups:
            self.marks |= dict(zip(group["params"], group.pop("touched"), strict=True))
        super().__init__(groups, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One step on every parameter that has a gradient."""
        assert closure is None
        moved: list[tuple[Tensor, dict[str, Any]]] = []
        for group in self.param_groups:
            for p in group["params"]:
                state = self.state[p]
                if not state:
                    state["step"] = torch.zeros(())
                    state["exp_avg"] = torch.zeros_like(p)
                    state["exp_avg_sq"] = torch.zeros_like(p)
                # with or without a gradient, so that a resumed run counts like an
                # unbroken one
                state["step"] += 1
                if p.grad is not None:
                    moved.append((p, group))
        if moved and kernels_on(moved[0][0].device):
            self.launch_updates(moved)
            return
        for p, group in moved:
            self.update(p, group)

    def launch_updates(self, moved: list[tuple[Tensor, dict[str, Any]]]) -> None:
        """`update` by a CUDA kernel, of several parameters at a time."""
        batches: dict[tuple[float, ...], list[tuple[Any, ...]]] = {}
        for p, group in moved:
            assert p.grad is not None
            state, t = self.state[p], float(self.state[p]["step"])
            tensors = p.detach(), p.grad.contiguous(), state["exp_avg"], state["exp_avg_sq"]
            given = *tensors, self.marks[p], float(group["lr"]), float(group["eps"])
            batches.setdefault((*group["betas"], t), []).append(given)
            p.grad = None  # the next one is taken as it is, not added to zeros
        for (beta1, beta2, t), tables in batches.items():
            numbers = beta1, beta2, 1 - beta1**t, 1 - beta2**t
            for first in range(0, len(tables), ADAM_TABLES):
                batch = tables[first : first + ADAM_TABLES]
                rows = max(len(table[0]) for table in batch)
                missing = *(tensor[:0] for tensor in batch[0][:5]), 0.0, 0.0
                batch += [missing] * (ADAM_TABLES - len(batch))
                flat = [value for table in batch for value in table]
                launch("adam_rows", blocks_for(rows), THREADS, *flat, *numbers)

    def update(self, p: Tensor, group: dict[str, Any]) -> None:
        """Move the touched rows of a parameter (rows, 4), clear marks and gradient."""
        beta1, beta2 = group["betas"]
        lr, eps = group["lr"], group["eps"]
        state = self.state[p]
        m, v = state["exp_avg"], state["exp_avg_sq"]
        t = float(state["step"])
        correction1, correction2 = 1 - beta1**t, 1 - beta2**t
        assert p.grad is not None
        if p.device.type == "cpu":
            tensors = (p, p.grad, m, v, self.marks[p])
            arrays = [tensor.detach().numpy() for tensor in tensors]
            kernels.adam_rows(*arrays, lr, beta1, beta2, eps, correction1, correction2)
            return
        rows = (p.grad != 0).any(-1, keepdim=True)
        m.copy_(torch.where(rows, beta1 * m + (1 - beta1) * p.grad, m))
        v.copy_(torch.where(rows, beta2 * v + (1 - beta2) * p.grad**2, v))
        change = lr * (m / correction1) / ((v / correction2).sqrt() + eps)
        p.sub_(torch.where(rows, change, torch.zeros_like(p)))
        p.grad.zero_()


def frequencies(x: Tensor, octaves: int) -> Tensor:
    """NeRF's positional encoding, with identity: (N, D) to (N, D * (1 + 2 * octaves)).

    Mildenhall et al. 2020, eq. 4, without the factor pi: frequencies are 2^0 ..
    2^(octaves - 1).
    """
    scales = 2.0 ** torch.arange(octaves, device=x.device, dtype=x.dtype)
    scaled = x[..., None, :] * scales[:, None]  # (N, octaves, D)
    waves = torch.cat([scaled.sin(), scaled.cos()], -1)  # (N, octaves, 2 D)
    return torch.cat([x, waves.flatten(-2)], -1)
