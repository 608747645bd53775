"""The part of an NSFF's training pass that scene flow adds: warped renders (HDR-NSFF,
eq. 2-3), rendered optical flow, and the regularizers on samples (the scene-flow priors
of NSFF, Li et al. 2021).

`M` counts the dynamic samples of N rays x S samples; offsets are +1 and -1, to the next
and the previous training time.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from hdr_nsff.fields.base import Render, Warp
from hdr_nsff.fields.nsff.samples import BranchOutput, ray_of, sum_per_ray
from hdr_nsff.fields.nsff.two_branches import BranchPass, TwoBranches
from hdr_nsff.maths import losses, volume
from hdr_nsff.scene.batch import PixelBatch

# shares of a ray's samples, from the camera on, whose flow is held smooth in space and
# of constant velocity: those far away are too far apart (published)
SMOOTH_SHARE, KINETIC_SHARE = 0.95, 0.9
MIN_OPACITY = 1e-3  # by which rendered scene flow is divided
MIN_DEPTH_SHARE = 0.05  # of `near`: points nearer to the neighbor's camera project from there


class SceneFlowPass:
    """One training pass with the dynamic branch queried at the neighboring times too.

    `to_flow` turns raw motion (M, 8) into scene flow in cube units, forward and
    backward (M, 2, 3); `base` is the pass at the batch's own time.
    """

    def __init__(
        self,
        field: TwoBranches,
        to_flow: Callable[[Tensor], Tensor],
        batch: PixelBatch,
        base: BranchPass,
    ) -> None:
        assert base.raw_motion is not None
        self.field, self.to_flow = field, to_flow
        self.batch, self.base = batch, base
        self.flow = to_flow(base.raw_motion)  # (M, 2, 3) cube
        self.disocclusion = base.raw_motion[:, 3::4].sigmoid()  # (M, 2)
        last_knot = len(field.times) - 1
        self.offsets = [o for o in (1, -1) if 0 <= base.knot + o <= last_knot]
        # weights (N, S) of the dynamic branch alone, where eq. 6 blends
        self.alone: Tensor | None = None
        if field.config.compositing == "blend":
            self.alone = volume.single(base.dynamic.density, base.samples.deltas)
        self.index_active_rays()
        here = field.space.decode(base.coords)
        # by offset: where the samples go, in the cube, and how far, (M, 3) scene units
        self.moved = {o: base.coords + self.flow[:, side_of(o)] for o in self.offsets}
        self.displacement = {o: field.space.decode(u) - here for o, u in self.moved.items()}
        # the dynamic branch and its raw motion (M, 8) at the moved points and their
        # time
        self.neighbor: dict[int, BranchOutput] = {}
        self.neighbor_motion: dict[int, Tensor] = {}
        for o, coords in self.moved.items():
            self.neighbor[o], raw_motion = self.query(coords, base.knot + o, motion=True)
            assert raw_motion is not None
            self.neighbor_motion[o] = raw_motion

    def index_active_rays(self) -> None:
        """Number the rays that have dynamic samples: warped renders need no others."""
        self.num_samples = self.base.samples.depths.shape[1]
        self.ray = ray_of(self.base.index, self.num_samples)  # (M,) among N
        # the active rays, and each sample's place among them
        self.active, active_ray = torch.unique(self.ray, return_inverse=True)
        column = self.base.index % self.num_samples
        self.slot = active_ray * self.num_samples + column  # (M,) among active rays' samples
        self.directions = self.field.view_directions(self.base.samples, self.base.index)

    def query(
        self, coords: Tensor, knot: float, motion: bool
    ) -> tuple[BranchOutput, Tensor | None]:
        """The dynamic branch at `coords` (M, 3) of another time, and raw motion.

        The result is laid out as the active rays' samples. Raw motion (M, 8) is None
        without `motion`.
        """
        shape = torch.Size((len(self.active), self.num_samples))
        return self.field.query_dynamic(coords, self.slot, shape, knot, self.directions, motion)

    def render(self) -> Render:
        """The composited render with its warps."""
        base, far = self.base, self.field.far
        weights, depths = base.weights, base.samples.depths
        radiance = volume.composite(weights, base.static.radiance, base.dynamic.radiance)
        depth = volume.expected_depth(weights.static + weights.dynamic, depths, far)
        dynamic_weight = self.dynamic_weights()[:, None]
        scene_flow = {
            o: self.sum_rays(dynamic_weight * flow) for o, flow in self.displacement.items()
        }
        dynamic_radiance = dynamic_depth = None
        if self.alone is not None:
            dynamic_radiance = volume.weighted_sum(self.alone, base.dynamic.radiance)
            dynamic_depth = volume.expected_depth(self.alone, depths, far)
        warps = []
        for o in self.offsets:
            if o in self.batch.neighbors:
                if self.alone is not None:
                    point = self.published_point(o)
                else:
                    point = self.surface_point(depth, scene_flow[o])
                warps.append(self.warp(o, radiance, point))
        chained = self.warp_twice(self.batch.chain, radiance)
        if chained is not None:
            warps.append(chained)
        return Render(
            radiance=radiance,
            depth=depth,
            opacity=weights.opacity,
            motion=weights.dynamic.sum(-1),
            scene_flow=scene_flow,
            warps=tuple(warps),
            dynamic_radiance=dynamic_radiance,
            dynamic_depth=dynamic_depth,
        )

    def sum_rays(self, values: Tensor) -> Tensor:
        """Sum of the dynamic samples' `values` (M, C) per ray: (N, C)."""
        return sum_per_ray(values, self.ray, len(self.base.samples.depths))

    def dynamic_weights(self) -> Tensor:
        """Weights (M,) of the dynamic samples by which scene flow is rendered.

        Where eq. 6 blends, those of the dynamic branch alone, as published.
        """
        weights = self.base.weights.dynamic if self.alone is None else self.alone
        return weights.reshape(-1)[self.base.index]

    def surface_point(self, depth: Tensor, scene_flow: Tensor) -> Tensor:
        """The rendered surface (N, 3) at `depth` (N,), moved by `scene_flow` (N, 3)."""
        rays = self.batch.camera.rays(self.batch.pixels)
        opacity = self.base.weights.opacity[:, None].clamp_min(MIN_OPACITY)
        return rays.origins + depth[:, None] * rays.directions + scene_flow / opacity

    def published_point(self, offset: int) -> Tensor:
        """The weighted sum (N, 3) of displaced samples, by the dynamic branch alone.

        It is summed in the cube, as the publication does in NDC; light that no sample
        stops counts as the ray's last sample.
        """
        coords = self.base.samples.coords  # (N, S, 3)
        moved = coords.reshape(-1, 3).index_copy(0, self.base.index, self.moved[offset])
        assert self.alone is not None
        summed = volume.weighted_sum(self.alone, moved.view_as(coords))
        passed = (1 - self.alone.sum(-1, keepdim=True)).clamp_min(0)
        return self.field.space.decode(summed + passed * coords[:, -1])

    def warp(self, offset: int, radiance: Tensor, point: Tensor) -> Warp:
        """The render through a neighboring time, and optical flow to that neighbor.

        `radiance` (N, 3) is this pass's render. Flow projects `point` (N, 3), where the
        pixels' content is at that time, into the neighbor's camera.
        """
        neighbor = self.batch.neighbors[offset]
        pixel, _ = neighbor.project(point, min_depth=MIN_DEPTH_SHARE * self.field.near)
        return Warp(
            offset=offset,
            flow=pixel - self.batch.pixels,
            confidence=self.confidence(self.disocclusion[:, side_of(offset)]),
            radiance=self.warped_radiance(self.neighbor[offset], radiance),
        )

    def warp_twice(self, direction: int, radiance: Tensor) -> Warp | None:
        """The render through the time two steps away, along two flows in a row.

        None where the clip has no such time, or `direction` is 0.
        """
        last_knot = len(self.field.times) - 1
        knot = self.base.knot + 2 * direction
        if direction not in self.moved or not 0 <= knot <= last_knot:
            return None
        side = side_of(direction)
        raw_motion = self.neighbor_motion[direction]
        coords = self.moved[direction] + self.to_flow(raw_motion)[:, side]
        content, _ = self.query(coords, knot, motion=False)
        second_disocclusion = raw_motion[:, 3 + 4 * side].sigmoid()
        either = 1 - (1 - self.disocclusion[:, side]) * (1 - second_disocclusion)
        return Warp(
            offset=2 * direction,
            flow=torch.zeros_like(self.batch.pixels),
            confidence=self.confidence(either),
            radiance=self.warped_radiance(content, radiance),
        )

    def warped_radiance(self, content: BranchOutput, radiance: Tensor) -> Tensor:
        """Composite `content` of another time with this pass's step lengths: (N, 3).

        Where densities add up, the static branch takes part; with eq. 7 the dynamic
        branch stands alone, as published. Rays without dynamic samples repeat
        `radiance` (N, 3).
        """
        deltas = self.base.samples.deltas[self.active]
        if self.field.config.compositing == "blend":
            alone = volume.single(content.density, deltas)
            warped = volume.weighted_sum(alone, content.radiance)
        else:
            static = BranchOutput(
                self.base.static.density[self.active],
                self.base.static.radiance[self.active],
                content.blend,
            )
            weights = self.field.composite_weights(static, content, deltas)
            warped = volume.composite(weights, static.radiance, content.radiance)
        return radiance.detach().index_copy(0, self.active, warped)

    def confidence(self, disocclusion: Tensor) -> Tensor:
        """1 minus the rendered disocclusion (M,), per ray: (N,) in [0, 1]."""
        weighted = self.dynamic_weights().detach() * disocclusion
        return 1 - self.sum_rays(weighted[:, None])[:, 0].clamp(0, 1)

    def regularizers(self) -> dict[str, Tensor]:
        """Regularizers by the names of `SceneFlowLosses`, means over dynamic samples.

        Cycle and smoothness have one value per neighbor, kinetic energy up to four
        (`kinetic`): the objective adds them up or averages them. Disocclusion has two,
        also at the ends of a clip, as published.
        """
        if not len(self.base.index):
            return {}
        terms: dict[str, list[Tensor]] = {"cycle": [], "smoothness": []}
        for o in self.offsets:
            back = self.to_flow(self.neighbor_motion[o])[:, side_of(-o)]  # (M, 3) cube
            confidence = 1 - self.disocclusion[:, side_of(o)]
            terms["cycle"].append(losses.cycle(self.flow[:, side_of(o)], back, confidence))
            terms["smoothness"].append(self.smoothness(self.displacement[o]))
        terms["kinetic"] = self.kinetic()
        result = {name: torch.stack(values) for name, values in terms.items() if values}
        result["disocclusion"] = self.disocclusion.mean(0)
        if self.field.config.compositing == "blend":
            result["blend_entropy"] = losses.blend_entropy(self.base.static.blend)
        return result

    def kinetic(self) -> list[Tensor]:
        """Kinetic energy twice here and once at the neighbor along the chain.

        The publication counts it so, from the first step on. Where densities add up,
        both neighbors count as long as there is no chain.
        """
        near = self.near_samples(KINETIC_SHARE)
        knot = round(self.base.knot)
        terms = []
        if len(self.offsets) == 2:
            forward, backward = self.displacement[1][near], self.displacement[-1][near]
            terms += [self.acceleration(knot, forward, backward)] * 2
        direction = self.batch.chain
        if self.alone is not None and not direction:  # before the chain: by chance
            direction = 1 if self.batch.seed % 2 else -1
        for o in self.offsets:
            if direction in (0, o):
                flow = self.to_flow(self.neighbor_motion[o])[near]  # (M, 2, 3) cube
                start = self.moved[o][near]
                forward, backward = (self.displace(start, flow[:, side_of(s)]) for s in (1, -1))
                terms.append(self.acceleration(knot + o, forward, backward))
        return terms

    def acceleration(self, knot: int, forward: Tensor, backward: Tensor) -> Tensor:
        """Kinetic energy of displacements (M, 3) from a knot to the times after and
        before it, as if both were equally far.
        """
        after, before = self.field.gaps_at(knot)
        mean = (after + before) / 2
        return losses.kinetic(forward * (mean / after), backward * (mean / before))

    def near_samples(self, share: float) -> Tensor:
        """Which dynamic samples (M,) are among the first `share` of their ray's."""
        return self.base.index % self.num_samples < round(share * self.num_samples)

    def displace(self, coords: Tensor, flow: Tensor) -> Tensor:
        """How far `flow` (M, 3) moves `coords` (M, 3) of the cube, in scene units."""
        return self.field.space.decode(coords + flow) - self.field.space.decode(coords)

    def smoothness(self, displacement: Tensor) -> Tensor:
        """Difference of `displacement` (M, 3) between neighbors on a ray."""
        consecutive = self.base.index.diff() == 1
        same_ray = self.ray[1:] == self.ray[:-1]
        pairs = consecutive & same_ray & self.near_samples(SMOOTH_SHARE)[1:]
        return losses.smoothness(displacement[1:][pairs], displacement[:-1][pairs])


def side_of(offset: int) -> int:
    """Column of the forward (offset > 0) or the backward direction in raw motion."""
    return 0 if offset > 0 else 1
