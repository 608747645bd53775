"""Relocation: Gaussians that contribute nothing are moved to where the picture is
wrong, at a constant count.

As in 3DGS-MCMC (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte
Carlo"), dead Gaussians are relocated to live ones, drawn at random. There, dead means
of low opacity and the draw goes by opacity. Here, dead means unseen: faded away, hidden
behind others, or floating where no training view looks. The draw goes by error: how far
each pixel is from what its own exposure recorded, so that highlights and shadows count
as much as the exposure that resolved them reveals. A drawn Gaussian is cut in two
across its longest axis, which changes the picture little.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hdr_nsff.fields.splat.gaussians import Gaussians
from hdr_nsff.fields.splat.rasterize import rotation_matrices

# pixels: a Gaussian whose weights add up to less in the mean frame is unseen
# (hand-chosen on rendered scenes)
MIN_WEIGHT_PX = 0.05
MAX_RELOCATED_SHARE = 0.05  # of the Gaussians at a time (hand-chosen on rendered scenes)
# a half's offset from the middle of the whole, in standard deviations, and its length
# along the cut axis relative to the whole (hand-chosen: both halves together look like
# it)
HALF_OFFSET = 0.5
HALF_SCALE = 0.7


@torch.no_grad()
def relocate(
    gaussians: Gaussians, scores: Tensor, companions: Sequence[Tensor], generator: torch.Generator
) -> int:
    """Cut the Gaussians of most error in two; unseen ones become the other halves.

    `scores` (G, 2) are each one's compositing weights summed over the pixels of a mean
    frame, times the pixels' error and alone. `companions` (..., G) are what else
    belongs to each Gaussian, in their last dimension. Returns how many were relocated.
    """
    error, weight = scores.unbind(1)
    is_unseen = weight < MIN_WEIGHT_PX
    unseen = is_unseen.nonzero()[:, 0]
    chance = torch.where(is_unseen, torch.zeros_like(error), error).nan_to_num(0)
    limit = int(MAX_RELOCATED_SHARE * len(gaussians))
    count = min(len(unseen), limit, int((chance > 0).sum()))
    if count == 0:
        return 0
    whole = torch.multinomial(chance.cpu(), count, generator=generator).to(chance.device)
    half = unseen[:count]
    copy_gaussians(gaussians, companions, whole, half)
    separate_halves(gaussians, whole, half)
    return count


def copy_gaussians(
    gaussians: Gaussians, companions: Sequence[Tensor], source: Tensor, target: Tensor
) -> None:
    """Make the Gaussians `target` (N,) like `source` (N,), companions included."""
    for parameter in (
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.log_radiance,
        gaussians.opacity_logits,
    ):
        parameter[target] = parameter[source]
    if len(gaussians.sh1):
        gaussians.sh1[target] = gaussians.sh1[source]
    offsets = gaussians.log_radiance_offsets.movedim(1, -1)  # (knots, channels, G)
    for values in (offsets, *companions):
        values[..., target] = values[..., source]


def separate_halves(gaussians: Gaussians, one: Tensor, other: Tensor) -> None:
    """Turn equal pairs `one` (N,) and `other` (N,) into halves of the whole.

    They lie side by side along its longest axis.
    """
    axis = gaussians.log_scales[one].argmax(1)
    length = gaussians.log_scales[one, axis].exp()  # scene units
    rotations = rotation_matrices(gaussians.quaternions[one])
    direction = rotations[torch.arange(len(one)), :, axis]
    offset = HALF_OFFSET * length[:, None] * direction
    gaussians.means[other] += offset
    gaussians.means[one] -= offset
    for half in (other, one):
        gaussians.log_scales[half, axis] += torch.tensor(HALF_SCALE).log()
