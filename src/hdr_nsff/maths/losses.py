"""The paper's terms as pure functions: tensors in, a scalar out, weighed elsewhere.
Weights `w` are confidences in [0, 1].
"""

from __future__ import annotations

import torch
from torch import Tensor


def photometric(
    predicted: Tensor, recorded: Tensor, weight: Tensor | None = None, squared: bool = False
) -> Tensor:
    """Mean (weighted) absolute or squared difference of rgb (N, 3); eq. 12-13 square,
    the reference does not.
    """
    error = (predicted - recorded).square() if squared else (predicted - recorded).abs()
    if weight is None:
        return error.mean()
    weight = weight.expand_as(error) if weight.dim() == 2 else weight[:, None].expand_as(error)
    return (error * weight).sum() / weight.sum().clamp_min(1e-6)


def saturation_weight(
    rgb: Tensor, low: float = 0.15, high: float = 0.9, floor: float = 0.25
) -> Tensor:
    """Trust (N, 3) in recorded values: 1 in [low, high], falling quadratically to
    `floor` at 0 and at 1 (METHOD.md 1).
    """
    under = ((low - rgb) / low).clamp_min(0)
    over = ((rgb - high) / (1 - high)).clamp_min(0)
    return 1 - (1 - floor) * torch.maximum(under, over).clamp(max=1).square()


def cycle(there: Tensor, back: Tensor, confidence: Tensor) -> Tensor:
    """(1 - disocclusion) |f_{i->j}(x) + f_{j->i}(x + f)|, normalized by the confidences
    (N,).
    """
    residual = (there + back).abs().sum(-1)
    return (confidence * residual).sum() / confidence.sum().clamp_min(1e-6)


def kinetic(forward: Tensor, backward: Tensor) -> Tensor:
    """Least kinetic energy: 0.5 |f_{t->t+1} + f_{t->t-1}|^2, which is zero for constant
    velocity; flows (N, 3) in scene units.
    """
    return 0.5 * (forward + backward).square().sum(-1).mean()


def smoothness(a: Tensor, b: Tensor) -> Tensor:
    """Mean absolute difference of scene flow (N, 3) between neighboring samples; 0
    where there are none.
    """
    return (a - b).abs().sum(-1).mean() if len(a) else a.sum()


def flow_magnitude(scene_flow: Tensor) -> Tensor:
    """Mean absolute rendered scene flow (N, 3), per axis before anything is summed."""
    return scene_flow.abs().mean()


def entropy(share: Tensor) -> Tensor:
    """Mean of -v log v: a blend share (N,) near 0 or 1 costs nothing."""
    return -(share * share.clamp_min(1e-6).log()).mean()


def normalized(values: Tensor) -> Tensor:
    """Shift by the median, scale by the mean absolute deviation (MiDaS; METHOD.md 3):
    invariant to scale and shift.
    """
    shifted = values - values.median()
    return shifted / shifted.abs().mean().clamp_min(1e-6)


def depth_relative(depth: Tensor, prior_disparity: Tensor) -> Tensor:
    """Squared difference of normalized disparities (N,): for priors known up to scale
    and shift.
    """
    return (normalized(1 / depth) - normalized(prior_disparity)).square().mean()


def depth_scene(depth: Tensor, prior_disparity: Tensor, confidence: Tensor, near: float) -> Tensor:
    """Confidence-weighted absolute difference of disparities (N,) in units of 1 / near:
    for priors in scene units.
    """
    return (confidence * (1 / depth - prior_disparity).abs()).mean() * near


def optical_flow(flow: Tensor, target: Tensor, valid: Tensor, limit: float | None = None) -> Tensor:
    """Masked mean absolute difference in pixels, (N, 2) each; 0 where nothing is valid.
    `limit` caps an outlier's error.
    """
    x, y = (flow - target).abs().unbind(-1)  # `sum` is slow over an axis of two
    error = x + y
    error = error if limit is None else error.clamp(max=limit)
    return (error * valid).sum() / valid.sum().clamp_min(1)


def motion_mask(motion: Tensor, moving: Tensor, trust: Tensor | None = None) -> Tensor:
    """Cross-entropy between the rendered share of dynamic content (N,) and the moving
    mask (N,) bool, weighted by `trust` (N,), in float32.
    """
    inside = (
        motion * (1 - 2e-4) + 1e-4
    )  # not a clamp: a mover that is nowhere yet must feel the mask
    entropy = -torch.where(moving, inside, 1 - inside).log()
    return entropy.mean() if trust is None else (entropy * trust).mean()
