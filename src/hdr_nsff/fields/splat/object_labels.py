"""Which object of the prepared scene a moving Gaussian belongs to.

Gaussians carry no labels. In training frames that see them, the mover of the nearest
track gives them one: to a moving Gaussian by the vote of several frames, to a
time-local one by the frame nearest to the middle of its life.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from hdr_nsff.fields.splat.draw import draw
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.movers import NO_MOVER, nearest_mover
from hdr_nsff.scene.scene import Frame, Scene

VOTES = 9  # frames that vote, spread evenly over the clip (hand-chosen)


@dataclass(frozen=True)
class ObjectLabels:
    """Movers by number, -1 where none is known, on the CPU."""

    moving: Tensor  # (M,) of moving Gaussians
    local: Tensor  # (L,) of time-local Gaussians


@torch.no_grad()
def label_objects(field: Splat, scene: Scene) -> ObjectLabels:
    """The movers of a field's Gaussians; -1 for all where the scene has no movers."""
    num_moving, num_local = len(field.moving), len(field.local)
    if not scene.movers:
        return ObjectLabels(torch.full((num_moving,), -1), torch.full((num_local,), -1))
    position = {int(index): t for t, index in enumerate(scene.movers[0].frames)}
    frames = [frame for frame in scene.train if frame.index in position]
    times = torch.tensor([frame.time for frame in frames])
    votes = torch.zeros(num_moving, len(scene.movers))
    chosen = np.linspace(0, len(frames) - 1, min(VOTES, len(frames))).round().astype(int)
    rows = torch.arange(num_moving)
    first = len(field.static)
    for i in sorted(set(chosen.tolist())):
        means = field.positions(field.knot(float(times[i])))[first : first + num_moving]
        label, seen = labels_in_frame(scene, frames[i].camera, position[frames[i].index], means)
        votes[rows[seen], label[seen]] += 1
    moving = torch.where(votes.sum(1) > 0, votes.argmax(1), -1)
    return ObjectLabels(moving, label_local(field, scene, frames, times, position))


def label_local(
    field: Splat, scene: Scene, frames: list[Frame], times: Tensor, position: dict[int, int]
) -> Tensor:
    """The movers (L,) of the time-local Gaussians, each at the middle of its life."""
    centers = field.local.means[:, 3].cpu()
    nearest = (centers[:, None] - times).abs().argmin(1)
    labels = torch.full((len(centers),), -1)
    for i in nearest.unique().tolist():
        rows = (nearest == i).nonzero()[:, 0]
        means = field.local.living(rows).positions(float(times[i]))
        label, seen = labels_in_frame(scene, frames[i].camera, position[frames[i].index], means)
        labels[rows[seen]] = label[seen]
    return labels


def labels_in_frame(scene: Scene, camera: Camera, t: int, means: Tensor) -> tuple[Tensor, Tensor]:
    """The mover (P,) of points (P, 3) at the t-th time of movers, and whether `camera`
    sees them there (P,) bool.
    """
    pixels, depth = camera.project(means.cpu())
    size = torch.tensor([camera.width, camera.height])
    inside = ((pixels >= 0) & (pixels < size)).all(1) & (depth > 0)
    tracked = any(np.isfinite(mover.pixels[:, t, 0]).any() for mover in scene.movers)
    K, c2w = camera.K.double().cpu().numpy(), camera.c2w.double().cpu().numpy()
    label = torch.from_numpy(nearest_mover(scene.movers, t, pixels.numpy(), (K, c2w)))
    return label, inside & tracked & (label != NO_MOVER)


@torch.no_grad()
def object_coverage(
    field: Splat, labels: ObjectLabels, count: int, camera: Camera, time: float
) -> Tensor:
    """Coverage (S, 2 + count) in [0, 1] of a whole picture at `time` in frames.

    The columns are static content, moving content of no mover, and `count` movers. They
    add up to the opacity.
    """
    knot = field.knot(time)
    alive = field.alive(knot)
    cloud = field.cloud(knot, alive)
    static = torch.zeros(len(field.static), dtype=torch.long)
    column = torch.cat([static, labels.moving + 2, labels.local[alive.cpu()] + 2])
    column[len(static) :].clamp_min_(1)
    shares = nn.functional.one_hot(column, 2 + count).to(cloud.means)
    maps = draw(field.model(), camera, cloud, [shares])
    return maps.features.flatten(0, 1)[:, 4:].clamp(0, 1)
