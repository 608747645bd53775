"""Adam by our CUDA kernel: all parameters in one or two launches, where torch's fused
one takes two for every group.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hdr_nsff.fields.kernels.cuda.launch import blocks_for, launch
from hdr_nsff.fields.kernels.cuda.layout import ADAM_VECTORS, THREADS


class KernelAdam(torch.optim.Adam):
    """Adam (Kingma and Ba 2015) on an NVIDIA GPU, with the state of torch's."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One step on every parameter that has a gradient."""
        assert closure is None
        batches: dict[tuple[float, ...], list[tuple[Any, ...]]] = {}
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if not state:
                    state["step"] = torch.zeros(())
                    state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(p) for _ in range(2))
                state["step"] += 1
                tensors = p.detach(), p.grad.contiguous(), state["exp_avg"], state["exp_avg_sq"]
                vectors = (t.view(-1) for t in tensors)
                key = (*group["betas"], float(state["step"]))
                given = *vectors, float(group["lr"]), float(group["eps"])
                batches.setdefault(key, []).append(given)
        for (beta1, beta2, t), moved in batches.items():
            numbers = beta1, beta2, 1 - beta1**t, 1 - beta2**t
            for first in range(0, len(moved), ADAM_VECTORS):
                move(moved[first : first + ADAM_VECTORS], numbers)


def move(vectors: list[tuple[Any, ...]], numbers: tuple[float, ...]) -> None:
    """Move up to ADAM_VECTORS vectors, each of which comes with its gradient, moments,
    learning rate and epsilon; `numbers` are the betas and their corrections.
    """
    longest = max(len(vector[0]) for vector in vectors)
    nothing: list[Tensor] = [tensor[:0] for tensor in vectors[0][:4]]
    missing = *nothing, 0.0, 0.0
    every = [*vectors, *[missing] * (ADAM_VECTORS - len(vectors))]
    flat = [value for vector in every for value in vector]
    launch("adam", blocks_for(longest), THREADS, *flat, *numbers)
