"""Which rasterizer draws on a CUDA device: our own kernels or, where these cannot be
compiled or loaded, gsplat. Each is tried out before anything is prepared or trained, by
drawing one Gaussian.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from hdr_nsff.core.progress import say
from hdr_nsff.fields.kernels.cuda.launch import load_all
from hdr_nsff.fields.splat import rasterize_cuda, rasterize_gsplat

# Gaussians, w2c (3, 4), K (3, 3) and size (width, height) to features, z-depth, alpha
Composite = Callable[..., tuple[Tensor, Tensor, Tensor]]


class Backend(NamedTuple):
    """What draws on a device, or why nothing does."""

    composite: Composite | None
    description: str  # for `hdr-nsff doctor`
    fault: str | None = None  # a reason and how to fix it, where nothing draws


@cache
def find_backend(device: str = "cuda") -> Backend:
    """The rasterizer of a CUDA device; says once where it is not our own."""
    reason = rasterize_cuda.fault(device)
    if reason is None:
        return Backend(rasterize_cuda.composite, "our kernels, compiled by numba-cuda, draw")
    why_not_gsplat = rasterize_gsplat.fault(device)
    if why_not_gsplat is None:
        say(f"Gaussians are drawn by gsplat: {reason}")
        return Backend(rasterize_gsplat.composite, f"gsplat draws; {reason}")
    fault = reason
    if rasterize_gsplat.installed():
        fault = f"{reason}; {why_not_gsplat}"
    return Backend(None, fault, fault)


def fault(device: str = "cuda") -> str | None:
    """Why no rasterizer draws on `device`, and how to fix it; None where one does."""
    return find_backend(device).fault


@cache
def kernels_on(device: torch.device) -> bool:
    """Whether all of our own kernels run on a device; says once why they do not."""
    if device.type != "cuda":
        return False
    reason = rasterize_cuda.fault(str(device))
    if reason is None:
        try:
            load_all(device)
        except Exception as error:  # of any type: compilers and drivers take part
            first_line = str(error).strip().partition("\n")[0]
            reason = f"{type(error).__name__}: {first_line:.120}"
    if reason is not None:
        say(f"training steps are plain torch, which is slower: {reason}")
    return reason is None


@cache
def composite_on(device: torch.device) -> Composite | None:
    """The rasterizer of a device; says once why there is none."""
    backend = find_backend(str(device))
    if backend.composite is None:
        say(f"Gaussians are rasterized on the CPU, which is slower: {backend.fault}")
    return backend.composite
