"""The objective's terms as pure functions: tensors in, a scalar out, weighed elsewhere.

Equation numbers are those of HDR-NSFF. Terms that its eq. 16 collects as `L_reg` come
from NSFF (Li et al. 2021, "Neural Scene Flow Fields"), on which it builds. `N` counts
pixels or samples; a `confidence` or `weight` is in [0, 1]. What each term weighs, and
how we differ from the paper, stands in docs/method.md, section "Objective".
"""

from __future__ import annotations

import torch
from torch import Tensor

MIN_TOTAL_WEIGHT = 1e-6  # keeps a weighted mean finite where every weight is 0
MIN_LOG_SHARE = 1e-6  # keeps log(share) finite
MASK_MARGIN = 1e-4  # a motion share is read as lying in [MASK_MARGIN, 1 - MASK_MARGIN]


def photometric(
    predicted: Tensor,
    recorded: Tensor,
    weight: Tensor | None = None,
    squared: bool = False,
    trust: Tensor | None = None,
) -> Tensor:
    """Mean difference of predicted and recorded rgb (N, 3), eq. 12-13.

    The paper prints squared differences, its published code takes absolute ones: see
    `squared`. `weight` is (N,), (N, 1) or (N, 3); the weighted mean divides by the sum
    of the weights. `trust` (N, 3) weighs errors without entering that sum.
    """
    difference = predicted - recorded
    error = difference.square() if squared else difference.abs()
    if trust is not None:
        error = error * trust
    if weight is None:
        return error.mean()
    per_pixel = weight if weight.dim() == 2 else weight[:, None]
    expanded = per_pixel.expand_as(error)
    return (error * expanded).sum() / expanded.sum().clamp_min(MIN_TOTAL_WEIGHT)


def saturation_weight(rgb: Tensor, low: float = 0.15, high: float = 0.9) -> Tensor:
    """Trust (N, 3) in recorded values: less near 0 and 1, where they clip.

    It is 1 in [low, high], `((c + low) / (2 low))^2` below and
    `((2 - high - c) / (2 (1 - high)))^2` above: 1/4 at 0 and at 1. The paper does not
    mention it; its published code weights the dynamic terms by it, with these defaults.
    """
    under = ((low - rgb) / low).clamp(0, 1)
    over = ((rgb - high) / (1 - high)).clamp(0, 1)
    return (1 - torch.maximum(under, over) / 2).square()


def cycle(there: Tensor, back: Tensor, confidence: Tensor) -> Tensor:
    """Cycle consistency of scene flow (Li et al. 2021).

    The sum of `confidence * |f_ij(x) + f_ji(x + f_ij(x))|_1` over the sum of the
    confidences. `there` and `back` (N, 3) are the two flows, `confidence` (N,) is one
    minus the disocclusion.
    """
    residual = (there + back).abs().sum(-1)
    return (confidence * residual).sum() / confidence.sum().clamp_min(MIN_TOTAL_WEIGHT)


def kinetic(forward: Tensor, backward: Tensor) -> Tensor:
    """Least kinetic energy: mean of `0.5 |f_(t->t+1) + f_(t->t-1)|^2` (Li et al. 2021).

    It is 0 for constant velocity, and where there are none. Flows (N, 3) are in scene
    units, over equal times.
    """
    acceleration = forward + backward
    if not len(acceleration):
        return acceleration.sum()
    return 0.5 * acceleration.square().sum(-1).mean()


def smoothness(a: Tensor, b: Tensor) -> Tensor:
    """Mean absolute difference of scene flow between neighbors on a ray.

    `a` and `b` (N, 3) are flows of neighboring samples (Li et al. 2021); 0 where there
    are none.
    """
    if not len(a):
        return a.sum()
    return (a - b).abs().sum(-1).mean()


def flow_magnitude(scene_flow: Tensor) -> Tensor:
    """Absolute rendered scene flow (N, 3), summed over axes: its mean over pixels.

    The published code adds up the signed axes before it takes the absolute value, so
    that opposite components cancel; we do not follow it.
    """
    return scene_flow.abs().sum(-1).mean()


def blend_entropy(share: Tensor) -> Tensor:
    """Mean of `-b log b` of blend shares b (N,) in [0, 1] (Li et al. 2021).

    Shares near 0 or 1 cost nothing: the "entropy loss" of HDR-NSFF, section 3.1.
    """
    return -(share * share.clamp_min(MIN_LOG_SHARE).log()).mean()


def distortion(weights: Tensor, edges: Tensor) -> Tensor:
    """Mean distortion of rays (mip-NeRF 360, Barron et al. 2022, eq. 15): how far a
    ray's weights are spread.

    `sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 d_i` with the intervals' midpoints m
    and lengths d. `weights` (N, S) >= 0; `edges` (N, S + 1) rising, in [0, 1] along the
    ray. Its double sum is one pass over cumulative sums.
    """
    lengths = edges[:, 1:] - edges[:, :-1]
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    moment = weights * middle
    weight_before = weights.cumsum(-1) - weights
    moment_before = moment.cumsum(-1) - moment
    between = 2 * (weights * (middle * weight_before - moment_before)).sum(-1)
    within = (weights.square() * lengths).sum(-1) / 3
    return (between + within).mean()


def normalize_shift_scale(values: Tensor) -> Tensor:
    """Values (N,) minus their median, over their mean absolute deviation from it.

    Invariant to scale and shift (MiDaS, Ranftl et al. 2020).
    """
    shifted = values - values.median()
    return shifted / shifted.abs().mean().clamp_min(1e-6)


def depth_relative(depth: Tensor, prior_disparity: Tensor) -> Tensor:
    """`L_depth` of eq. 14 for a prior known up to scale and shift.

    Mean squared difference of normalized disparities. Both inputs are (N,); `depth` is
    z-depth.
    """
    difference = normalize_shift_scale(1 / depth) - normalize_shift_scale(prior_disparity)
    return difference.square().mean()


def depth_scene(
    depth: Tensor, prior_disparity: Tensor, confidence: Tensor | None, near: float
) -> Tensor:
    """`L_depth` of eq. 14 for a prior in scene units.

    Mean of the confidence (1 where None) times the absolute difference of disparities,
    in units of 1 / near. All inputs are (N,).
    """
    error = (1 / depth - prior_disparity).abs()
    if confidence is None:
        return error.mean() * near
    return (confidence * error).mean() * near


def optical_flow(flow: Tensor, target: Tensor, valid: Tensor, limit: float | None = None) -> Tensor:
    """`L_flow` of eq. 14: mean absolute difference in pixels, both axes added up.

    `flow` and `target` are (N, 2); the mean is over `valid` (N,) bool, 0 where nothing
    is valid. `limit` (pixels) caps the error of an outlier.
    """
    # one tensor per axis: `sum` is slow over an axis of length two
    error_x, error_y = (flow - target).abs().unbind(-1)
    error = error_x + error_y
    if limit is not None:
        error = error.clamp(max=limit)
    return (error * valid).sum() / valid.sum().clamp_min(1)


def motion_mask(motion: Tensor, moving: Tensor, trust: Tensor | None = None) -> Tensor:
    """Mean binary cross-entropy of the rendered motion share and the moving mask. Ours.

    `motion` (N,) is in [0, 1], `moving` (N,) bool, `trust` (N,) weights pixels.
    """
    # a linear squeeze and no clamp: its gradient must not vanish at 0 and 1, or a mover
    # that is not rendered anywhere yet would never appear
    inside = motion * (1 - 2 * MASK_MARGIN) + MASK_MARGIN
    cross_entropy = -torch.where(moving, inside, 1 - inside).log()
    if trust is None:
        return cross_entropy.mean()
    return (cross_entropy * trust).mean()
