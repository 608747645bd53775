"""The rasterizer's twin on CUDA: gsplat (Ye et al. 2024), extra `gpu`.

It draws by the same rules as the kernels for the CPU: 0.3 pixels^2 of blur, alpha
between 1/255 and 0.999, nothing nearer than 0.01, and outside of the frame a projection
that is linearized at its edge.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from hdr_nsff.core.progress import say


@cache
def available() -> bool:
    """Whether gsplat is installed; reports once where it is not."""
    try:
        import gsplat  # noqa: F401
    except ImportError:
        say(
            "gsplat is not installed, so Gaussians are rasterized on the CPU, which is slower: "
            "pip install 'hdr-nsff[gpu]'"
        )
        return False
    return True


def composite(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    w2c: Tensor,
    K: Tensor,
    size: tuple[int, int],
    nearest: float,
    blur: float,
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
        eps2d=blur,
        packed=False,
        render_mode="RGB+D",
    )
    return maps[0, ..., :-1], maps[0, ..., -1], alpha[0, ..., 0]
