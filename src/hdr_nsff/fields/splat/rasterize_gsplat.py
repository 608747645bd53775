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
    """Whether gsplat can draw here; says once why not, where it cannot."""
    reason = fault()
    if reason is not None:
        say(f"Gaussians are rasterized on the CPU, which is slower: {reason}")
    return reason is None


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
        return f"gsplat cannot be imported ({error}): pip install 'hdr-nsff[gpu]'"
    try:
        alpha = draw_one_gaussian(device)
    except Exception as error:  # of any type: compilers, drivers and Python all take part
        first_line = str(error).strip().partition("\n")[0]
        reason = f"{type(error).__name__}: {first_line:.120}"
    else:
        if abs(alpha - ONE_ALPHA) < 0.01:
            return None
        reason = f"it draws an alpha of {alpha:.3g} instead of {ONE_ALPHA}"
    version = getattr(gsplat, "__version__", "of unknown version")
    return (
        f"gsplat {version} cannot draw with torch {torch.__version__} ({reason}): install a build "
        "of gsplat for this torch and CUDA, or the CUDA toolkit that compiles it"
    )


ONE_ALPHA = 0.75  # opacity of the Gaussian that is drawn to try gsplat out


def draw_one_gaussian(device: str) -> float:
    """Alpha at the center of one wide Gaussian in a picture of 15x15 pixels, which is
    its opacity. Its gradients are computed too.
    """
    means = torch.tensor([[0.0, 0.0, 2.0]], device=device, requires_grad=True)
    quaternions = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device)
    scales = torch.full((1, 3), 1.0, device=device)
    opacities = torch.tensor([ONE_ALPHA], device=device)
    features = torch.ones(1, 3, device=device)
    w2c = torch.eye(4, device=device)[:3]
    K = torch.tensor([[15.0, 0.0, 7.5], [0.0, 15.0, 7.5], [0.0, 0.0, 1.0]], device=device)
    gaussians = means, quaternions, scales, opacities, features
    _, _, alpha = composite(*gaussians, w2c, K, size=(15, 15), nearest=0.01, blur=0.3)
    alpha.sum().backward()
    return float(alpha[7, 7].detach())


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
