"""Neural scene flow fields in linear HDR radiance (HDR-NSFF, sections 3.1-3.2; NSFF, Li
et al. 2021): a static and a dynamic branch, scene flow both ways, disocclusion and
blend; composited, dynamic and warped renders.

Inside, scene flow is a displacement in the unit cube.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from hdr_nsff.core.settings import Advanced, Weight
from hdr_nsff.fields.base import Render
from hdr_nsff.fields.nsff.branches import MlpConfig
from hdr_nsff.fields.nsff.samples import BranchOutput, RaySamples, map_chunks, render_in_chunks
from hdr_nsff.fields.nsff.scene_flow import SceneFlowPass
from hdr_nsff.fields.nsff.two_branches import BranchesConfig, TwoBranches
from hdr_nsff.fields.outputs import Layers
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import PixelBatch

FORWARD, BACKWARD = 1, -1  # offsets in training times; columns 0 and 1 of scene flow
NDC_TO_CUBE = 0.5  # the published flow, tanh in NDC of [-1, 1], in cube units
ON_KNOT = 1e-4  # knots: a time this near to a training time is that training time


@dataclass(frozen=True)
class SceneFlowLosses:
    """Weights of what scene flow adds to the objective; 0 turns a term off."""

    temporal: Weight = 0.3
    """Eq. 13: renders warped from the neighboring times."""
    chain: Weight = 0.1
    """The same through two steps, from phase 2 on."""
    cycle: Weight = 0.5
    """Flow there and back returns."""
    flow_magnitude: Weight = 0.01
    """Length of the rendered scene flow, per axis."""
    smoothness: Weight = 0.1
    """Scene flow of neighboring samples of a ray."""
    kinetic: Weight = 0.1
    """Least kinetic energy: flow changes slowly in time."""
    disocclusion: Weight = 0.02
    """Mean disocclusion."""
    blend_entropy: Weight = 0.0
    """Entropy of the blend weight (compositing `blend`)."""


@dataclass(frozen=True)
class NSFFConfig(BranchesConfig):
    """A neural scene flow field."""

    type: Advanced[Literal["nsff"]] = "nsff"
    loss: Advanced[SceneFlowLosses] = field(default_factory=SceneFlowLosses)
    flow_scale: Advanced[Weight] = 0.05
    """Cube units per unit of raw scene flow (published: tanh in NDC, which is 0.5
    here).
    """


class NSFF(TwoBranches):
    """A neural scene flow field."""

    config: NSFFConfig

    def loss_weights(self) -> dict[str, float]:
        """Of the terms that scene flow makes possible."""
        return asdict(self.config.loss)

    def to_flow(self, raw: Tensor) -> Tensor:
        """Scene flow (M, 2, 3) of raw motion (M, 8).

        In cube units, forward and backward.
        """
        raw_flow = raw.reshape(-1, 2, 4)[..., :3]
        if isinstance(self.config.encoding, MlpConfig):
            return NDC_TO_CUBE * raw_flow.tanh()
        return raw_flow * self.config.flow_scale

    # Training

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A render of the batch's pixels with warps, and per-sample regularizers."""
        base = self.query(batch, motion=True)
        training_pass = SceneFlowPass(self, self.to_flow, batch, base)
        return training_pass.render(), training_pass.regularizers()

    # Rendering

    @torch.no_grad()
    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        """Every pixel of `camera` (row by row) or `pixels` (S, 2) at `time` in frames.

        In chunks, without gradients.
        """
        knot = self.knot(time)
        render = render_in_chunks(
            self, camera, pixels, lambda chunk: self.render_chunk(camera, knot, chunk)
        )
        return render if scene_flow else replace(render, scene_flow={})

    def render_chunk(self, camera: Camera, knot: float, pixels: Tensor) -> Render:
        """The render of a few thousand `pixels` (N, 2) at a knot."""
        samples = self.sample(camera, pixels, self.config.render_samples, None)
        keep_static, _ = self.select_samples(samples, knot, 0.0, None)
        static = self.query_static(samples, keep_static)
        dynamic, flow = self.interpolate_dynamic(samples, knot)
        weights = self.composite_weights(static, dynamic, samples.deltas)
        both = weights.static + weights.dynamic
        scene_flow = {
            FORWARD: volume.weighted_sum(weights.dynamic, flow[:, :, 0]),
            BACKWARD: volume.weighted_sum(weights.dynamic, flow[:, :, 1]),
        }
        return Render(
            radiance=volume.composite(weights, static.radiance, dynamic.radiance),
            depth=volume.expected_depth(both, samples.depths, self.far),
            opacity=weights.opacity,
            motion=weights.dynamic.sum(-1),
            scene_flow=scene_flow,
        )

    def interpolate_dynamic(self, samples: RaySamples, knot: float) -> tuple[BranchOutput, Tensor]:
        """Dynamic content at a knot or between two, and scene flow (N, S, 2, 3).

        Between two knots, each neighbor's content is moved along its scene flow and
        cross-faded. Scene flow is in scene units, to the next and the previous training
        time.
        """
        low = int(knot + 1e-6)
        fraction = knot - low
        if abs(fraction) < ON_KNOT:
            return self.dynamic_at(samples, low)
        before, flow_before = self.dynamic_at(samples, low, side=0, fraction=fraction)
        after, flow_after = self.dynamic_at(samples, low + 1, side=1, fraction=1 - fraction)
        density = (1 - fraction) * before.density + fraction * after.density
        # content of both is mixed by its share of the density
        share = ((1 - fraction) * before.density / density.clamp_min(1e-12))[..., None]
        radiance = share * before.radiance + (1 - share) * after.radiance
        blend = (1 - fraction) * before.blend + fraction * after.blend
        flow = share[..., None] * flow_before + (1 - share[..., None]) * flow_after
        return BranchOutput(density, radiance, blend), flow

    def dynamic_at(
        self, samples: RaySamples, knot: int, side: int = 0, fraction: float = 0.0
    ) -> tuple[BranchOutput, Tensor]:
        """Dynamic content at an integer knot, and scene flow (N, S, 2, 3), scene units.

        With a `fraction`, content is moved by that fraction of its scene flow, forward
        (`side` 0) or backward (1). The content that arrives at a sample is found by one
        step back along the flow at the sample.
        """
        coords, shape = samples.coords.reshape(-1, 3), samples.depths.shape
        if self.config.cull:
            keep = self.dynamic_cells.select(coords, knot, 0.0, None)
        else:
            keep = torch.ones_like(coords[:, 0], dtype=torch.bool)
        index = keep.nonzero()[:, 0]
        kept = coords[index]
        directions = self.view_directions(samples, index)
        if fraction and len(index):
            _, raw_motion = self.branches.dynamic(kept, knot, directions, motion=True)
            assert raw_motion is not None
            kept = kept - fraction * self.to_flow(raw_motion)[:, side]
        content, raw_motion = self.query_dynamic(kept, index, shape, knot, directions, motion=True)
        assert raw_motion is not None
        flow_there = self.displacements(kept, self.to_flow(raw_motion))
        flow = coords.new_zeros(len(coords), 2, 3).index_copy(0, index, flow_there)
        return content, flow.view(*shape, 2, 3)

    def displacements(self, coords: Tensor, flow: Tensor) -> Tensor:
        """Scene flow (M, 2, 3) in scene units, of cube `flow` (M, 2, 3) at `coords`."""
        here = self.space.decode(coords)
        forward, backward = flow.unbind(1)
        next_place = self.space.decode(coords + forward)
        previous_place = self.space.decode(coords + backward)
        return torch.stack([next_place - here, previous_place - here], 1)

    # Layers

    @torch.no_grad()
    def layers(self, camera: Camera, time: float) -> Layers:
        """Every pixel's samples at a training time, for scene-flow splatting.

        Dynamic and static samples take turns, see `layers_of`.
        """
        knot = self.knot(time)
        parts = map_chunks(self, camera, None, lambda chunk: self.layers_of(camera, knot, chunk))
        return Layers(
            positions=torch.cat([p.positions for p in parts]),
            alpha=torch.cat([p.alpha for p in parts]),
            radiance=torch.cat([p.radiance for p in parts]),
            scene_flow={
                o: torch.cat([p.scene_flow[o] for p in parts]) for o in (FORWARD, BACKWARD)
            },
            motion=torch.cat([p.motion for p in parts]),
        )

    def layers_of(self, camera: Camera, knot: float, pixels: Tensor) -> Layers:
        """Layers of a few thousand pixels: two per sample, the dynamic one in front.

        Where densities add up, both layers together stop the same light as the sample
        in `render`. Where both contents are dense in one sample, `render` shares its
        radiance between them instead.
        """
        samples = self.sample(camera, pixels, self.config.render_samples, None)
        keep_static, _ = self.select_samples(samples, knot, 0.0, None)
        static = self.query_static(samples, keep_static)
        dynamic, flow = self.dynamic_at(samples, round(knot))
        alpha_static = volume.alpha_from_density(static.density, samples.deltas)
        alpha_dynamic = volume.alpha_from_density(dynamic.density, samples.deltas)
        if self.config.compositing == "blend":
            alpha_static = alpha_static * (1 - dynamic.blend)
            alpha_dynamic = alpha_dynamic * dynamic.blend
        at_rest = torch.zeros_like(flow[:, :, 0])
        return Layers(
            positions=interleave(samples.points, samples.points),
            alpha=interleave(alpha_dynamic, alpha_static),
            radiance=interleave(dynamic.radiance, static.radiance),
            scene_flow={
                FORWARD: interleave(flow[:, :, 0], at_rest),
                BACKWARD: interleave(flow[:, :, 1], at_rest),
            },
            motion=interleave(torch.ones_like(alpha_dynamic), torch.zeros_like(alpha_static)),
        )


def interleave(dynamic: Tensor, static: Tensor) -> Tensor:
    """Two layers per sample, dynamic and static (N, S, ...): (N, 2 S, ...)."""
    return torch.stack([dynamic, static], 2).flatten(1, 2)
