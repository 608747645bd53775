"""Neural scene flow fields in linear HDR radiance (paper 3.1-3.2): a static and a dynamic branch, scene flow both ways,
disocclusion and blend; blended, dynamic and warped renders. Grids and the published network are two encodings of one class.

Inside, a point is a coordinate of the unit cube (`space.py`), scene flow is a displacement there, and time is a knot: the
position on the list of training times. `M` counts the samples that survive culling, out of N rays x S samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor, nn

from hdr_nsff import volume
from hdr_nsff.batch import PixelBatch
from hdr_nsff.camera import Camera
from hdr_nsff.fields.base import Layers, Look, Render
from hdr_nsff.fields.branches import GridBranches, GridConfig, MlpBranches, MlpConfig
from hdr_nsff.fields.knots import knot_of
from hdr_nsff.fields.motion import Motion
from hdr_nsff.fields.occupancy import Occupancy
from hdr_nsff.fields.samples import Content, March
from hdr_nsff.fields.space import Space

FORWARD, BACKWARD = 1, -1


@dataclass(frozen=True)
class NSFFConfig:
    """A neural scene flow field."""

    encoding: GridConfig | MlpConfig = field(default_factory=GridConfig)
    samples: int = 32
    """Samples along a ray while training."""
    render_samples: int = 64
    """Samples along a ray when rendering."""
    compositing: Literal["add", "blend"] = "add"
    """How static and dynamic content share a place: densities add up, or the blend weight of eq. 7."""
    radiance: Literal["exp", "sigmoid"] = "exp"
    """Unbounded radiance, or the published one below 1."""
    density: Literal["exp", "relu"] = "exp"
    density_noise: float = 0.0
    """Standard deviation added to raw densities while training (published: 1)."""
    flow_scale: float = 0.05
    """Cube units per unit of raw scene flow (published: tanh in NDC, which is 0.5 here)."""
    cull: bool = True
    """Skip samples in cells that never mattered."""
    cull_after: int = 100
    """Steps before culling starts."""
    explore: float = 0.04
    """Share of the culled samples that is evaluated all the same."""


class NSFF(nn.Module):
    """See the module. `cameras` and `times` (T,) are those of the training frames."""

    times: Tensor
    bias: Tensor

    def __init__(
        self,
        config: NSFFConfig,
        space: Space,
        times: Tensor,
        near: float,
        far: float,
        width: int,
        height: int,
        log_radiance: float = 0.0,
    ) -> None:
        super().__init__()
        self.config, self.space, self.near, self.far = config, space, near, far
        self.register_buffer("times", times.double())
        knots = len(times)
        match config.encoding:
            case GridConfig() as c:
                self.branches: GridBranches | MlpBranches = GridBranches(c, width, height, knots)
            case MlpConfig() as c:
                self.branches = MlpBranches(c, knots)
        aspect = (max(8, round(width / 4)), max(8, round(height / 4)), 48)
        self.static_cells = Occupancy(aspect)
        self.dynamic_cells = Occupancy((aspect[0] // 2, aspect[1] // 2, 24), knots)
        self.register_buffer("bias", torch.tensor(log_radiance))  # raw radiance 0 is this log radiance
        self.step = 0

    # What the raw numbers mean

    def to_radiance(self, raw: Tensor) -> Tensor:
        """Linear HDR radiance, >= 0."""
        return (raw + self.bias).clamp(max=14.0).exp() if self.config.radiance == "exp" else raw.sigmoid()

    def to_density(self, raw: Tensor, bias: float) -> Tensor:
        """Density per cube unit, >= 0."""
        if self.training and self.config.density_noise:
            raw = raw + self.config.density_noise * torch.randn(raw.shape, generator=self.rng).to(raw)
        return (raw + bias).clamp(max=10.0).exp() if self.config.density == "exp" else raw.relu()

    def to_flow(self, raw: Tensor) -> Tensor:
        """Scene flow in cube units, forward and backward: (M, 2, 3)."""
        flow = raw.reshape(-1, 2, 4)[..., :3]
        flow = 0.5 * flow.tanh() if isinstance(self.config.encoding, MlpConfig) else flow * self.config.flow_scale
        return flow

    # Time and space

    def knot(self, time: float) -> float:
        """Position of a time (in frames) on the list of training times."""
        return knot_of(self.times, time)

    def march(self, camera: Camera, pixels: Tensor, num_samples: int, generator: torch.Generator | None) -> March:
        """Samples along the rays of `pixels` (N, 2), evenly in disparity; jittered where a generator is given."""
        rays = camera.rays(pixels)
        n = len(pixels)
        jitter = None if generator is None else torch.rand(n, num_samples, generator=generator)
        depths = volume.stratified_disparity(n, num_samples, self.near, self.far, jitter).to(pixels)
        points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]  # (N, S, 3)
        coords = self.space.encode(points)
        return March(depths, points, coords, volume.step_lengths(coords), nn.functional.normalize(rays.directions, dim=-1))

    # Asking the branches

    def static_content(self, m: March, keep: Tensor) -> Content:
        """The static branch at the samples `keep` (N, S) bool; empty space elsewhere."""
        index = keep.reshape(-1).nonzero()[:, 0]
        raw = self.branches.static(m.coords.reshape(-1, 3)[index], self.views(m, index))
        return self.spread(raw, index, keep.shape, self.density_bias(static=True))

    def dynamic_content(
        self, coords: Tensor, index: Tensor, shape: torch.Size, knot: float, views: Tensor, motion: bool
    ) -> tuple[Content, Tensor | None]:
        """The dynamic branch at `coords` (M, 3), which are samples `index` (M,) of rays of `shape` (N, S), and raw motion (M, 8)."""
        raw, raw_motion = self.branches.dynamic(coords, knot, views, motion)
        return self.spread(raw, index, shape, self.density_bias(static=False)), raw_motion

    def density_bias(self, static: bool) -> float:
        """Raw density at the start: a thin static fog, almost no dynamic one."""
        return 0.0 if static else -3.0

    def spread(self, raw: Tensor, index: Tensor, shape: torch.Size, bias: float) -> Content:
        """Samples in packed order, as dense rays."""
        total = shape[0] * shape[1]
        density = raw.new_zeros(total).index_copy(0, index, self.to_density(raw[:, 3], bias))
        radiance = raw.new_zeros(total, 3).index_copy(0, index, self.to_radiance(raw[:, :3]))
        share = raw.new_zeros(total).index_copy(0, index, raw[:, 4].sigmoid()) if self.config.compositing == "blend" else density
        return Content(density.view(shape), radiance.view(*shape, 3), share.view(shape))

    def views(self, m: March, index: Tensor) -> Tensor:
        """View directions (M, 3) of samples `index`; grids do not look at them."""
        if isinstance(self.config.encoding, GridConfig):
            return m.directions[:0]
        return m.directions[torch.div(index, m.depths.shape[1], rounding_mode="floor")]

    def weights(self, static: Content, dynamic: Content, deltas: Tensor) -> volume.Weights:
        """Compositing weights of both branches."""
        if self.config.compositing == "add":
            return volume.add(static.density, dynamic.density, deltas)
        return volume.blend(static.density, dynamic.density, dynamic.blend, deltas)

    def kept(self, m: March, knot: float, explore: float, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Which samples to ask of the static and of the dynamic branch, (N, S) bool each."""
        flat, shape = m.coords.reshape(-1, 3), m.depths.shape
        if not self.config.cull:
            everything = torch.ones(shape, dtype=torch.bool, device=flat.device)
            return everything, everything
        static = self.static_cells.asks(flat, 0.0, explore, generator).view(shape)
        dynamic = self.dynamic_cells.asks(flat, knot, explore, generator).view(shape)
        return static, dynamic

    # Training

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A render of the batch's pixels with its warps, and the per-sample regularisers."""
        rng = torch.Generator().manual_seed(batch.seed)
        self.rng = rng
        knot = self.knot(batch.time)
        m = self.march(batch.camera, batch.pixels, self.config.samples, rng)
        keep_static, keep_dynamic = self.kept(m, knot, self.config.explore, rng)
        static = self.static_content(m, keep_static)
        index = keep_dynamic.reshape(-1).nonzero()[:, 0]
        coords = m.coords.reshape(-1, 3)[index]
        dynamic, raw_motion = self.dynamic_content(coords, index, keep_dynamic.shape, knot, self.views(m, index), motion=True)
        assert raw_motion is not None
        w = self.weights(static, dynamic, m.deltas)
        if self.config.cull:
            self.static_cells.observe(m.coords.reshape(-1, 3), w.static.reshape(-1))
            self.dynamic_cells.observe(coords, w.dynamic.reshape(-1)[index], knot)
        motion = Motion(self, batch, m, knot, index, coords, raw_motion, static, dynamic, w)
        return motion.render(), motion.regularizers()

    # Rendering

    @torch.no_grad()
    def render(self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True) -> Render:
        """Every pixel of `camera` (row by row) or `pixels` (S, 2) at `time` in frames, in chunks, without gradients."""
        pixels = camera.pixel_grid() if pixels is None else pixels
        was_training = self.training
        self.eval()
        parts = [self.render_chunk(camera, time, chunk) for chunk in pixels.split(8192)]
        self.train(was_training)
        flows = {o: torch.cat([p.scene_flow[o] for p in parts]) for o in (FORWARD, BACKWARD) if scene_flow}
        radiance, depth, opacity, motion = (
            torch.cat(maps) for maps in zip(*((p.radiance, p.depth, p.opacity, p.motion) for p in parts), strict=True)
        )
        return Render(radiance, depth, opacity, motion, flows)

    def render_chunk(self, camera: Camera, time: float, pixels: Tensor) -> Render:
        """A few thousand pixels at once."""
        knot = self.knot(time)
        m = self.march(camera, pixels, self.config.render_samples, None)
        keep_static, _ = self.kept(m, knot, 0.0, None)
        static = self.static_content(m, keep_static)
        dynamic, flow = self.dynamic_between(m, knot)
        w = self.weights(static, dynamic, m.deltas)
        radiance = volume.weighted_sum(w.static, static.radiance) + volume.weighted_sum(w.dynamic, dynamic.radiance)
        both = w.static + w.dynamic
        scene_flow = {o: volume.weighted_sum(w.dynamic, flow[:, :, i]) for i, o in enumerate((FORWARD, BACKWARD))}
        return Render(radiance, volume.expected_depth(both, m.depths, self.far), w.opacity, w.dynamic.sum(-1), scene_flow)

    def dynamic_between(self, m: March, knot: float) -> tuple[Content, Tensor]:
        """Dynamic content at a knot, or between two: each neighbour's content moved along its scene flow and cross-faded.
        Also the scene flow (N, S, 2, 3) in scene units to the next and the previous training time."""
        low = int(knot + 1e-6)
        fraction = knot - low
        if abs(fraction) < 1e-4:
            return self.dynamic_at(m, low, None)
        a, flow_a = self.dynamic_at(m, low, (0, fraction))
        b, flow_b = self.dynamic_at(m, low + 1, (1, 1 - fraction))
        density = (1 - fraction) * a.density + fraction * b.density
        mix = ((1 - fraction) * a.density / density.clamp_min(1e-12))[..., None]
        share = (1 - fraction) * a.blend + fraction * b.blend
        return Content(density, mix * a.radiance + (1 - mix) * b.radiance, share), mix[..., None] * flow_a + (
            1 - mix[..., None]
        ) * flow_b

    def dynamic_at(self, m: March, knot: int, moved: tuple[int, float] | None) -> tuple[Content, Tensor]:
        """Dynamic content at an integer knot. With `moved` = (direction, fraction): what will be (0: forward) or was (1: backward)
        at the samples after that fraction of its scene flow, found by one backward step along the flow at the sample."""
        flat, shape = m.coords.reshape(-1, 3), m.depths.shape
        keep = (
            self.dynamic_cells.asks(flat, knot, 0.0, None) if self.config.cull else torch.ones_like(flat[:, 0], dtype=torch.bool)
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
        displaced = torch.stack([self.space.decode(coords + f) - here for f in self.to_flow(raw_motion).unbind(1)], 1)
        flow = flat.new_zeros(len(flat), 2, 3).index_copy(0, index, displaced)
        return content, flow.view(*shape, 2, 3)

    @torch.no_grad()
    def layers(self, camera: Camera, time: float) -> Layers:
        """The samples of every pixel at a training time, dynamic and static ones in turn, for scene-flow splatting."""
        was_training = self.training
        self.eval()
        parts = [self.layers_of(camera, self.knot(time), chunk) for chunk in camera.pixel_grid().split(8192)]
        self.train(was_training)
        flow = {o: torch.cat([p.scene_flow[o] for p in parts]) for o in (FORWARD, BACKWARD)}
        positions, alpha, radiance, motion = (
            torch.cat(maps) for maps in zip(*((p.positions, p.alpha, p.radiance, p.motion) for p in parts), strict=True)
        )
        return Layers(positions, alpha, radiance, flow, motion)

    def layers_of(self, camera: Camera, knot: float, pixels: Tensor) -> Layers:
        """Layers of a few thousand pixels: two per sample, the dynamic one in front. Together they stop what the sample stops in
        `render` where densities add up; where both contents are dense in one sample, `render` shares it between them instead."""
        m = self.march(camera, pixels, self.config.render_samples, None)
        static = self.static_content(m, self.kept(m, knot, 0.0, None)[0])
        dynamic, flow = self.dynamic_at(m, round(knot), None)
        a_st, a_dy = -torch.expm1(-static.density * m.deltas), -torch.expm1(-dynamic.density * m.deltas)
        if self.config.compositing == "blend":
            a_st, a_dy = a_st * (1 - dynamic.blend), a_dy * dynamic.blend

        def interleave(dynamic_values: Tensor, static_values: Tensor) -> Tensor:
            return torch.stack([dynamic_values, static_values], 2).flatten(1, 2)  # (N, 2 S, ...)

        still = torch.zeros_like(flow[:, :, 0])
        flows = {o: interleave(flow[:, :, i], still) for i, o in enumerate((FORWARD, BACKWARD))}
        share = interleave(torch.ones_like(a_dy), torch.zeros_like(a_st))
        return Layers(
            interleave(m.points, m.points), interleave(a_dy, a_st), interleave(dynamic.radiance, static.radiance), flows, share
        )

    # Housekeeping

    def param_groups(self) -> list[dict[str, Any]]:
        """The branches' groups."""
        return self.branches.param_groups()

    @torch.no_grad()
    def after_step(self, step: int, looks: Callable[[int], list[Look]] | None) -> None:
        """Refresh the culling grids every 16 steps once they have seen enough."""
        self.step = step
        if self.config.cull and step >= self.config.cull_after and step % 16 == 0:
            self.static_cells.refresh(threshold=2e-3, decay=0.97)
            self.dynamic_cells.refresh(threshold=1e-3, decay=0.97)

    def shared_maxima(self) -> list[Tensor]:
        """What several processes must agree on between steps: the culling grids' memories."""
        return [self.static_cells.weight, self.dynamic_cells.weight] if self.config.cull else []

    @torch.no_grad()
    def allow_motion(self, frames: list[Any], dilate: int = 9) -> None:
        """Dynamic content may only be where the moving masks (dilated by `dilate` pixels) of its time say; everywhere where a time has none."""
        centres = self.space.decode(self.dynamic_cells.centres())
        for k, time in enumerate(self.times.tolist()):
            views = [f for f in frames if f.time == time and f.moving is not None]
            if not views:
                continue
            allowed = torch.zeros(len(centres), dtype=torch.bool)
            for f in views:
                moving = nn.functional.max_pool2d(f.moving[None, None].float(), 2 * dilate + 1, 1, dilate)[0, 0] > 0
                xy, depth = f.camera.project(centres)
                x, y = xy[:, 0].long(), xy[:, 1].long()
                seen = (depth > 0) & (xy[:, 0] >= 0) & (xy[:, 1] >= 0) & (x < f.camera.width) & (y < f.camera.height)
                allowed |= seen & moving[y.clamp(0, f.camera.height - 1), x.clamp(0, f.camera.width - 1)]
            self.dynamic_cells.allowed[k] = allowed.view_as(self.dynamic_cells.allowed[k])
            self.dynamic_cells.mask[k] = self.dynamic_cells.allowed[k]
