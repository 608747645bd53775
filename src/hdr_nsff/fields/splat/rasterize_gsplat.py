"""The rasterizer's other twin on CUDA: gsplat (Ye et al. 2024), extra `gsplat`.

It draws where our own kernels cannot.

It draws by the same rules as the kernels for the CPU: 0.3 pixels^2 of blur, alpha
between 1/255 and 0.999, nothing nearer than a given z-depth, and outside of the frame a
projection that is linearized at its edge.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor

from hdr_nsff.fields.kernels.footprint import BLUR, NEAREST
from hdr_nsff.fields.splat.try_out import fault_of


def installed() -> bool:
    """Whether there is a gsplat to try out."""
    return find_spec("gsplat") is not None


@cache
def fault(device: str = "cuda") -> str | None:
    """Why gsplat cannot draw on `device`, and how to fix it; None where it draws one
    Gaussian and its gradients.

    Its wheel on PyPI has no kernels: it compiles them at the first use, and fails there
    with an unrelated AttributeError where the CUDA toolkit is missing.
    """
    try:
        import gsplat
    except ImportError as error:
        return f"gsplat cannot be imported ({error}): pip install 'hdr-nsff[gsplat]'"
    reason = fault_of(composite, device)
    if reason is None:
        return None
    version = getattr(gsplat, "__version__", "of unknown version")
    return (
        f"gsplat {version} cannot draw with torch {torch.__version__} ({reason}): install a build "
        "of gsplat for this torch and CUDA, or the CUDA toolkit that compiles it"
    )


def composite(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    w2c: Tensor,
    K: Tensor,
    size: tuple[int, int],
    nearest: float = NEAREST,
) -> tuple[Tensor, Tensor, Tensor]:
    """Features (H, W, D), z-depth (H, W) and alpha (H, W) of Gaussians.

    They are as `rasterize.rasterize` takes them, seen by `w2c` (3, 4) and `K` (3, 3) in
    a picture of `size` (width, height). All on one CUDA device, float32; gradients
    reach everything but `K`.
    """
    from gsplat import rasterization

    width, height = size
    last_row = w2c.new_tensor([[0.0, 0.0, 0.0, 1.0]])
    maps, alpha, _ = rasterization(
        means,
        quaternions,
        scales,
        opacities,
        features,
        torch.cat([w2c, last_row])[None],
        K[None],
        width,
        height,
        near_plane=nearest,
        eps2d=BLUR,
        packed=False,
        render_mode="RGB+D",
    )
    return maps[0, ..., :-1], maps[0, ..., -1], alpha[0, ..., 0]
