"""The Gaussians of a training moment by numba kernels on the CPU: motion, activations,
flow to a neighbor and the terms of single Gaussians in one pass, their gradients in
another.

Plain torch takes about 200 operations for this, each over all Gaussians. It stays what
the shared motions need, which are few, and what view dependence, shutters and corrected
cameras need. `fused_cloud.py` is the twin on a GPU.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.fields.kernels import cloud as kernels
from hdr_nsff.fields.kernels.moment import TERMS
from hdr_nsff.fields.splat.local_gaussians import LocalGaussians
from hdr_nsff.fields.splat.model import Model
from hdr_nsff.fields.splat.moment import TERM_NAMES, Cloud, Moment, split_parameters
from hdr_nsff.fields.splat.terms import mixture_difference


def numba_cloud(model: Model, moment: Moment, alive: Tensor) -> Cloud:
    """Static and moving Gaussians of a moment, and the time-local ones `alive` (A,).

    Marks the rows of trajectories and time-local Gaussians that get gradients.
    """
    knots = [moment.knot] if moment.neighbor is None else [moment.knot, moment.neighbor[0]]
    poses = torch.stack([model.trajectories.pose_numbers(k) for k in knots])
    model.trajectories.mark(moment.knot)
    static, moving, _, _ = split_parameters(list(model.parameters()))
    learned = *static, *moving[:7], moving[7].softmax(0), poses
    *made, sums = MakeCloud.apply(model, moment, alive, *learned)
    means, quaternions, scales, opacities, features = made
    terms = dict(zip(TERM_NAMES, sums.unbind(), strict=True))
    terms["trajectory"] = model.trajectories.roughness(moment.knot, model.unit)
    if moment.rigidity:
        terms["rigidity"] = mixture_difference(model.mixture_logits, model.neighbors)
    else:
        del terms["rigidity"], terms["evenness"]
    return Cloud(means, quaternions, scales, opacities, features, terms)


class MakeCloud(torch.autograd.Function):
    """The tensors of `Cloud`, and its terms as one (TERMS,).

    Gradients of time-local tables are added where these lie, as by `TakeRows`.
    """

    @staticmethod
    def forward(
        ctx: Any, model: Model, moment: Moment, alive: Tensor, *learned: Tensor
    ) -> tuple[Tensor, ...]:
        local = model.local
        camera = moment.camera
        neighbor = moment.neighbor[2] if moment.neighbor else camera
        sight = (
            np.array(moment.numbers(model)),
            *arrays(camera.K, camera.c2w, neighbor.K, neighbor.c2w),
        )
        tables = arrays(*(getattr(local, name) for name in local.table_names()))
        of_local = *tables, alive.numpy(), local.neighbors.numpy()
        count = len(model.static) + len(model.moving) + len(alive)
        columns = (3, 4, 3, 1, 6 if moment.neighbor else 4)
        made = [torch.empty(count, c) for c in columns]
        made[3] = made[3][:, 0]
        sums = np.zeros((kernels.num_chunks(count), TERMS))
        inputs = arrays(*learned)
        kernels.forward(*inputs, *of_local, *sight, *arrays(*made), sums)
        ctx.inputs, ctx.rest, ctx.local = inputs, (*of_local, *sight), local
        return *made, torch.from_numpy(sums.sum(0).astype(np.float32))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:
        means, _, *others, poses = ctx.inputs  # quaternions of static ones are not needed
        given = arrays(*grads)
        made = [torch.empty(a.shape) for a in ctx.inputs[:-1]]
        g_poses = np.zeros((kernels.num_chunks(len(given[0])), *poses.shape))
        kernels.backward(
            means, *others, poses, *ctx.rest, *given, *arrays(*made), g_poses,
            *gradients_and_marks(ctx.local),
        )  # fmt: skip
        of_poses = torch.from_numpy(g_poses.sum(0).astype(np.float32))
        return None, None, None, *made, of_poses


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """Tensors of the CPU as arrays, one after the other in memory."""
    return [t.detach().contiguous().numpy() for t in tensors]


def gradients_and_marks(local: LocalGaussians) -> list[np.ndarray]:
    """The gradients of the five tables, then the marks of their rows, as arrays."""
    gradients, marks = [], []
    for name in local.table_names():
        table = getattr(local, name)
        if table.grad is None:
            table.grad = torch.zeros_like(table)
        gradients.append(table.grad.numpy())
        marks.append(getattr(local, f"{name}_touched").numpy())
    return gradients + marks
