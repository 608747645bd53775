"""Tries a rasterizer out by drawing one Gaussian, whose picture is known."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

ONE_ALPHA = 0.75  # opacity of the Gaussian
TOLERANCE = 0.01  # of its alpha


def fault_of(composite: Callable[..., tuple[Tensor, Tensor, Tensor]], device: str) -> str | None:
    """Why `composite` does not draw a Gaussian on `device`; None where it does."""
    try:
        alpha, gradient = draw_one_gaussian(composite, device)
    except Exception as error:  # of any type: compilers, drivers and Python all take part
        first_line = str(error).strip().partition("\n")[0]
        return f"{type(error).__name__}: {first_line:.120}"
    if not abs(alpha - ONE_ALPHA) < TOLERANCE:
        return f"it draws an alpha of {alpha:.3g} instead of {ONE_ALPHA}"
    if not abs(gradient - 1) < TOLERANCE:
        return f"it finds a gradient of {gradient:.3g} instead of 1"
    return None


def draw_one_gaussian(
    composite: Callable[..., tuple[Tensor, Tensor, Tensor]], device: str
) -> tuple[float, float]:
    """Alpha at the center of one wide Gaussian in a picture of 15x15 pixels, which is
    its opacity, and the derivative of that alpha by the opacity, which is 1.
    """
    means = torch.tensor([[0.0, 0.0, 2.0]], device=device, requires_grad=True)
    quaternions = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device)
    scales = torch.full((1, 3), 1.0, device=device)
    opacities = torch.tensor([ONE_ALPHA], device=device, requires_grad=True)
    features = torch.ones(1, 3, device=device)
    w2c = torch.eye(4, device=device)[:3]
    K = torch.tensor([[15.0, 0.0, 7.5], [0.0, 15.0, 7.5], [0.0, 0.0, 1.0]], device=device)
    _, _, alpha = composite(means, quaternions, scales, opacities, features, w2c, K, (15, 15))
    alpha[7, 7].backward()
    assert opacities.grad is not None
    return float(alpha[7, 7].detach()), float(opacities.grad)
