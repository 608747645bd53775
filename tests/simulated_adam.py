"""Adam by a CUDA kernel, on a CPU by the simulator of numba-cuda: against torch's.
`test_cuda_step.py` runs these tests in a process with NUMBA_ENABLE_CUDASIM=1.
"""

from typing import Any

import torch
from torch import Tensor

from hdr_nsff.core.checkpoints import pack, unpack
from hdr_nsff.fields.kernels.cuda.layout import ADAM_VECTORS
from hdr_nsff.training.kernel_adam import KernelAdam

# more than one launch takes, of several shapes, one of them without numbers
SHAPES = [(3,), (2, 3), (130,), (1, 2, 3), (0, 4)] * 4
assert len(SHAPES) > ADAM_VECTORS


def parameters() -> torch.nn.ParameterList:
    generator = torch.Generator().manual_seed(0)
    return torch.nn.ParameterList(torch.rand(shape, generator=generator) for shape in SHAPES)


def groups_of(module: torch.nn.ParameterList) -> list[dict[str, Any]]:
    first, second, third = list(module)[:7], list(module)[7:9], list(module)[9:]
    return [
        {"params": first, "lr": 0.1},
        {"params": second, "lr": 0.02, "betas": (0.9, 0.9999)},
        {"params": third, "lr": 0.3, "eps": 1e-3},
    ]


def move(module: torch.nn.ParameterList, optimizer: torch.optim.Optimizer, steps: range) -> None:
    """Steps with random gradients; one parameter has none at times."""
    for step in steps:
        generator = torch.Generator().manual_seed(step)
        for n, p in enumerate(module):
            gradient: Tensor = torch.randn(p.shape, generator=generator)
            p.grad = None if n == 2 and step % 2 else gradient
        optimizer.step()


def test_moves_what_torch_moves_also_after_it_goes_on() -> None:
    expected, ours = parameters(), parameters()
    move(expected, torch.optim.Adam(groups_of(expected)), range(6))
    optimizer = KernelAdam(groups_of(ours))
    move(ours, optimizer, range(3))
    kept = pack({"module": ours}, {"dense": optimizer})
    again = parameters()
    optimizer = KernelAdam(groups_of(again))
    unpack(kept, {"module": again}, {"dense": optimizer})
    move(again, optimizer, range(3, 6))
    for a, b in zip(again, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


def test_goes_on_from_a_run_on_the_cpu() -> None:
    expected, before, ours = parameters(), parameters(), parameters()
    move(expected, torch.optim.Adam(groups_of(expected), fused=True), range(4))
    optimizer = torch.optim.Adam(groups_of(before), fused=True)
    move(before, optimizer, range(2))
    kept = pack({"module": before}, {"dense": optimizer})
    there = KernelAdam(groups_of(ours))
    unpack(kept, {"module": ours}, {"dense": there})
    move(ours, there, range(2, 4))
    for a, b in zip(ours, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
