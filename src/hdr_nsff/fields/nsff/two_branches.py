"""What fields of a static and a dynamic branch share: sampling rays, culling, asking
the branches, compositing. Grids and the published network are two encodings of one
class. `NSFF` adds scene flow to it, `NerfWT` an appearance code per image.

Inside, a point is a coordinate of the unit cube (`space.py`) and time is a knot: the
position on the list of training times. `M` counts the samples that survive culling, out
of N rays x S samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor, nn

from hdr_nsff.fields.base import HIGHEST, FrameError
from hdr_nsff.fields.knots import knot_of
from hdr_nsff.fields.nsff.branches import GridBranches, GridConfig, MlpBranches, MlpConfig
from hdr_nsff.fields.nsff.occupancy import Occupancy
from hdr_nsff.fields.nsff.samples import Content, March, march
from hdr_nsff.fields.space import Space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import PixelBatch


@dataclass(frozen=True)
class BranchesConfig:
    """A static and a dynamic branch."""

    encoding: GridConfig | MlpConfig = field(default_factory=GridConfig)
    samples: int = 32
    """Samples along a ray while training."""
    render_samples: int = 64
    """Samples along a ray when rendering."""
    compositing: Literal["add", "blend"] = "add"
    """How static and dynamic content share a place: densities add up, or the blend
    weight of eq. 7.
    """
    radiance: Literal["exp", "sigmoid"] = "exp"
    """Unbounded radiance, or the published one below 1."""
    density: Literal["exp", "relu"] = "exp"
    density_noise: float = 0.0
    """Standard deviation added to raw densities while training (published: 1)."""
    cull: bool = True
    """Skip samples in cells that never mattered."""
    cull_after: int = 100
    """Steps before culling starts."""
    explore: float = 0.04
    """Share of the culled samples that is evaluated all the same."""


@dataclass(frozen=True)
class Pass:
    """One training pass after both branches were asked at the batch's own time."""

    m: March
    knot: float
    index: Tensor  # (M,) dynamic samples among N * S
    coords: Tensor  # (M, 3) cube
    raw_motion: Tensor | None  # (M, 8)
    static: Content
    dynamic: Content
    w: volume.Weights


class TwoBranches(nn.Module):
    """See the module. `times` (T,) are those of the training frames; frames are `width`
    x `height`.
    """

    times: Tensor
    bias: Tensor
    config: BranchesConfig

    def __init__(
        self,
        config: BranchesConfig,
        space: Space,
        times: Tensor,
        near: float,
        far: float,
        width: int,
        height: int,
        log_radiance: float = 0.0,
        branches: GridBranches | MlpBranches | None = None,
    ) -> None:
        super().__init__()
        self.config, self.space, self.near, self.far = config, space, near, far
        self.register_buffer("times", times.double())
        knots = len(times)
        self.branches = (
            plain_branches(config.encoding, width, height, knots) if branches is None else branches
        )
        aspect = (max(8, round(width / 4)), max(8, round(height / 4)), 48)
        self.static_cells = Occupancy(aspect)
        self.dynamic_cells = Occupancy((aspect[0] // 2, aspect[1] // 2, 24), knots)
        self.register_buffer(
            "bias", torch.tensor(log_radiance)
        )  # raw radiance 0 is this log radiance
        self.step = 0

    # What the raw numbers mean

    def to_radiance(self, raw: Tensor) -> Tensor:
        """Linear HDR radiance, >= 0."""
        return (
            (raw + self.bias).clamp(max=14.0).exp()
            if self.config.radiance == "exp"
            else raw.sigmoid()
        )

    def from_radiance(self, radiance: Tensor) -> Tensor:
        """Raw numbers of which `to_radiance` makes `radiance` (..., 3), as near as it
        can.
        """
        if self.config.radiance == "exp":
            return radiance.clamp_min(1e-5).log() - self.bias
        return radiance.clamp(1 - HIGHEST, HIGHEST).logit()

    def to_density(self, raw: Tensor, bias: float) -> Tensor:
        """Density per cube unit, >= 0."""
        if self.training and self.config.density_noise:
            raw = raw + self.config.density_noise * torch.randn(raw.shape, generator=self.rng).to(
                raw
            )
        return (raw + bias).clamp(max=10.0).exp() if self.config.density == "exp" else raw.relu()

    # Time and space

    def knot(self, time: float) -> float:
        """Position of a time (in frames) on the list of training times."""
        return knot_of(self.times, time)

    def march(
        self, camera: Camera, pixels: Tensor, num_samples: int, generator: torch.Generator | None
    ) -> March:
        """Samples along the rays of `pixels` (N, 2); jittered where a generator is
        given.
        """
        return march(self.space, camera, pixels, num_samples, self.near, self.far, generator)

    # Asking the branches

    def static_content(self, m: March, keep: Tensor) -> Content:
        """The static branch at the samples `keep` (N, S) bool; empty space elsewhere."""
        index = keep.reshape(-1).nonzero()[:, 0]
        raw = self.branches.static(m.coords.reshape(-1, 3)[index], self.views(m, index))
        return self.spread(raw, index, keep.shape, self.density_bias(static=True))

    def dynamic_content(
        self,
        coords: Tensor,
        index: Tensor,
        shape: torch.Size,
        knot: float,
        views: Tensor,
        motion: bool,
    ) -> tuple[Content, Tensor | None]:
        """The dynamic branch at `coords` (M, 3), which are samples `index` (M,) of rays
        of `shape` (N, S), and raw motion (M, 8).
        """
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
        share = (
            raw.new_zeros(total).index_copy(0, index, raw[:, 4].sigmoid())
            if self.config.compositing == "blend"
            else density
        )
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

    def kept(
        self, m: March, knot: float, explore: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Which samples to ask of the static and of the dynamic branch, (N, S) bool
        each.
        """
        flat, shape = m.coords.reshape(-1, 3), m.depths.shape
        if not self.config.cull:
            everything = torch.ones(shape, dtype=torch.bool, device=flat.device)
            return everything, everything
        static = self.static_cells.asks(flat, 0.0, explore, generator).view(shape)
        dynamic = self.dynamic_cells.asks(flat, knot, explore, generator).view(shape)
        return static, dynamic

    # Training

    def ask(self, batch: PixelBatch, motion: bool) -> Pass:
        """Both branches at samples along the batch's rays, composited; raw motion if
        there is `motion`.
        """
        rng = torch.Generator().manual_seed(batch.seed)
        self.rng = rng
        knot = self.knot(batch.time)
        m = self.march(batch.camera, batch.pixels, self.config.samples, rng)
        keep_static, keep_dynamic = self.kept(m, knot, self.config.explore, rng)
        static = self.static_content(m, keep_static)
        index = keep_dynamic.reshape(-1).nonzero()[:, 0]
        coords = m.coords.reshape(-1, 3)[index]
        dynamic, raw_motion = self.dynamic_content(
            coords, index, keep_dynamic.shape, knot, self.views(m, index), motion
        )
        w = self.weights(static, dynamic, m.deltas)
        if self.config.cull:
            self.static_cells.observe(m.coords.reshape(-1, 3), w.static.reshape(-1))
            self.dynamic_cells.observe(coords, w.dynamic.reshape(-1)[index], knot)
        return Pass(m, knot, index, coords, raw_motion, static, dynamic, w)

    # Housekeeping

    def param_groups(self) -> list[dict[str, Any]]:
        """The branches' groups."""
        return self.branches.param_groups()

    @torch.no_grad()
    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> None:
        """Refresh the culling grids every 16 steps once they have seen enough."""
        self.step = step
        if self.config.cull and step >= self.config.cull_after and step % 16 == 0:
            self.static_cells.refresh(threshold=2e-3, decay=0.97)
            self.dynamic_cells.refresh(threshold=1e-3, decay=0.97)

    def shared_maxima(self) -> list[Tensor]:
        """What several processes must agree on between steps: the culling grids'
        memories.
        """
        return [self.static_cells.weight, self.dynamic_cells.weight] if self.config.cull else []

    @torch.no_grad()
    def allow_motion(self, frames: list[Any], dilate: int = 9) -> None:
        """Dynamic content may only be where the moving masks (dilated by `dilate`
        pixels) of its time say; everywhere where a time has none.
        """
        centers = self.space.decode(self.dynamic_cells.centers())
        for k, time in enumerate(self.times.tolist()):
            views = [f for f in frames if f.time == time and f.moving is not None]
            if not views:
                continue
            allowed = torch.zeros(len(centers), dtype=torch.bool)
            for f in views:
                moving = (
                    nn.functional.max_pool2d(
                        f.moving[None, None].float(), 2 * dilate + 1, 1, dilate
                    )[0, 0]
                    > 0
                )
                xy, depth = f.camera.project(centers)
                x, y = xy[:, 0].long(), xy[:, 1].long()
                seen = (
                    (depth > 0)
                    & (xy[:, 0] >= 0)
                    & (xy[:, 1] >= 0)
                    & (x < f.camera.width)
                    & (y < f.camera.height)
                )
                allowed |= (
                    seen & moving[y.clamp(0, f.camera.height - 1), x.clamp(0, f.camera.width - 1)]
                )
            self.dynamic_cells.allowed[k] = allowed.view_as(self.dynamic_cells.allowed[k])
            self.dynamic_cells.mask[k] = self.dynamic_cells.allowed[k]


def plain_branches(
    encoding: GridConfig | MlpConfig, width: int, height: int, num_knots: int
) -> GridBranches | MlpBranches:
    """Branches as a config asks for them."""
    match encoding:
        case GridConfig():
            return GridBranches(encoding, width, height, num_knots)
        case MlpConfig():
            return MlpBranches(encoding, num_knots)
