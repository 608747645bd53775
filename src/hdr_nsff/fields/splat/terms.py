"""The terms of the objective that only a field of Gaussians has: few and small
Gaussians, smooth motion, and little change in time.
"""

from __future__ import annotations

from torch import Tensor

from hdr_nsff.fields.outputs import GaussianCloud
from hdr_nsff.fields.splat.gaussians import mean_square
from hdr_nsff.fields.splat.model import Model

MIN_OPACITY = 0.003  # below, a Gaussian draws nothing: less than ALPHA_MIN = 1/255
COLOR_OFFSET_SHARE = 0.01  # weight of color offsets relative to their changes in time


def regularizers(model: Model, cloud: GaussianCloud, knot: float) -> dict[str, Tensor]:
    """The field's own terms of the `cloud` at `knot`, by their `SplatLosses` names.

    Mean opacity and scale keep Gaussians few and small (3DGS-MCMC, Kheradmand et
    al. 2024); the others keep poses smooth and changes in time small.
    """
    static, moving = model.static, model.moving
    visible = cloud.opacities.detach() > MIN_OPACITY
    color_change = mean_square(moving.log_radiance_offsets.diff(dim=0))
    color_offset = mean_square(moving.log_radiance_offsets)
    terms = {
        "opacity": (cloud.opacities * visible).mean(),
        "scale": (cloud.scales * visible[:, None]).mean() / model.unit,
        "trajectory": model.trajectories.roughness(knot, model.unit),
        "brightness_drift": mean_square(static.log_radiance_offsets),
        "opacity_offsets": mean_square(model.opacity_offsets.diff(dim=0)),
        "color_change": color_change + COLOR_OFFSET_SHARE * color_offset,
    }
    if len(static.sh1):
        terms["sh1"] = mean_square(static.sh1) + mean_square(moving.sh1)
    return terms


def mixture_difference(mixture_logits: Tensor, neighbors: Tensor) -> Tensor:
    """Mean square difference of the mixtures (B, M) of `neighbors` (M, N).

    Gaussians with the same mixture of motions keep their distances.
    """
    mixture = mixture_logits.softmax(0)
    of_neighbors = mixture[:, neighbors.long().flatten()]
    own = mixture.repeat_interleave(neighbors.shape[1], 1)
    return mean_square(of_neighbors - own)
