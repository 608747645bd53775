"""What a training step sees of its frame, and the field's own terms: by plain torch, or
by kernels where they can do all that is asked for.

A frame is seen through its shutter, with optical flow to one of its neighbors, and with
what is recorded of the Gaussians one by one, each where it is due.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.outputs import GaussianCloud
from hdr_nsff.fields.splat.cloud import cloud_at, positions_at
from hdr_nsff.fields.splat.cuda_backends import kernels_on
from hdr_nsff.fields.splat.draw import (
    MIN_ALPHA,
    MIN_DEPTH_SHARE,
    composite,
    draw,
    record_parts,
    seen_radiance,
)
from hdr_nsff.fields.splat.fused_cloud import fused_cloud
from hdr_nsff.fields.splat.fused_parts import fused_parts
from hdr_nsff.fields.splat.fused_picture import fused_composite
from hdr_nsff.fields.splat.late_mixing import LateMixing, Parts, split_late
from hdr_nsff.fields.splat.local_gaussians import Living
from hdr_nsff.fields.splat.model import Model
from hdr_nsff.fields.splat.moment import MAX_FLOW, Cloud, Moment
from hdr_nsff.fields.splat.numba_cloud import numba_cloud
from hdr_nsff.fields.splat.numba_picture import numba_composite
from hdr_nsff.fields.splat.rasterize import Maps, rasterize, rasterize_planes
from hdr_nsff.fields.splat.shutter import Shutter, apparent_motion
from hdr_nsff.fields.splat.terms import mixture_difference, regularizers
from hdr_nsff.scene.batch import PixelBatch

CloudMaker = Callable[[Model, Moment, Tensor], Cloud]


@dataclass(frozen=True)
class TrainingView:
    """What a training step asks of the whole frame of its batch."""

    batch: PixelBatch
    knot: float  # of the frame
    alive: Tensor  # (A,) the time-local Gaussians that are alive
    offsets: list[int]  # of the neighbors that flow is due to, one at most
    rigidity: bool  # whether rigidity and evenness are due
    late: LateMixing | None = None  # which records the Gaussians one by one
    shutter: Shutter | None = None  # None: a moment


@dataclass(frozen=True)
class Seen:
    """What a training step sees, S pixels row by row."""

    render: Render
    flow: Tensor  # (S, 2) px to the neighbor; (S, 0) where none is due
    terms: dict[str, Tensor]  # the field's own, by the names of their weights


def see(model: Model, view: TrainingView) -> Seen:
    """What a training step sees, differentiable in everything."""
    make_cloud = cloud_maker(model, view)
    if make_cloud is None:
        return see_by_torch(model, view)
    cloud = cloud_by_kernels(model, view, make_cloud)
    features, late = cloud.features, None
    if view.late is not None:
        features, behind = recorded_features(model, view, cloud)
        late = behind, view.late.share
    gaussians = cloud.means, cloud.quaternions, cloud.scales, cloud.opacities, features
    seen_from = *gaussians, view.batch.camera, model.nearest
    numbers = model.bounded, model.far, MIN_DEPTH_SHARE * model.unit, MIN_ALPHA
    given = model.background, late, bool(view.offsets), numbers
    if make_cloud is numba_cloud:
        planes = rasterize_planes(*seen_from)
        render, flow = numba_composite(planes, *given)
    else:
        render, flow = fused_composite(rasterize(*seen_from), *given)
    return Seen(render, flow, cloud.terms)


def recorded_features(model: Model, view: TrainingView, cloud: Cloud) -> tuple[Tensor, Tensor]:
    """The features (G, F + 3) of a cloud with what is recorded of its Gaussians, and
    what is recorded of the background (3,).
    """
    camera, recorder = view.batch.camera, view.batch.recorder
    assert recorder is not None
    if recorder.sensor is not None:
        light = model.background, model.bounded
        return fused_parts(cloud.features, cloud.means, camera, *light, recorder.sensor)
    parts = record_parts(model, recorder, camera, cloud.features[:, :3], cloud.means)
    return torch.cat([cloud.features, parts.gaussians], 1), parts.background[0]


def see_by_torch(model: Model, view: TrainingView) -> Seen:
    """The same by plain torch."""
    maps, parts, terms = draw_by_torch(model, view)
    maps, recorded = split_late(maps, parts)
    render, drawn = composite(model, maps)
    if view.late is not None and parts is not None and recorded is not None:
        average, share = view.late(parts, recorded, render)
        render = replace(render, late=average, late_share=share)
    # features are premultiplied by opacity
    flow = drawn / render.opacity.clamp_min(MIN_ALPHA)[:, None]
    return Seen(render, flow, terms)


def cloud_maker(model: Model, view: TrainingView) -> CloudMaker | None:
    """What makes the Gaussians of the view by kernels: `fused_cloud` or `numba_cloud`.

    None with view dependence, a shutter or learned cameras, and where there are no
    kernels.
    """
    cameras = view.batch.camera, *view.batch.neighbors.values()
    learned = any(c.c2w.requires_grad or c.K.requires_grad for c in cameras)
    if learned or view.shutter is not None or model.view_dependence:
        return None
    background = model.background
    if kernels_on(background.device):
        return fused_cloud
    on_cpu = background.device.type == "cpu" and background.dtype == torch.float32
    return numba_cloud if on_cpu else None


def draw_by_torch(model: Model, view: TrainingView) -> tuple[Maps, Parts | None, dict[str, Tensor]]:
    """What the view sees, the recorded parts, which the maps hold last, and the field's
    terms.
    """
    batch, knot, alive = view.batch, view.knot, view.alive
    living = model.local.living(alive)
    cloud = cloud_at(model, knot, living)
    extra = [flow_to_neighbor(model, view, living, cloud.means, o) for o in view.offsets]
    parts = None
    if view.late is not None and batch.recorder is not None:
        radiance = seen_radiance(model, batch.camera, cloud)
        parts = record_parts(model, batch.recorder, batch.camera, radiance, cloud.means)
        extra.append(parts.gaussians)
    maps = expose(model, view, living, cloud, extra)
    model.trajectories.mark(knot)
    model.local.mark(alive)
    terms = regularizers(model, cloud, knot)
    if view.rigidity:
        terms["rigidity"] = mixture_difference(model.mixture_logits, model.neighbors)
        terms["evenness"] = model.local.unevenness(alive, living, model.unit)
    return maps, parts, terms


def cloud_by_kernels(model: Model, view: TrainingView, make_cloud: CloudMaker) -> Cloud:
    """The Gaussians of the view by kernels, with flow to one neighbor at most."""
    batch, knot = view.batch, view.knot
    neighbor = None
    for offset in view.offsets:
        there = model.nearest_knot(knot + offset)
        neighbor = there, model.time(there), batch.neighbors[offset]
    when = knot, model.time(knot), model.share(knot)
    moment = Moment(*when, batch.camera, neighbor, view.rigidity)
    return make_cloud(model, moment, view.alive)


def expose(
    model: Model, view: TrainingView, living: Living, cloud: GaussianCloud, extra: list[Tensor]
) -> Maps:
    """What the frame sees of the `cloud` through its shutter, with `extra` features
    (G, ...).
    """
    batch, shutter = view.batch, view.shutter

    def draw_at(means: Tensor) -> Maps:
        return draw(model, batch.camera, replace(cloud, means=means), extra)

    if shutter is None or not batch.neighbors:
        return draw_at(cloud.means)
    neighbors = []
    for offset in sorted(batch.neighbors):
        knot = view.knot + offset
        points = positions_at(model, knot, living).detach()
        neighbors.append((batch.neighbors[offset], points, model.time(knot)))
    motion = apparent_motion(batch.camera, neighbors, cloud.means, batch.time)
    return Maps(*shutter.expose(draw_at, batch.camera, cloud.means, motion, batch.frame))


def flow_to_neighbor(
    model: Model, view: TrainingView, living: Living, means: Tensor, offset: int
) -> Tensor:
    """Optical flow (G, 2) in pixels, from the frame's camera to a neighboring one.

    From where the camera sees each Gaussian's mean (G, 3) to where the neighbor sees it
    at its own time.
    """
    moved = positions_at(model, model.nearest_knot(view.knot + offset), living)
    camera, neighbor = view.batch.camera, view.batch.neighbors[offset]
    limit = MAX_FLOW * camera.width
    return (neighbor.project(moved)[0] - camera.project(means)[0]).clamp(-limit, limit)
