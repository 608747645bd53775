"""The optimizers of a run: Adam, and for grids and trajectories an Adam that moves only
the rows a step has touched.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.fields.nsff.encodings import TouchedAdam
from hdr_nsff.fields.splat.cuda_backends import kernels_on
from hdr_nsff.training.kernel_adam import KernelAdam


class Optimizers:
    """Optimizers over parameter groups, by name: "dense" and "touched".

    The parameters and their marks stay on the device where they are.
    """

    def __init__(self, groups: Sequence[ParamGroup]) -> None:
        dense = [group for group in groups if group.row_marks is None]
        touched = [group for group in groups if group.row_marks is not None]
        self.by_name: dict[str, torch.optim.Optimizer] = {}
        if dense:  # grids without a tone mapper have nothing dense
            by_kernel = kernels_on(dense[0].params[0].device)
            options = [as_dict(group) for group in dense]
            self.by_name["dense"] = (
                KernelAdam(options) if by_kernel else torch.optim.Adam(options, fused=True)
            )
        if touched:
            self.by_name["touched"] = TouchedAdam([as_dict(g) for g in touched])
        self.groups = {"dense": dense, "touched": touched}
        # marks (rows,) of rows with a gradient, of any process
        self.row_marks = [marks for group in touched for marks in group.row_marks or ()]

    def parameters(self) -> Iterator[Tensor]:
        """Everything that is learned."""
        for optimizer in self.by_name.values():
            for group in optimizer.param_groups:
                yield from group["params"]

    def step(self, lr_share: float, progress: float) -> None:
        """One step at rates of `lr_share` of their start; gradients are cleared."""
        for name, optimizer in self.by_name.items():
            for state, group in zip(optimizer.param_groups, self.groups[name], strict=True):
                started = progress >= group.start
                state["lr"] = group.lr * lr_share * started
            optimizer.step()
            if name == "dense":  # the touched one clears what it used
                optimizer.zero_grad()


def as_dict(group: ParamGroup) -> dict[str, Any]:
    """A group as torch's optimizers take it."""
    options: dict[str, Any] = {"params": list(group.params), "lr": group.lr}
    if group.betas is not None:
        options["betas"] = group.betas
    if group.eps is not None:
        options["eps"] = group.eps
    if group.row_marks is not None:
        options["touched"] = group.row_marks
    return options
