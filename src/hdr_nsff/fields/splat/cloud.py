"""The Gaussians of a field at a time, in plain torch, differentiable in everything.

Their order is everywhere the same: static ones, moving ones, and the time-local ones
that are alive.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hdr_nsff.fields.knots import interpolate_linear
from hdr_nsff.fields.outputs import GaussianCloud
from hdr_nsff.fields.splat.local_gaussians import Living, least_duration
from hdr_nsff.fields.splat.model import Model


def alive_at(model: Model, knot: float) -> Tensor:
    """Indices (A,) of the time-local Gaussians that are alive at a knot."""
    return model.local.alive(model.time(knot))


def cloud_at(model: Model, knot: float, living: Living) -> GaussianCloud:
    """All Gaussians at a knot, of the time-local ones those `living` (A)."""
    time = model.time(knot)
    mixture, share = model.mixture_logits.softmax(0), model.share(knot)
    static, moving = model.static, model.moving
    pose = model.trajectories.pose(knot)
    moved = model.trajectories.move(moving.means, mixture, pose)
    turned = model.trajectories.turn(moving.quaternions, mixture, pose)
    least = least_duration(model.times)
    at_rest = static.means.new_zeros(len(static))
    num_moving = len(moving) + len(living.means)
    log_scales = [static.log_scales, moving.log_scales, living.log_scales[:, :3]]
    radiance = [static.radiance(share), moving.radiance(share), living.radiance()]
    return GaussianCloud(
        means=torch.cat([static.means, moved, living.positions(time)]),
        quaternions=torch.cat([static.quaternions, turned, living.quaternions]),
        scales=torch.cat(log_scales).exp(),
        opacities=torch.cat([opacities_at(model, share), living.opacities(time, least)]),
        radiance=torch.cat(radiance),
        motion=torch.cat([at_rest, static.means.new_ones(num_moving)]),
    )


def opacities_at(model: Model, share: float) -> Tensor:
    """Opacities (G,) in [0, 1] of static and moving ones at a share of the clip."""
    position = share * (len(model.opacity_offsets) - 1)
    offsets = interpolate_linear(model.opacity_offsets, position)
    return torch.cat([model.static.opacity_logits, model.moving.opacity_logits + offsets]).sigmoid()


def positions_at(model: Model, knot: float, living: Living) -> Tensor:
    """Means (G, 3) of all Gaussians at a knot, of the time-local ones those `living`
    (A) at any knot.
    """
    mixture = model.mixture_logits.softmax(0)
    pose = model.trajectories.pose(knot)
    moved = model.trajectories.move(model.moving.means, mixture, pose)
    return torch.cat([model.static.means, moved, living.positions(model.time(knot))])


def displacement(model: Model, means: Tensor, living: Living, knot: float, offset: int) -> Tensor:
    """From `means` (G, 3) at a knot to the means one training interval away.

    `living` (A) are the time-local ones among them. `offset` is +1 (later) or -1
    (earlier): between two training times, to as far between the next two. Beyond the
    clip's ends, the displacement of the other direction is continued. Between the only
    two training times it is that from one to the other.
    """
    if model.has_knot(knot + offset):
        return positions_at(model, knot + offset, living) - means
    if model.has_knot(knot - offset):
        return means - positions_at(model, knot - offset, living)
    if model.last_knot == 0:
        return torch.zeros_like(means)
    first, last = (positions_at(model, end, living) for end in (0, model.last_knot))
    return offset * (last - first)
