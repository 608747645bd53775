"""Gaussians that nobody sees are put where the picture is wrong: those that faded away,
those behind others, floaters in space that no training view looks at. The count stays.
What is wrong is said by the recording: how far each pixel is from what its own exposure
recorded, so that highlights and shadows count as much as the exposure that resolved
them can tell (after Kheradmand et al. 2024, who choose by opacity).
"""

from __future__ import annotations

import torch
from torch import Tensor

from hdr_nsff.fields.splat.gaussians import Gaussians
from hdr_nsff.fields.splat.rasterize import rotation_matrices

# pixels: a Gaussian whose weights add up to less in the mean frame is as good as not
# there
UNSEEN = 0.05
MOST = 0.05  # of the Gaussians are put elsewhere at a time
PARTED = 0.5  # standard deviations that two halves lie off the middle of the whole
NARROWER = 0.7  # times as long as the whole is a half, along the axis it was cut across


@torch.no_grad()
def relocate(
    gaussians: Gaussians, told: Tensor, companions: list[Tensor], generator: torch.Generator
) -> int:
    """Cut the Gaussians most to error_scores in two across their longest axis; the
    unseen ones become the other halves. How many.

    `told` (G, 2) are each one's weights summed over the pixels, times their error and
    alone; `companions` are what else belongs to each, in their last dimension.
    """
    unseen = (told[:, 1] < UNSEEN).nonzero()[:, 0]
    weight = torch.where(told[:, 1] < UNSEEN, torch.zeros_like(told[:, 0]), told[:, 0]).nan_to_num(
        0
    )
    count = min(len(unseen), int(MOST * len(gaussians)), int((weight > 0).sum()))
    if count == 0:
        return 0
    whole = torch.multinomial(weight.cpu(), count, generator=generator).to(weight.device)
    half = unseen[:count]
    axis = gaussians.log_scales[whole].argmax(1)
    rotations = rotation_matrices(gaussians.quaternions[whole])
    reach = gaussians.log_scales[whole, axis].exp()
    offset = PARTED * reach[:, None] * rotations[torch.arange(count), :, axis]
    for values in (
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.log_radiance,
        gaussians.logits,
    ):
        values[half] = values[whole]
    if len(gaussians.sh1):
        gaussians.sh1[half] = gaussians.sh1[whole]
    for c in [gaussians.offsets.movedim(1, -1), *companions]:
        c[..., half] = c[..., whole]
    gaussians.means[half] += offset
    gaussians.means[whole] -= offset
    for some in (half, whole):
        gaussians.log_scales[some, axis] += torch.tensor(NARROWER).log()
    return count
