"""At which rate each of the learned numbers of a field of 4D Gaussians is learned."""

from __future__ import annotations

from torch import Tensor

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.model import Model

ADAM_EPS = 1e-15  # as 3D Gaussian splatting has it (Kerbl et al. 2023)


def param_groups(model: Model, config: SplatConfig) -> list[ParamGroup]:
    """One group for every learning rate, as an optimizer works group by group.

    Of the poses, only those near the drawn frame move.
    """
    rates = {
        "means": config.position_lr * model.unit,
        "quaternions": config.shape_lr,
        "log_scales": config.shape_lr,
        "opacity_logits": config.opacity_lr,
        "log_radiance": config.color_lr,
        "log_radiance_offsets": config.color_lr,
        "sh1": config.color_lr,
    }
    by_rate: dict[float, list[Tensor]] = {}
    for name, rate in rates.items():
        both = getattr(model.static, name), getattr(model.moving, name)
        by_rate.setdefault(rate, []).extend(p for p in both if p.numel())
    by_rate[config.opacity_lr].append(model.opacity_offsets)
    by_rate[config.color_lr] += [model.mixture_logits, model.background]
    groups = [
        ParamGroup(params, config.lr * rate, eps=ADAM_EPS) for rate, params in by_rate.items()
    ]
    t, pose_lr = model.trajectories, config.lr * config.pose_lr
    poses = [
        ParamGroup([t.rotations], pose_lr, row_marks=[t.rotations_touched]),
        ParamGroup([t.translations], pose_lr * model.unit, row_marks=[t.translations_touched]),
    ]
    return [*groups, *poses, *model.local.param_groups(config, model.unit)]
