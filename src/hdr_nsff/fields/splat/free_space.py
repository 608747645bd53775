"""Free space: static Gaussians that are drawn before the surfaces that cameras saw.

Such fog starts from wrong depth of few frames. It hides what lies behind it in frames
whose depth is right, so that training has to clear it first. A Gaussian is fog where
the pixels that it is drawn in see a surface behind it rather than at it, each by its
weight there and by the confidence in its depth. Pixels with a surface before it have no
vote: it may be hidden there. What is hidden by other fog is found in the next round.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hdr_nsff.fields.splat.gaussians import START_LOGIT
from hdr_nsff.fields.splat.rasterize import rasterize
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.scene import Frame

NUM_FRAMES = 16  # training frames that vote, evenly spread
MAX_ROUNDS = 6
# of the static Gaussians: a round that removes fewer is the last one
MIN_REMOVED_SHARE = 0.005
MARGIN = 0.2  # of a surface's z-depth: what is nearer than this before it is fog
NEAR_PX = 5  # width of the window whose nearest surface counts, against outlines
MIN_VOTES_PX = 0.05  # pixels of full confidence with a surface behind, in all frames
MIN_VOTE_SHARE = 0.5  # of the votes for a surface behind it or at it


def remove_fog(field: Splat, frames: Sequence[Frame]) -> Tensor:
    """Make the static Gaussians that are fog invisible; their indices (N,).

    Frames without a depth prior have no vote.
    """
    step = max(len(frames) / NUM_FRAMES, 1.0)
    chosen = [frames[int(i * step)] for i in range(int(len(frames) / step))]
    removed = []
    for _ in range(MAX_ROUNDS):
        fog = find_fog(field, chosen)
        field.static.opacity_logits.data[fog] = START_LOGIT
        removed.append(fog)
        if len(fog) < MIN_REMOVED_SHARE * len(field.static):
            break
    return torch.cat(removed)


@torch.no_grad()
def find_fog(field: Splat, frames: Sequence[Frame]) -> Tensor:
    """Indices (N,) of the static Gaussians that are drawn before surfaces."""
    votes = torch.zeros(len(field.static), 2, device=field.background.device)
    for frame in frames:
        surface = static_surface(frame)
        if surface is not None:
            votes += vote(field, frame, surface)
    behind, at = votes.unbind(1)
    outvoted = behind > MIN_VOTE_SHARE * (behind + at)
    return ((behind > MIN_VOTES_PX) & outvoted).nonzero()[:, 0]


def static_surface(frame: Frame) -> Tensor | None:
    """The nearest surface around every pixel of a frame, (S, 2): 1 / z-depth, and
    confidence in [0, 1], which is 0 near movers. None without a depth prior.
    """
    if frame.disparity is None:
        return None
    confidence = frame.disparity_confidence
    if confidence is None:
        confidence = torch.ones_like(frame.disparity)
    if frame.moving is not None:
        confidence = confidence * (dilate(frame.moving.float()) == 0)
    return torch.stack([dilate(frame.disparity), confidence], -1).flatten(0, 1)


def dilate(image: Tensor) -> Tensor:
    """The greatest value (H, W) in the window around every pixel."""
    return nn.functional.max_pool2d(image[None, None], NEAR_PX, 1, NEAR_PX // 2)[0, 0]


def vote(field: Splat, frame: Frame, surface: Tensor) -> Tensor:
    """One frame's votes (G, 2) on the static Gaussians: for a surface behind each one,
    and for one at it.

    A Gaussian's mean disparity of surfaces, over its pixels by weight and confidence,
    is a ratio of two gradients of drawn features.
    """
    cloud = field.cloud(field.knot(frame.time))
    features = torch.zeros(len(cloud.means), 2, device=cloud.means.device, requires_grad=True)
    disparity, confidence = surface.unbind(1)
    with torch.enable_grad():
        shapes = cloud.means, cloud.quaternions, cloud.scales, cloud.opacities
        maps = rasterize(*shapes, features, frame.camera, field.model().nearest)
        drawn = maps.features.flatten(0, 1)
        pixel_weights = torch.stack([confidence * disparity, confidence], 1)
        (sums,) = torch.autograd.grad((drawn * pixel_weights).sum(), features)
    total, weight = sums[: len(field.static)].unbind(1)
    depth = frame.camera.to_camera(field.static.means)[:, 2]
    ratio = depth * total / weight.clamp_min(1e-9)  # 1 at the surface
    behind = weight * (ratio < 1 - MARGIN)
    at = weight * ((ratio >= 1 - MARGIN) & (ratio < 1 + MARGIN))
    return torch.stack([behind, at], 1)
