"""The part of an NSFF's training pass that scene flow makes: warped renders (eq. 2-3),
rendered flow, and the regularizers of METHOD.md 3 that live on samples. One object per
pass, so that the pieces can name what they share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hdr_nsff.fields.base import Render, Warp
from hdr_nsff.fields.nsff.samples import Content, March
from hdr_nsff.fields.nsff.two_branches import TwoBranches
from hdr_nsff.maths import losses, volume
from hdr_nsff.scene.batch import PixelBatch


@dataclass
class Motion:
    """Everything known about one training pass after both branches were asked at the
    batch's own time.
    """

    field: TwoBranches
    to_flow: Callable[
        [Tensor], Tensor
    ]  # raw motion (M, 8) to scene flow in cube units, forward and backward (M, 2, 3)
    batch: PixelBatch
    m: March
    knot: float
    index: Tensor  # (M,) dynamic samples among N * S
    coords: Tensor  # (M, 3) cube
    raw: Tensor  # (M, 8)
    static: Content
    dynamic: Content
    w: volume.Weights

    def __post_init__(self) -> None:
        field, knots = self.field, len(self.field.times)
        self.flow = self.to_flow(self.raw)  # (M, 2, 3) cube
        self.disocclusion = self.raw[:, 3::4].sigmoid()  # (M, 2)
        self.offsets = [o for o in (1, -1) if 0 <= self.knot + o <= knots - 1]
        s = self.m.depths.shape[1]
        ray = torch.div(self.index, s, rounding_mode="floor")
        self.active, self.ray = torch.unique(
            ray, return_inverse=True
        )  # rays with dynamic samples, and each sample's place among them
        self.slot = self.ray * s + self.index % s  # (M,) samples among active rays
        self.here = field.space.decode(self.coords)
        self.moved = {o: self.coords + self.flow[:, self.side(o)] for o in self.offsets}  # cube
        self.displacement = {
            o: field.space.decode(u) - self.here for o, u in self.moved.items()
        }  # (M, 3) scene units
        self.views = field.views(self.m, self.index)
        self.there = {}  # raw motion at the moved points
        self.contents = {}
        for o, u in self.moved.items():
            shape = torch.Size((len(self.active), s))
            self.contents[o], self.there[o] = field.dynamic_content(
                u, self.slot, shape, self.knot + o, self.views, motion=True
            )

    @staticmethod
    def side(offset: int) -> int:
        """Column of the forward or backward direction."""
        return 0 if offset > 0 else 1

    def render(self) -> Render:
        """The blended render with its warps."""
        w, m = self.w, self.m
        radiance = volume.weighted_sum(w.static, self.static.radiance) + volume.weighted_sum(
            w.dynamic, self.dynamic.radiance
        )
        both = w.static + w.dynamic
        depth = volume.expected_depth(both, m.depths, self.field.far)
        alone = (
            volume.single(self.dynamic.density, m.deltas)
            if self.field.config.compositing == "blend"
            else None
        )
        packed = w.dynamic.reshape(-1)[self.index]
        scene_flow = {o: self.gather(packed[:, None] * d) for o, d in self.displacement.items()}
        warps = [self.warp(o, radiance, depth, w.opacity, scene_flow[o]) for o in self.offsets]
        if self.batch.chain in self.moved:
            warps.append(self.chained(self.batch.chain, radiance))
        return Render(
            radiance,
            depth,
            w.opacity,
            w.dynamic.sum(-1),
            scene_flow,
            tuple(w for w in warps if w is not None),
            None if alone is None else volume.weighted_sum(alone, self.dynamic.radiance),
            None if alone is None else volume.expected_depth(alone, m.depths, self.field.far),
        )

    def gather(self, values: Tensor) -> Tensor:
        """Sum of packed `values` (M, C) per ray: (N, C)."""
        ray = torch.div(self.index, self.m.depths.shape[1], rounding_mode="floor")
        return values.new_zeros(len(self.m.depths), values.shape[1]).index_add(0, ray, values)

    def warped_radiance(self, content: Content, radiance: Tensor) -> Tensor:
        """Composite `content` (of another time, moved here) with this pass's distances:
        (N, 3). Where densities add up the static branch takes part; with eq. 7 the
        dynamic branch stands alone, as published. Rays without dynamic samples repeat
        `radiance`.
        """
        deltas = self.m.deltas[self.active]
        if self.field.config.compositing == "blend":
            seen = volume.weighted_sum(volume.single(content.density, deltas), content.radiance)
        else:
            behind = Content(
                self.static.density[self.active], self.static.radiance[self.active], content.blend
            )
            w = self.field.weights(behind, content, deltas)
            seen = volume.weighted_sum(w.static, behind.radiance) + volume.weighted_sum(
                w.dynamic, content.radiance
            )
        return radiance.detach().index_copy(0, self.active, seen)

    def confidence(self, disocclusion: Tensor) -> Tensor:
        """1 minus the rendered disocclusion (M,), per ray (N,)."""
        packed = self.w.dynamic.reshape(-1)[self.index].detach()
        return 1 - self.gather((packed * disocclusion)[:, None])[:, 0].clamp(0, 1)

    def warp(
        self, offset: int, radiance: Tensor, depth: Tensor, opacity: Tensor, scene_flow: Tensor
    ) -> Warp | None:
        """The render through the neighboring time, and the 2D flow into the neighboring
        frame's camera.
        """
        if offset not in self.batch.neighbors:
            return None
        rays = self.batch.camera.rays(self.batch.pixels)
        point = (
            rays.origins
            + depth[:, None] * rays.directions
            + scene_flow / opacity[:, None].clamp_min(1e-3)
        )
        pixel, _ = self.batch.neighbors[offset].project(point, min_depth=0.05 * self.field.near)
        confidence = self.confidence(self.disocclusion[:, self.side(offset)])
        return Warp(
            offset,
            pixel - self.batch.pixels,
            confidence,
            self.warped_radiance(self.contents[offset], radiance),
        )

    def chained(self, direction: int, radiance: Tensor) -> Warp | None:
        """The render through the time two steps away, along two flows in a row."""
        knot = self.knot + 2 * direction
        if not 0 <= knot <= len(self.field.times) - 1:
            return None
        there = self.there[direction]
        assert there is not None
        side = self.side(direction)
        coords = self.moved[direction] + self.to_flow(there)[:, side]
        content, _ = self.field.dynamic_content(
            coords,
            self.slot,
            self.contents[direction].density.shape,
            knot,
            self.views,
            motion=False,
        )
        both = 1 - (1 - self.disocclusion[:, side]) * (1 - there[:, 3 + 4 * side].sigmoid())
        return Warp(
            2 * direction,
            torch.zeros_like(self.batch.pixels),
            self.confidence(both),
            self.warped_radiance(content, radiance),
        )

    def regularizers(self) -> dict[str, Tensor]:
        """Cycle, smoothness, least kinetic energy, disocclusion and blend entropy
        (METHOD.md 3), means over dynamic samples.
        """
        if not len(self.index):
            return {}
        terms: dict[str, list[Tensor]] = {"cycle": [], "kinetic": [], "smoothness": []}
        decode = self.field.space.decode
        for o in self.offsets:
            there = self.there[o]
            assert there is not None
            flow_there = self.to_flow(there)
            confident = 1 - self.disocclusion[:, self.side(o)]
            back = flow_there[:, self.side(-o)]
            terms["cycle"].append(losses.cycle(self.flow[:, self.side(o)], back, confident))
            further = decode(self.moved[o] + flow_there[:, self.side(o)]) - decode(self.moved[o])
            returning = decode(self.moved[o] + back) - decode(self.moved[o])
            terms["kinetic"].append(losses.kinetic(further, returning))
            next_along_ray = (self.index[1:] - self.index[:-1] == 1) & (
                self.ray[1:] == self.ray[:-1]
            )
            d = self.displacement[o]
            terms["smoothness"].append(
                losses.smoothness(d[1:][next_along_ray], d[:-1][next_along_ray])
            )
        if len(self.offsets) == 2:
            terms["kinetic"].append(losses.kinetic(self.displacement[1], self.displacement[-1]))
        result = {name: torch.stack(values).mean() for name, values in terms.items() if values}
        result["disocclusion"] = self.disocclusion.mean()
        if self.field.config.compositing == "blend":
            result["blend_entropy"] = losses.blend_entropy(
                self.dynamic.blend.reshape(-1)[self.index]
            )
        return result
