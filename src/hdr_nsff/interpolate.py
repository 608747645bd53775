"""Pictures at times between the training frames (METHOD.md section 4). Two ways:

- `splat`: both neighbouring training times are seen from the target camera as layers, every sample is moved by the fraction
  of its scene flow, splatted into the picture layer by layer, composited front to back; the two pictures are blended by the
  fraction. Plain torch scatter-adds, any device.
- `direct`: the field is asked at the fractional time itself.

Splatting, layer by layer: bilinear weights w, alpha = sum(w * alpha) / clamp(sum(w), 0.5, 1), at most 1. Where samples spread
this is average splatting, so no cracks open; where they pile up, as a mover over empty samples that stand still, it is the
sum, so a mover keeps its opacity; where hardly anything lands, alpha fades. Where one time shows nothing (the content moved away) the other fills in; where neither does, the
nearer training time stands unmoved, so there are no holes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from hdr_nsff.camera import Camera
from hdr_nsff.fields.base import Layers, RadianceField, Render

Mode = Literal["auto", "splat", "direct"]
SAME_TIME = 1e-4  # frames: closer than this to a training time is that time
SPREAD = 0.5  # smallest sum of weights that average splatting makes up for: samples spread to half their density
FAINT = 0.1  # presence below this is topped up from the nearer training time


@runtime_checkable
class LayeredField(RadianceField, Protocol):
    """A field that can show its samples, for splatting."""

    def layers(self, camera: Camera, time: float) -> Layers:
        """What `camera` sees at the training time `time`, sample by sample, without gradients."""
        ...


@dataclass(frozen=True)
class Picture:
    """A composited view; every quantity is premultiplied by opacity."""

    opacity: Tensor  # (S, 1)
    colour: Tensor  # (S, C): radiance, disparity, motion


def neighbours(time: float, times: Sequence[float]) -> tuple[float, float, float]:
    """The training times just before and after `time`, and the fraction in [0, 1] of the way between them.

    At a training time, and outside their range, both are the nearest one and the fraction is 0."""
    nearest = min(times, key=lambda t: abs(t - time))
    before, after = [t for t in times if t <= time], [t for t in times if t > time]
    if abs(nearest - time) < SAME_TIME or not before or not after:
        return nearest, nearest, 0.0
    return max(before), min(after), (time - max(before)) / (min(after) - max(before))


@torch.no_grad()
def render_at(field: RadianceField, camera: Camera, time: float, times: Sequence[float], mode: Mode = "auto") -> Render:
    """The whole picture (S = height * width, row by row) at any `time`; `times` are the training times in order.

    `auto` splats where the field has layers and asks directly where it has none; `splat` demands layers. A splatted
    `Render` carries no scene flow."""
    before, after, fraction = neighbours(time, times)
    if fraction == 0 or mode == "direct" or (mode == "auto" and not isinstance(field, LayeredField)):
        return field.render(camera, time)
    assert isinstance(field, LayeredField), f"{type(field).__name__} has no layers to splat"
    moved, unmoved = zip(
        splat(field.layers(camera, before), camera, 1, fraction),
        splat(field.layers(camera, after), camera, -1, 1 - fraction),
        strict=True,
    )
    return blend(moved, unmoved[0] if fraction <= 0.5 else unmoved[1], unmoved, fraction)


def splat(layers: Layers, camera: Camera, direction: int, fraction: float) -> tuple[Picture, Picture]:
    """The layers moved by `fraction` of their scene flow towards `direction` (+-1) and composited; and the same unmoved."""
    num_layers = layers.alpha.shape[1]
    moved, unmoved = Compositor(layers.alpha[:, :1]), Compositor(layers.alpha[:, :1])
    for i in range(num_layers):
        alpha, motion = layers.alpha[:, i, None], layers.motion[:, i, None]  # (S, 1)
        flow, position = layers.scene_flow[direction][:, i], layers.positions[:, i]  # (S, 3)
        value = torch.cat([layers.radiance[:, i], inverse(camera.to_camera(position)[:, 2:]), motion], -1)  # (S, 5)
        unmoved.add(alpha, value)
        if not flow.any():
            moved.add(alpha, value)
            continue
        pixels, depth = camera.project(position + fraction * flow)
        value = torch.cat([layers.radiance[:, i], inverse(depth[:, None]), motion], -1)
        moved.add(*splat_layer(pixels, alpha * (depth > 0)[:, None], value, camera.width, camera.height))
    return moved.picture(), unmoved.picture()


def inverse(depth: Tensor) -> Tensor:
    """Disparity of z-depths; 0 behind the camera."""
    return torch.where(depth > 1e-6, 1 / depth.clamp_min(1e-6), 0.0)


class Compositor:
    """Front-to-back compositing, one layer at a time."""

    def __init__(self, like: Tensor) -> None:
        self.transmittance = torch.ones_like(like)  # (S, 1)
        self.colour: Tensor | float = 0.0

    def add(self, alpha: Tensor, value: Tensor) -> None:
        """Put a layer with `alpha` (S, 1) and `value` (S, C) behind what is there."""
        self.colour = self.colour + self.transmittance * alpha * value
        self.transmittance = self.transmittance * (1 - alpha)

    def picture(self) -> Picture:
        """What has been composited so far."""
        assert isinstance(self.colour, Tensor), "no layers"
        return Picture(1 - self.transmittance, self.colour)


def splat_layer(pixels: Tensor, alpha: Tensor, value: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Alpha (S, 1) and value (S, C) of one layer once its samples have moved to `pixels` (S, 2), centres at +0.5.

    Bilinear scatter-add; what leaves the picture is lost. `value` is averaged with the weight of its alpha."""
    mass = torch.cat([torch.ones_like(alpha), alpha, alpha * value], -1)  # (S, 2 + C)
    total = mass.new_zeros(width * height, mass.shape[1])
    corner = (pixels - 0.5).floor()
    share = (pixels - 0.5) - corner  # (S, 2) of the way to the next column, row
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = corner[:, 0] + dx, corner[:, 1] + dy
            weight = (share[:, 0] if dx else 1 - share[:, 0]) * (share[:, 1] if dy else 1 - share[:, 1])
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (weight > 0)
            flat = (row[inside] * width + column[inside]).long()
            total.index_add_(0, flat, mass[inside] * weight[inside, None])
    landed, opaque, colour = total[:, :1], total[:, 1:2], total[:, 2:]
    return (opaque / landed.clamp(SPREAD, 1.0)).clamp(0, 1), colour / opaque.clamp_min(1e-6)


def sum_of(parts: Iterable[Tensor]) -> Tensor:
    """The sum of tensors of one shape."""
    return torch.stack(list(parts)).sum(0)


def blend(moved: Sequence[Picture], nearer: Picture, unmoved: Sequence[Picture], fraction: float) -> Render:
    """Two pictures blended by `fraction`, each counted as far as its content is present (opacity against the unmoved one's)."""
    shares = (1 - fraction, fraction)
    presence = sum_of(
        share * torch.where(still.opacity > 1e-3, now.opacity / still.opacity.clamp_min(1e-3), 1.0).clamp(0, 1)
        for share, now, still in zip(shares, moved, unmoved, strict=True)
    )
    opacity = sum_of(share * now.opacity for share, now in zip(shares, moved, strict=True))
    colour = sum_of(share * now.colour for share, now in zip(shares, moved, strict=True))
    lack = (1 - presence / FAINT).clamp_min(0)  # > 0 only where hardly anything landed from either side
    scale = 1 / presence.clamp_min(FAINT)
    opacity = (opacity * scale + lack * nearer.opacity).clamp(0, 1)  # (S, 1)
    colour = colour * scale + lack * nearer.colour  # (S, 5)
    rest = colour[:, 3:] / opacity.clamp_min(1e-6)
    return Render(
        radiance=colour[:, :3], depth=1 / rest[:, 0].clamp_min(1e-6), opacity=opacity[:, 0], motion=rest[:, 1].clamp(0, 1)
    )
