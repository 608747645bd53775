"""Pictures at times between the training frames (METHOD.md section 4). Two ways:

- `splat`: both neighboring training times are seen from the target camera as layers,
  every sample is moved by the fraction of its scene flow, splatted into the picture
  layer by layer, composited front to back; the two pictures are blended by the
  fraction. Plain torch scatter-adds, any device.
- `direct`: the field is asked at the fractional time itself.

Splatting, layer by layer: bilinear weights w, alpha = sum(w * alpha) / clamp(sum(w),
0.8, 1), at most 1. Where samples spread this is average splatting, so no cracks open;
where they pile up, as a mover over empty samples that stand still, it is the sum, so a
mover keeps its opacity; where hardly anything lands, alpha fades. Where one time shows
nothing (the content moved away) the other fills in; where neither does, the nearer
training time stands unmoved, so there are no holes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from hdr_nsff.fields.base import Layers, RadianceField, Render
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths.volume import transmittance, weighted_sum

Mode = Literal["auto", "splat", "direct"]
SAME_TIME = 1e-4  # frames: closer than this to a training time is that time
EMPTY = 1e-3  # samples of less alpha hold nothing and stand still
# smallest sum of weights that average splatting makes up for: content that grows by a
# tenth along each side
SPREAD = 0.8
FAINT = 0.1  # presence below this is topped up from the nearer training time


@runtime_checkable
class LayeredField(RadianceField, Protocol):
    """A field that can show its samples, for splatting."""

    def layers(self, camera: Camera, time: float) -> Layers:
        """What `camera` sees at the training time `time`, sample by sample, without
        gradients.
        """
        ...


@dataclass(frozen=True)
class Picture:
    """A composited view; every quantity is premultiplied by opacity."""

    opacity: Tensor  # (S, 1)
    color: Tensor  # (S, C): radiance, disparity, motion


def neighbors(time: float, times: Sequence[float]) -> tuple[float, float, float]:
    """The training times just before and after `time`, and the fraction in [0, 1] of
    the way between them.

    At a training time, and outside their range, both are the nearest one and the
    fraction is 0.
    """
    nearest = min(times, key=lambda t: abs(t - time))
    before, after = [t for t in times if t <= time], [t for t in times if t > time]
    if abs(nearest - time) < SAME_TIME or not before or not after:
        return nearest, nearest, 0.0
    return max(before), min(after), (time - max(before)) / (min(after) - max(before))


@torch.no_grad()
def render_at(
    field: RadianceField,
    camera: Camera,
    time: float,
    times: Sequence[float],
    mode: Mode = "auto",
    scene_flow: bool = True,
) -> Render:
    """The whole picture (S = height * width, row by row) at any `time`; `times` are the
    training times in order.

    `auto` splats where the field has layers and asks directly where it has none;
    `splat` demands layers. A splatted `Render` carries no scene flow, nor does one
    without `scene_flow`.
    """
    before, after, fraction = neighbors(time, times)
    if (
        fraction == 0
        or mode == "direct"
        or (mode == "auto" and not isinstance(field, LayeredField))
    ):
        return field.render(camera, time, scene_flow=scene_flow)
    assert isinstance(field, LayeredField), f"{type(field).__name__} has no layers to splat"
    moved, unmoved = zip(
        splat(field.layers(camera, before), camera, 1, fraction),
        splat(field.layers(camera, after), camera, -1, 1 - fraction),
        strict=True,
    )
    return blend(moved, unmoved[0] if fraction <= 0.5 else unmoved[1], unmoved, fraction)


def splat(
    layers: Layers, camera: Camera, direction: int, fraction: float
) -> tuple[Picture, Picture]:
    """The layers moved by `fraction` of their scene flow towards `direction` (+-1) and
    composited; and the same unmoved.

    Samples without content (alpha below `EMPTY`) stand still. Only the samples that
    move, and those they leave or land on, are computed anew; the rest of the picture is
    that of the unmoved layers.
    """
    num_layers, flow = layers.alpha.shape[1], layers.scene_flow[direction]
    value = torch.cat(
        [
            layers.radiance,
            inverse(camera.to_camera(layers.positions)[..., 2:]),
            layers.motion[..., None],
        ],
        -1,
    )
    alpha, value = (
        layers.alpha.reshape(-1, 1),
        value.reshape(-1, 5),
    )  # (S L, ...): sample = pixel * L + layer
    moving = (alpha[:, 0] > EMPTY) & flow.reshape(-1, 3).any(-1)
    source = moving.nonzero()[:, 0]
    unmoved = composite(alpha, value, num_layers)
    if not len(source):
        return unmoved, unmoved
    position = layers.positions.reshape(-1, 3)[source] + fraction * flow.reshape(-1, 3)[source]
    pixels, depth = camera.project(position)
    content = torch.cat([value[source, :3], inverse(depth[:, None]), value[source, 4:]], -1)
    landing, weight = corners(pixels, camera.width, camera.height)  # (4 M,) pixel each, (4 M,)
    target = landing * num_layers + (source % num_layers).repeat(4)
    weight = weight * (depth > 0).repeat(4)
    touched, place = torch.cat([source, target]).unique(return_inverse=True)
    mass = (
        masses(alpha[touched], value[touched]) * (~moving[touched])[:, None]
    )  # what stands still there
    arriving = masses(alpha[source], content).repeat(4, 1) * weight[:, None]
    mass.index_add_(0, place[len(source) :], arriving)
    return composite(alpha, value, num_layers, (touched, *settle(mass))), unmoved


def masses(alpha: Tensor, value: Tensor) -> Tensor:
    """What samples add up to, (M, 2 + C): presence, alpha, alpha * value."""
    return torch.cat([torch.ones_like(alpha), alpha, alpha * value], -1)


def settle(mass: Tensor) -> tuple[Tensor, Tensor]:
    """Alpha (M, 1) and value (M, C) of summed masses (M, 2 + C)."""
    landed, opaque, value = mass[:, :1], mass[:, 1:2], mass[:, 2:]
    return (opaque / landed.clamp(SPREAD, 1.0)).clamp(0, 1), value / opaque.clamp_min(1e-6)


def corners(pixels: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The four pixels around each of `pixels` (M, 2; centers at +0.5) as positions row
    by row (4 M,), and their bilinear weights (4 M,), which add up to 1; weight 0
    outside the picture.
    """
    corner = (pixels - 0.5).floor()
    share = (pixels - 0.5) - corner  # (M, 2) of the way to the next column, row
    places, weights = [], []
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = corner[:, 0] + dx, corner[:, 1] + dy
            weight = (share[:, 0] if dx else 1 - share[:, 0]) * (
                share[:, 1] if dy else 1 - share[:, 1]
            )
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            places.append((row.clamp(0, height - 1) * width + column.clamp(0, width - 1)).long())
            weights.append(weight * inside)
    return torch.cat(places), torch.cat(weights)


def composite(
    alpha: Tensor,
    value: Tensor,
    num_layers: int,
    changes: tuple[Tensor, Tensor, Tensor] | None = None,
) -> Picture:
    """Samples of alpha (S L, 1) and value (S L, C) front to back; `changes` are samples
    (M,) that have another alpha (M, 1) and value (M, C) instead.
    """
    if changes is not None:
        alpha = alpha.index_copy(0, changes[0], changes[1])
    layers = alpha.view(-1, num_layers)
    weights = transmittance(layers) * layers  # (S, L)
    color = weighted_sum(weights, value.view(-1, num_layers, value.shape[1]))
    if changes is not None:
        at, _, other = changes
        difference = weights.view(-1, 1)[at] * (other - value[at])
        color = color.index_add(0, torch.div(at, num_layers, rounding_mode="floor"), difference)
    return Picture(weights.sum(-1, keepdim=True), color)


def inverse(depth: Tensor) -> Tensor:
    """Disparity of z-depths; 0 behind the camera."""
    return torch.where(depth > 1e-6, 1 / depth.clamp_min(1e-6), 0.0)


def sum_of(parts: Iterable[Tensor]) -> Tensor:
    """The sum of tensors of one shape."""
    return torch.stack(list(parts)).sum(0)


def blend(
    moved: Sequence[Picture], nearer: Picture, unmoved: Sequence[Picture], fraction: float
) -> Render:
    """Two pictures blended by `fraction`, each counted as far as its content is present
    (opacity against the unmoved one's).
    """
    shares = (1 - fraction, fraction)
    presence = sum_of(
        share
        * torch.where(still.opacity > 1e-3, now.opacity / still.opacity.clamp_min(1e-3), 1.0).clamp(
            0, 1
        )
        for share, now, still in zip(shares, moved, unmoved, strict=True)
    )
    opacity = sum_of(share * now.opacity for share, now in zip(shares, moved, strict=True))
    color = sum_of(share * now.color for share, now in zip(shares, moved, strict=True))
    lack = (1 - presence / FAINT).clamp_min(
        0
    )  # > 0 only where hardly anything landed from either side
    scale = 1 / presence.clamp_min(FAINT)
    opacity = (opacity * scale + lack * nearer.opacity).clamp(0, 1)  # (S, 1)
    color = color * scale + lack * nearer.color  # (S, 5)
    rest = color[:, 3:] / opacity.clamp_min(1e-6)
    return Render(
        radiance=color[:, :3],
        depth=1 / rest[:, 0].clamp_min(1e-6),
        opacity=opacity[:, 0],
        motion=rest[:, 1].clamp(0, 1),
    )
