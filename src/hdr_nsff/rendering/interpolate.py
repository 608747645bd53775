"""Pictures at times between the training frames, in one of two ways (docs/method.md).

- `splat`, after Niklaus and Liu (2020) and the space-time interpolation of NSFF (Li et
  al. 2021): both neighboring training times are rendered from the target camera as
  layers. Every sample moves by the fraction of its scene flow, is splatted into the
  picture layer by layer, and the layers are composited front to back. The two pictures
  are blended by the fraction. Plain torch scatter-adds, any device.
- `direct`: the field is rendered at the fractional time itself.

Splatting, layer by layer: bilinear weights w, alpha = sum(w * alpha) / clamp(sum(w),
0.8, 1), at most 1. Where samples spread this is average splatting, so no cracks open.
Where they pile up, like a mover over empty samples at rest, it is the sum, so a mover
keeps its opacity. Where hardly anything lands, alpha fades. Where one time shows
nothing, because the content moved away, the other fills in; where neither does, the
nearer training time is shown unmoved, so there are no holes. The picture's scene flow
is that of its layers, in a straight line over the interval.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.fields.base import RadianceField, Render
from hdr_nsff.fields.outputs import Layers
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths.volume import transmittance, weighted_sum

Mode = Literal["auto", "splat", "direct"]
TIME_TOLERANCE = 1e-4  # frames: closer than this to a training time is that time
MIN_ALPHA = 1e-3  # samples of less alpha are empty and do not move (hand-chosen)
# Smallest sum of weights that average splatting normalizes: that of content that grows
# by a tenth along each side, 1 / 1.1^2 = 0.83.
MIN_WEIGHT_SUM = 0.8
# Presence below this is filled from the nearer training time (hand-chosen on rendered
# scenes).
MIN_PRESENCE = 0.1
MIN_OPACITY = 1e-3  # of an unmoved picture: below this, presence is not defined


@runtime_checkable
class LayeredField(RadianceField, Protocol):
    """A field that gives access to its samples, for splatting."""

    def layers(self, camera: Camera, time: float) -> Layers:
        """The samples along the rays of `camera` at the training time `time`.

        Without gradients.
        """
        ...


@dataclass(frozen=True)
class Picture:
    """A composited view; every quantity is premultiplied by opacity."""

    opacity: Tensor  # (S, 1)
    # (S, C): radiance, disparity, motion, displacement over the training interval
    color: Tensor


def neighbors(time: float, times: Sequence[float]) -> tuple[float, float, float]:
    """The training times just before and after `time`, and the fraction in between.

    The fraction is in [0, 1]. At a training time, and outside their range, both are the
    nearest one and the fraction is 0.
    """
    nearest = min(times, key=lambda t: abs(t - time))
    earlier = [t for t in times if t <= time]
    later = [t for t in times if t > time]
    if abs(nearest - time) < TIME_TOLERANCE or not earlier or not later:
        return nearest, nearest, 0.0
    before, after = max(earlier), min(later)
    return before, after, (time - before) / (after - before)


@torch.no_grad()
def render_at(
    field: RadianceField,
    camera: Camera,
    time: float,
    times: Sequence[float],
    mode: Mode = "auto",
    scene_flow: bool = True,
) -> Render:
    """The whole picture (S = height * width, row by row) at any `time` in frames.

    `times` are the training times in order. `auto` splats where the field has layers
    and renders directly where it has none; `splat` demands layers.
    """
    before, after, fraction = neighbors(time, times)
    layered = isinstance(field, LayeredField)
    if fraction == 0 or mode == "direct" or (mode == "auto" and not layered):
        return field.render(camera, time, scene_flow=scene_flow)
    assert isinstance(field, LayeredField), f"{type(field).__name__} has no layers to splat"
    forward, before_unmoved = splat(field.layers(camera, before), camera, 1, fraction)
    backward, after_unmoved = splat(field.layers(camera, after), camera, -1, 1 - fraction)
    render = blend((forward, backward), (before_unmoved, after_unmoved), fraction)
    if not scene_flow:
        return replace(render, scene_flow={})
    interval = after - before
    spans = {side: flow_duration(time, side, times) / interval for side in render.scene_flow}
    return replace(render, scene_flow={o: spans[o] * f for o, f in render.scene_flow.items()})


def flow_duration(time: float, direction: int, times: Sequence[float]) -> float:
    """Over how many frames the scene flow at a time goes later (1) or earlier (-1).

    That is one training interval of the `times`. Beyond their ends it continues the
    flow of the other direction. Where neither is within the clip, it goes from end to
    end; infinite for a clip of one time: no flow.
    """
    knots = np.arange(len(times))
    knot = float(np.interp(time, times, knots))
    for side in (direction, -direction):
        if knots[0] <= knot + side <= knots[-1]:
            return abs(float(np.interp(knot + side, knots, times)) - time)
    return times[-1] - times[0] if len(times) > 1 else math.inf


def splat(
    layers: Layers, camera: Camera, direction: int, fraction: float
) -> tuple[Picture, Picture]:
    """The layers moved by a `fraction` of their scene flow; and the same unmoved.

    The flow is that towards `direction` (+-1); both pictures are composited. Empty
    samples (alpha below `MIN_ALPHA`) do not move. Only the samples that move, and those
    they leave or land on, are recomputed; the rest of the picture is that of the
    unmoved layers.
    """
    num_layers = layers.alpha.shape[1]
    disparity = inverse(camera.to_camera(layers.positions)[..., 2:])
    flow = layers.scene_flow[direction]
    displacement = direction * flow  # from the earlier time to the later one
    values = torch.cat([layers.radiance, disparity, layers.motion[..., None], displacement], -1)
    alpha = layers.alpha.reshape(-1, 1)  # (S L, 1): sample = pixel * L + layer
    value = values.reshape(-1, 8)  # (S L, 8)
    positions = layers.positions.reshape(-1, 3)  # (S L, 3)
    flow = flow.reshape(-1, 3)  # (S L, 3)
    moving = (alpha[:, 0] > MIN_ALPHA) & flow.any(-1)  # (S L,)
    unmoved = composite(alpha, value, num_layers)
    source = moving.nonzero()[:, 0]  # (M,)
    if not len(source):
        return unmoved, unmoved
    pixels, depth = camera.project(positions[source] + fraction * flow[source])
    content = torch.cat([value[source, :3], inverse(depth[:, None]), value[source, 4:]], -1)
    landing, weight = corners(pixels, camera.width, camera.height)  # (4 M,) pixel each, (4 M,)
    target = landing * num_layers + (source % num_layers).repeat(4)
    weight = weight * (depth > 0).repeat(4)
    touched, place = torch.cat([source, target]).unique(return_inverse=True)
    at_rest = (~moving[touched])[:, None]
    sums = summands(alpha[touched], value[touched]) * at_rest
    arriving = summands(alpha[source], content).repeat(4, 1) * weight[:, None]
    sums.index_add_(0, place[len(source) :], arriving)
    return composite(alpha, value, num_layers, (touched, *normalize(sums))), unmoved


def summands(alpha: Tensor, value: Tensor) -> Tensor:
    """The quantities (M, 2 + C) that splatting adds up: 1, alpha, alpha * value."""
    return torch.cat([torch.ones_like(alpha), alpha, alpha * value], -1)


def normalize(sums: Tensor) -> tuple[Tensor, Tensor]:
    """Alpha (M, 1) and value (M, C) of the sums (M, 2 + C) of splatted samples."""
    weight, opaque = sums[:, :1], sums[:, 1:2]
    value = sums[:, 2:]
    alpha = (opaque / weight.clamp(MIN_WEIGHT_SUM, 1.0)).clamp(0, 1)
    return alpha, value / opaque.clamp_min(1e-6)


def corners(pixels: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The four pixels around each point (M, 2), and their bilinear weights (4 M,).

    `pixels` have their centers at +0.5. The four are positions row by row (4 M,). The
    weights of a point add up to 1; those outside the picture are 0.
    """
    corner = (pixels - 0.5).floor()
    share = (pixels - 0.5) - corner  # (M, 2) of the way to the next column, row
    places, weights = [], []
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = corner[:, 0] + dx, corner[:, 1] + dy
            weight_x = share[:, 0] if dx else 1 - share[:, 0]
            weight_y = share[:, 1] if dy else 1 - share[:, 1]
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            place = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
            places.append(place.long())
            weights.append(weight_x * weight_y * inside)
    return torch.cat(places), torch.cat(weights)


def composite(
    alpha: Tensor,
    value: Tensor,
    num_layers: int,
    changes: tuple[Tensor, Tensor, Tensor] | None = None,
) -> Picture:
    """Samples of alpha (S L, 1) and value (S L, C), front to back.

    `changes` are samples (M,) with another alpha (M, 1) and value (M, C).
    """
    if changes is not None:
        alpha = alpha.index_copy(0, changes[0], changes[1])
    layers = alpha.view(-1, num_layers)
    weights = transmittance(layers) * layers  # (S, L)
    color = weighted_sum(weights, value.view(-1, num_layers, value.shape[1]))
    if changes is not None:
        sample, _, new_value = changes
        difference = weights.view(-1, 1)[sample] * (new_value - value[sample])
        pixel = torch.div(sample, num_layers, rounding_mode="floor")
        color = color.index_add(0, pixel, difference)
    return Picture(weights.sum(-1, keepdim=True), color)


def inverse(depth: Tensor) -> Tensor:
    """Disparity of z-depths; 0 behind the camera."""
    return torch.where(depth > 1e-6, 1 / depth.clamp_min(1e-6), 0.0)


def sum_of(parts: Iterable[Tensor]) -> Tensor:
    """The sum of tensors of one shape."""
    return torch.stack(list(parts)).sum(0)


def blend(moved: Sequence[Picture], unmoved: Sequence[Picture], fraction: float) -> Render:
    """Two pictures blended by `fraction`, each weighted by the presence of its content:
    its opacity relative to that of the unmoved picture. Scene flow is over the whole
    interval between them.
    """
    shares = (1 - fraction, fraction)
    presence = sum_of(
        share * presence_of(picture, reference)
        for share, picture, reference in zip(shares, moved, unmoved, strict=True)
    )
    opacity = sum_of(share * now.opacity for share, now in zip(shares, moved, strict=True))
    color = sum_of(share * now.color for share, now in zip(shares, moved, strict=True))
    # Above 0 only where hardly anything landed from either side.
    lack = (1 - presence / MIN_PRESENCE).clamp_min(0)
    nearer = unmoved[0] if fraction <= 0.5 else unmoved[1]
    scale = 1 / presence.clamp_min(MIN_PRESENCE)
    opacity = (opacity * scale + lack * nearer.opacity).clamp(0, 1)  # (S, 1)
    color = color * scale + lack * nearer.color  # (S, 8)
    rest = color[:, 3:5] / opacity.clamp_min(1e-6)
    displacement = color[:, 5:]
    return Render(
        radiance=color[:, :3],
        depth=1 / rest[:, 0].clamp_min(1e-6),
        opacity=opacity[:, 0],
        motion=rest[:, 1].clamp(0, 1),
        scene_flow={1: displacement, -1: -displacement},
    )


def presence_of(moved: Picture, unmoved: Picture) -> Tensor:
    """The share (S, 1) in [0, 1] of the unmoved picture's opacity that is still there.

    1 where the unmoved picture is empty.
    """
    ratio = moved.opacity / unmoved.opacity.clamp_min(MIN_OPACITY)
    return torch.where(unmoved.opacity > MIN_OPACITY, ratio, 1.0).clamp(0, 1)
