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

from hdr_nsff.fields.base import FrameError
from hdr_nsff.fields.splat.cloud import alive_at, cloud_at
from hdr_nsff.fields.splat.draw import composite, draw
from hdr_nsff.fields.splat.gaussians import Gaussians
from hdr_nsff.fields.splat.local_gaussians import LocalGaussians
from hdr_nsff.fields.splat.model import Model
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
def relocate_unseen(
    model: Model, frame_errors: list[FrameError], generator: torch.Generator
) -> int:
    """Move unseen Gaussians to those of most error; how many were moved.

    Static, moving and time-local ones are relocated separately.
    """
    num_static, num_moving = len(model.static), len(model.moving)
    num_shared, device = num_static + num_moving, model.background.device
    scores = torch.zeros(num_shared, 2, device=device)
    local = LocalScores(len(model.local), device)
    for frame_error in frame_errors:
        of_frame, alive = error_scores(model, frame_error)
        scores += of_frame[:num_shared] / len(frame_errors)
        local.add(alive, of_frame[num_shared:])
    static, moving = scores.split([num_static, num_moving])
    companions = [model.opacity_offsets, model.mixture_logits]
    count = relocate(model.static, static, [], generator)
    count += relocate(model.moving, moving, companions, generator)
    return count + relocate(model.local, local.mean(), [], generator)


@torch.no_grad()
def error_scores(model: Model, frame_error: FrameError) -> tuple[Tensor, Tensor]:
    """Every Gaussian's weights in a frame, times the error and alone: (G, 2).

    The order is that of `cloud_at`, with the time-local ones `alive` (A,) that are
    returned too. Both are summed over the frame's pixels, as gradients of two drawn
    features.
    """
    knot = model.knot(frame_error.time)
    alive = alive_at(model, knot)
    cloud = cloud_at(model, knot, model.local.living(alive))
    features = torch.zeros(len(cloud.means), 2, device=cloud.means.device, requires_grad=True)
    with torch.enable_grad():
        maps = draw(model, frame_error.camera, cloud, [features])
        render, drawn = composite(model, maps)
        error = frame_error.error(render.radiance.detach())
        pixel_weights = torch.stack([error, torch.ones_like(error)], 1)
        (scores,) = torch.autograd.grad((drawn * pixel_weights).sum(), features)
    return scores, alive


class LocalScores:
    """Scores of `count` time-local Gaussians over several frames.

    Each one's mean is over the frames in which it was alive, or all would look unseen.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.totals = torch.zeros(count, 2, device=device)
        self.num_frames = torch.zeros(count, 1, device=device)

    def add(self, alive: Tensor, scores: Tensor) -> None:
        """Count a frame's `scores` (A, 2) of the Gaussians `alive` (A,) in it."""
        self.totals[alive] += scores
        self.num_frames[alive] += 1

    def mean(self) -> Tensor:
        """Mean scores (G, 2); alive in no frame counts as seen and right."""
        judged = self.totals / self.num_frames.clamp_min(1)
        unjudged = self.totals.new_tensor([0.0, MIN_WEIGHT_PX])
        return torch.where(self.num_frames > 0, judged, unjudged)


@torch.no_grad()
def relocate(
    gaussians: Gaussians | LocalGaussians,
    scores: Tensor,
    companions: Sequence[Tensor],
    generator: torch.Generator,
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
    gaussians.copy(whole, half)
    for values in companions:
        values[..., half] = values[..., whole]
    separate_halves(gaussians, whole, half)
    return count


def separate_halves(gaussians: Gaussians | LocalGaussians, one: Tensor, other: Tensor) -> None:
    """Turn equal pairs `one` (N,) and `other` (N,) into halves of the whole.

    They lie side by side along its longest axis.
    """
    means, log_scales = gaussians.means[:, :3], gaussians.log_scales[:, :3]  # in space
    axis = log_scales[one].argmax(1)
    length = log_scales[one, axis].exp()  # scene units
    rotations = rotation_matrices(gaussians.quaternions[one])
    direction = rotations[torch.arange(len(one)), :, axis]
    offset = HALF_OFFSET * length[:, None] * direction
    means[other] += offset
    means[one] -= offset
    for half in (other, one):
        log_scales[half, axis] += torch.tensor(HALF_SCALE).log()
