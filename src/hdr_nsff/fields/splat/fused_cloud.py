"""The Gaussians of a training moment by CUDA kernels: motion, activations, flow to a
neighbor and the field's own terms in one launch, their gradients in four.

Plain torch takes about 300 launches for this (`cloud.py:cloud_at`, flow and terms),
each of them shorter than a launch takes. It stays what view dependence, shutters and
corrected cameras need. `numba_cloud.py` is the twin on the CPU.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hdr_nsff.core.tensors import constant
from hdr_nsff.fields.kernels.cuda.launch import blocks_for, few_zeros, launch
from hdr_nsff.fields.kernels.cuda.layout import THREADS
from hdr_nsff.fields.kernels.moment import POSE, TERMS
from hdr_nsff.fields.splat.model import Model
from hdr_nsff.fields.splat.moment import EVERY_STEP, TERM_NAMES, Cloud, Moment, split_parameters


def fused_cloud(model: Model, moment: Moment, alive: Tensor) -> Cloud:
    """Static and moving Gaussians of a moment, and the time-local ones `alive` (A,).

    Marks the rows of trajectories and time-local Gaussians that get gradients.
    """
    *made, terms = MakeCloud.apply(model, moment, alive, *model.parameters())
    named = dict(zip(TERM_NAMES, terms.unbind(), strict=False))
    means, quaternions, scales, opacities, features = made
    return Cloud(means, quaternions, scales, opacities, features, named)


class MakeCloud(torch.autograd.Function):
    """The tensors of `Cloud`, its terms as one."""

    @staticmethod
    def forward(
        ctx: Any, model: Model, moment: Moment, alive: Tensor, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        learned = [p.detach().contiguous() for p in parameters]
        first = learned[0]
        numbers = constant(moment.numbers(model), first.device, torch.float64)
        camera = moment.camera
        neighbor = moment.neighbor[2] if moment.neighbor else camera
        views = [v.detach().contiguous() for v in (camera.K, camera.c2w, neighbor.K, neighbor.c2w)]
        count = len(model.static) + len(model.moving) + len(alive)
        columns = (3, 4, 3, 1, 6 if moment.neighbor else 4)
        made = [first.new_empty(count, c) for c in columns]
        made[3] = made[3][:, 0]
        terms = few_zeros(first, TERMS if moment.rigidity else EVERY_STEP)
        rest, tables = learned[:16], learned[16:]
        shared = alive, model.neighbors, model.local.neighbors, numbers, *views
        centers = model.trajectories.centers
        grid = blocks_for(max(count, len(centers)))
        launch("cloud", grid, THREADS, *rest, centers, *tables, *shared, *made, terms)
        ctx.model, ctx.alive, ctx.learned = model, alive, learned
        ctx.sight, ctx.with_flow = (numbers, *views), moment.neighbor is not None
        return *made, terms

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        model, alive, learned = ctx.model, ctx.alive, ctx.learned
        given = [g.contiguous() for g in grads]
        static, moving, poses, tables = split_parameters(learned)
        t, local, num_bases = model.trajectories, model.local, len(model.mixture_logits)
        of_bases = torch.Size((2 * num_bases, POSE))
        sizes = [moving[7].shape, *(p.shape for p in (*poses, *tables)), of_bases]
        g_mixture, *g_rows, sums = zeros(static[0], sizes)
        g_static = [torch.empty_like(p) for p in static]
        g_moving = [*(torch.empty_like(p) for p in moving[:7]), g_mixture]
        means, _, *others = static
        launch(
            "static_backward", blocks_for(len(means)), THREADS,
            means, *others, *ctx.sight, *given, *g_static,
        )  # fmt: skip
        neighbors, centers = model.neighbors, t.centers
        motion = *poses, centers
        launch(
            "moving_backward", blocks_for(len(model.moving)), THREADS,
            *moving, *motion, neighbors, len(means), *ctx.sight, *given, *g_moving, sums,
        )  # fmt: skip
        launch(
            "trajectory_backward", blocks_for(num_bases), THREADS, *motion, ctx.sight[0],
            int(ctx.with_flow), sums, given[5], *g_rows[:2],
            t.rotations_touched, t.translations_touched,
        )  # fmt: skip
        marks = [getattr(local, f"{name}_touched") for name in local.table_names()]
        before = len(means) + len(model.moving)
        launch(
            "local_backward", blocks_for(len(alive)), THREADS, *tables, alive,
            local.neighbors, before, *ctx.sight, *given, *g_rows[2:], *marks,
        )  # fmt: skip
        return None, None, None, *g_static, *g_moving, *g_rows


def zeros(like: Tensor, sizes: list[torch.Size]) -> list[Tensor]:
    """Zeros of these sizes, by one launch."""
    counts = [size.numel() for size in sizes]
    parts = like.new_zeros(sum(counts)).split(counts)
    return [part.view(size) for part, size in zip(parts, sizes, strict=True)]
