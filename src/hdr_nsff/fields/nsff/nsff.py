"""Neural scene flow fields in linear HDR radiance (paper 3.1-3.2): a static and a
dynamic branch, scene flow both ways, disocclusion and blend; blended, dynamic and
warped renders. Inside, scene flow is a displacement in the unit cube.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hdr_nsff.fields.base import Layers, Render
from hdr_nsff.fields.nsff.branches import MlpConfig
from hdr_nsff.fields.nsff.motion import Motion
from hdr_nsff.fields.nsff.samples import Content, March, in_chunks
from hdr_nsff.fields.nsff.two_branches import BranchesConfig, TwoBranches
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import PixelBatch

FORWARD, BACKWARD = 1, -1


@dataclass(frozen=True)
class NSFFConfig(BranchesConfig):
    """A neural scene flow field."""

    flow_scale: float = 0.05
    """Cube units per unit of raw scene flow (published: tanh in NDC, which is 0.5
    here).
    """


class NSFF(TwoBranches):
    """See the module."""

    config: NSFFConfig

    def to_flow(self, raw: Tensor) -> Tensor:
        """Scene flow in cube units, forward and backward: (M, 2, 3)."""
        flow = raw.reshape(-1, 2, 4)[..., :3]
        flow = (
            0.5 * flow.tanh()
            if isinstance(self.config.encoding, MlpConfig)
            else flow * self.config.flow_scale
        )
        return flow

    # Training

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A render of the batch's pixels with its warps, and the per-sample
        regularizers.
        """
        p = self.ask(batch, motion=True)
        assert p.raw_motion is not None
        motion = Motion(
            self,
            self.to_flow,
            batch,
            p.m,
            p.knot,
            p.index,
            p.coords,
            p.raw_motion,
            p.static,
            p.dynamic,
            p.w,
        )
        return motion.render(), motion.regularizers()

    # Rendering

    @torch.no_grad()
    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        """Every pixel of `camera` (row by row) or `pixels` (S, 2) at `time` in frames,
        in chunks, without gradients.
        """
        seen = in_chunks(self, camera, pixels, lambda chunk: self.render_chunk(camera, time, chunk))
        return seen if scene_flow else replace(seen, scene_flow={})

    def render_chunk(self, camera: Camera, time: float, pixels: Tensor) -> Render:
        """A few thousand pixels at once."""
        knot = self.knot(time)
        m = self.march(camera, pixels, self.config.render_samples, None)
        keep_static, _ = self.kept(m, knot, 0.0, None)
        static = self.static_content(m, keep_static)
        dynamic, flow = self.dynamic_between(m, knot)
        w = self.weights(static, dynamic, m.deltas)
        radiance = volume.weighted_sum(w.static, static.radiance) + volume.weighted_sum(
            w.dynamic, dynamic.radiance
        )
        both = w.static + w.dynamic
        scene_flow = {
            o: volume.weighted_sum(w.dynamic, flow[:, :, i])
            for i, o in enumerate((FORWARD, BACKWARD))
        }
        return Render(
            radiance,
            volume.expected_depth(both, m.depths, self.far),
            w.opacity,
            w.dynamic.sum(-1),
            scene_flow,
        )

    def dynamic_between(self, m: March, knot: float) -> tuple[Content, Tensor]:
        """Dynamic content at a knot, or between two: each neighbor's content moved
        along its scene flow and cross-faded. Also the scene flow (N, S, 2, 3) in scene
        units to the next and the previous training time.
        """
        low = int(knot + 1e-6)
        fraction = knot - low
        if abs(fraction) < 1e-4:
            return self.dynamic_at(m, low, None)
        a, flow_a = self.dynamic_at(m, low, (0, fraction))
        b, flow_b = self.dynamic_at(m, low + 1, (1, 1 - fraction))
        density = (1 - fraction) * a.density + fraction * b.density
        mix = ((1 - fraction) * a.density / density.clamp_min(1e-12))[..., None]
        share = (1 - fraction) * a.blend + fraction * b.blend
        return Content(density, mix * a.radiance + (1 - mix) * b.radiance, share), mix[
            ..., None
        ] * flow_a + (1 - mix[..., None]) * flow_b

    def dynamic_at(
        self, m: March, knot: int, moved: tuple[int, float] | None
    ) -> tuple[Content, Tensor]:
        """Dynamic content at an integer knot. With `moved` = (direction, fraction):
        what will be (0: forward) or was (1: backward) at the samples after that
        fraction of its scene flow, found by one backward step along the flow at the
        sample.
        """
        flat, shape = m.coords.reshape(-1, 3), m.depths.shape
        keep = (
            self.dynamic_cells.asks(flat, knot, 0.0, None)
            if self.config.cull
            else torch.ones_like(flat[:, 0], dtype=torch.bool)
        )
        index = keep.nonzero()[:, 0]
        coords, views = flat[index], self.views(m, index)
        if moved is not None and len(index):
            raw = self.branches.dynamic(coords, knot, views, motion=True)[1]
            assert raw is not None
            coords = coords - moved[1] * self.to_flow(raw)[:, moved[0]]
        content, raw_motion = self.dynamic_content(coords, index, shape, knot, views, motion=True)
        assert raw_motion is not None
        here = self.space.decode(coords)
        displaced = torch.stack(
            [self.space.decode(coords + f) - here for f in self.to_flow(raw_motion).unbind(1)], 1
        )
        flow = flat.new_zeros(len(flat), 2, 3).index_copy(0, index, displaced)
        return content, flow.view(*shape, 2, 3)

    @torch.no_grad()
    def layers(self, camera: Camera, time: float) -> Layers:
        """The samples of every pixel at a training time, dynamic and static ones in
        turn, for scene-flow splatting.
        """
        was_training = self.training
        self.eval()
        parts = [
            self.layers_of(camera, self.knot(time), chunk)
            for chunk in camera.pixel_grid().split(8192)
        ]
        self.train(was_training)
        flow = {o: torch.cat([p.scene_flow[o] for p in parts]) for o in (FORWARD, BACKWARD)}
        positions, alpha, radiance, motion = (
            torch.cat(maps)
            for maps in zip(
                *((p.positions, p.alpha, p.radiance, p.motion) for p in parts), strict=True
            )
        )
        return Layers(positions, alpha, radiance, flow, motion)

    def layers_of(self, camera: Camera, knot: float, pixels: Tensor) -> Layers:
        """Layers of a few thousand pixels: two per sample, the dynamic one in front.
        Together they stop what the sample stops in `render` where densities add up;
        where both contents are dense in one sample, `render` shares it between them
        instead.
        """
        m = self.march(camera, pixels, self.config.render_samples, None)
        static = self.static_content(m, self.kept(m, knot, 0.0, None)[0])
        dynamic, flow = self.dynamic_at(m, round(knot), None)
        a_st, a_dy = (
            -torch.expm1(-static.density * m.deltas),
            -torch.expm1(-dynamic.density * m.deltas),
        )
        if self.config.compositing == "blend":
            a_st, a_dy = a_st * (1 - dynamic.blend), a_dy * dynamic.blend

        def interleave(dynamic_values: Tensor, static_values: Tensor) -> Tensor:
            return torch.stack([dynamic_values, static_values], 2).flatten(1, 2)  # (N, 2 S, ...)

        still = torch.zeros_like(flow[:, :, 0])
        flows = {o: interleave(flow[:, :, i], still) for i, o in enumerate((FORWARD, BACKWARD))}
        share = interleave(torch.ones_like(a_dy), torch.zeros_like(a_st))
        return Layers(
            interleave(m.points, m.points),
            interleave(a_dy, a_st),
            interleave(dynamic.radiance, static.radiance),
            flows,
            share,
        )
