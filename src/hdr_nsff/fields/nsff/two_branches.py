"""What fields of a static and a dynamic branch share: sampling rays, culling, querying
the branches, compositing. Grids and the published network are two encodings of one
class. `NSFF` adds scene flow to it, `NerfWT` an appearance code per image.

Inside, a point is a coordinate of the unit cube (`space.py`) and time is a knot: the
position on the list of training times. `M` counts the samples that survive culling, out
of N rays x S samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le
from pydantic import Discriminator
from torch import Tensor, nn

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.core.settings import Advanced, Number, Share, Weight
from hdr_nsff.core.tensors import generator_for, layers_in_bf16
from hdr_nsff.fields.base import FrameError
from hdr_nsff.fields.knots import knot_of
from hdr_nsff.fields.nsff.branches import (
    Branches,
    GridBranches,
    GridConfig,
    MlpBranches,
    MlpConfig,
)
from hdr_nsff.fields.nsff.occupancy import Occupancy
from hdr_nsff.fields.nsff.samples import (
    MAX_LOG_RADIANCE,
    BranchOutput,
    RaySamples,
    ray_of,
    sample_rays,
)
from hdr_nsff.fields.point_cloud import MAX_SIGMOID_RADIANCE
from hdr_nsff.fields.space import Space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.scene.scene import Frame

MIN_RADIANCE = 1e-5  # that is turned into a raw number: keeps its logarithm finite
MAX_LOG_DENSITY = 10.0  # per cube side: keeps the exponential finite
# raw density at the start: a thin static fog, almost no dynamic one, so that static
# content explains what it can (hand-chosen on rendered scenes)
STATIC_DENSITY_BIAS, DYNAMIC_DENSITY_BIAS = 0.0, -3.0

# culling grids (hand-chosen on rendered scenes)
CULL_CELL_PX = 4  # of the static grid, at the frames' size
CULL_DEPTH_CELLS = 48
DYNAMIC_CULL_SCALE = 2  # times as large are the dynamic grids' cells, along every axis
MIN_CULL_CELLS = 8  # across the image
REFRESH_EVERY = 16  # steps
STATIC_MIN_WEIGHT, DYNAMIC_MIN_WEIGHT = 2e-3, 1e-3  # rendered weight that keeps a cell
WEIGHT_DECAY = 0.97  # of remembered weights, at every refresh

MASK_DILATION_PX = 9  # dynamic content may lie this far outside of the moving masks


@dataclass(frozen=True)
class BranchesConfig:
    """A static and a dynamic branch."""

    encoding: Annotated[GridConfig | MlpConfig, Discriminator("type")] = field(
        default_factory=GridConfig
    )
    samples: Annotated[int, Ge(2), Le(10**6)] = 32
    """Samples along a ray while training."""
    render_samples: Annotated[int, Ge(2), Le(10**6)] = 64
    """Samples along a ray when rendering."""
    compositing: Literal["add", "blend", "superpose"] = "add"
    """How static and dynamic content share a place: densities add up and share the
    sample's weight, the blend weight of eq. 7, or NeRF-W's two alphas.
    """
    opaque_end: Advanced[bool] = False
    """The last interval of a ray is 1e10, as published: any density there ends it."""
    split: Advanced[bool] = True
    """Static content beside the dynamic one; else everything is dynamic."""
    radiance: Literal["exp", "sigmoid"] = "exp"
    """Unbounded radiance, or the published one below 1."""
    density: Advanced[Literal["exp", "relu", "softplus"]] = "exp"
    """Density as an exponential, or as published: ReLU (NSFF), softplus (NeRF-W)."""
    density_noise: Advanced[Weight] = 0.0
    """Standard deviation added to raw densities while training (NSFF: 1)."""
    cull: Advanced[bool] = True
    """Skip samples in cells that never mattered."""
    cull_after: Advanced[Number] = 100
    """Steps before culling starts."""
    explore: Advanced[Share] = 0.04
    """Share of the culled samples that is evaluated all the same."""


@dataclass(frozen=True)
class BranchPass:
    """One training pass, after both branches were queried at the batch's own time."""

    samples: RaySamples
    knot: float
    index: Tensor  # (M,) dynamic samples among N * S
    coords: Tensor  # (M, 3) cube
    raw_motion: Tensor | None  # (M, 8)
    static: BranchOutput
    dynamic: BranchOutput
    weights: volume.Weights


class TwoBranches(nn.Module):
    """A static and a dynamic branch in the unit cube.

    `times` (T,) are those of the training frames, which are `width` x `height`; `near`
    and `far` are z-depths in scene units. Without `branches`, plain ones are built.
    """

    times: Tensor
    bias: Tensor
    config: BranchesConfig
    branches: Branches
    bf16 = False  # whether the branches compute in bfloat16 while training

    def __init__(
        self,
        config: BranchesConfig,
        space: Space,
        times: Tensor,
        near: float,
        far: float,
        width: int,
        height: int,
        branches: GridBranches | MlpBranches | None = None,
    ) -> None:
        super().__init__()
        self.config, self.space = config, space
        self.near, self.far = near, far
        self.host_times = times.double()  # reading the buffer would wait for a GPU
        self.register_buffer("times", self.host_times)
        num_knots = len(times)
        if branches is None:
            blending = config.compositing == "blend"
            branches = build_branches(config.encoding, width, height, num_knots, blending)
        self.branches = branches
        x = max(MIN_CULL_CELLS, round(width / CULL_CELL_PX))
        y = max(MIN_CULL_CELLS, round(height / CULL_CELL_PX))
        z, scale = CULL_DEPTH_CELLS, DYNAMIC_CULL_SCALE
        self.static_cells = Occupancy((x, y, z))
        self.dynamic_cells = Occupancy((x // scale, y // scale, z // scale), num_knots)
        self.register_buffer("bias", torch.tensor(0.0))  # log radiance of raw radiance 0

    # What the raw numbers mean

    def to_radiance(self, raw: Tensor) -> Tensor:
        """Linear HDR radiance, >= 0."""
        if self.config.radiance == "exp":
            return (raw + self.bias).clamp(max=MAX_LOG_RADIANCE).exp()
        return raw.sigmoid()

    def from_radiance(self, radiance: Tensor) -> Tensor:
        """Raw numbers of which `to_radiance` makes `radiance` (..., 3), clamped."""
        if self.config.radiance == "exp":
            return radiance.clamp_min(MIN_RADIANCE).log() - self.bias
        return radiance.clamp(1 - MAX_SIGMOID_RADIANCE, MAX_SIGMOID_RADIANCE).logit()

    def to_density(self, raw: Tensor, bias: float) -> Tensor:
        """Density per cube side, >= 0; with noise while training, by the settings."""
        if self.training and self.config.density_noise:
            where = self.generator.device
            noise = torch.randn(raw.shape, generator=self.generator, device=where).to(raw)
            raw = raw + self.config.density_noise * noise
        if self.config.density == "exp":
            return (raw + bias).clamp(max=MAX_LOG_DENSITY).exp()
        if self.config.density == "softplus":
            return nn.functional.softplus(raw)
        return raw.relu()

    def density_bias(self, static: bool) -> float:
        """What is added to the raw density of a branch, 0 at the start."""
        return STATIC_DENSITY_BIAS if static else DYNAMIC_DENSITY_BIAS

    # Time and space

    def knot(self, time: float) -> float:
        """Position of a time (in frames) on the list of training times."""
        return knot_of(self.host_times, time)

    def gaps_at(self, knot: int) -> tuple[float, float]:
        """Frames from the training time at a knot to the next one, and to it from the
        one before; equal at both ends.
        """
        if not 0 < knot < len(self.host_times) - 1:
            return 1.0, 1.0
        before, here, after = self.host_times[knot - 1 : knot + 2].tolist()
        return after - here, here - before

    def sample(
        self, camera: Camera, pixels: Tensor, num_samples: int, generator: torch.Generator | None
    ) -> RaySamples:
        """Samples along the rays of `pixels` (N, 2); jittered with a generator."""
        bounds, opaque = (self.near, self.far), self.config.opaque_end
        return sample_rays(self.space, camera, pixels, num_samples, *bounds, generator, opaque)

    # Querying the branches

    def query_static(self, samples: RaySamples, keep: Tensor) -> BranchOutput:
        """The static branch at the samples `keep` (N, S) bool; empty elsewhere."""
        index = keep.reshape(-1).nonzero()[:, 0]
        coords = samples.coords.reshape(-1, 3)[index]
        directions = self.view_directions(samples, index)
        with layers_in_bf16(coords, self.bf16 and self.training):
            raw = self.branches.static(coords, directions)
        return self.scatter(raw.to(coords.dtype), index, keep.shape, self.density_bias(static=True))

    def query_dynamic(
        self,
        coords: Tensor,
        index: Tensor,
        shape: torch.Size,
        knot: float,
        directions: Tensor,
        motion: bool,
    ) -> tuple[BranchOutput, Tensor | None]:
        """The dynamic branch at `coords` (M, 3), and with `motion` raw motion (M, 8).

        The coordinates are those of samples `index` (M,) of rays of `shape` (N, S).
        """
        with layers_in_bf16(coords, self.bf16 and self.training):
            raw, raw_motion = self.branches.dynamic(coords, knot, directions, motion)
        content = self.scatter(raw.to(coords.dtype), index, shape, self.density_bias(static=False))
        return content, None if raw_motion is None else raw_motion.to(coords.dtype)

    def scatter(self, raw: Tensor, index: Tensor, shape: torch.Size, bias: float) -> BranchOutput:
        """Raw numbers (M, 4 or 5) of samples `index`, as rays of `shape` (N, S)."""

        def everywhere(values: Tensor) -> Tensor:
            found = values.new_zeros(shape[0] * shape[1], *values.shape[1:])
            return found.index_copy(0, index, values).view(*shape, *values.shape[1:])

        density = everywhere(self.to_density(raw[:, 3], bias))
        radiance = everywhere(self.to_radiance(raw[:, :3]))
        blend = density  # unused where densities add up, and of the dynamic branch
        if self.config.compositing == "blend" and raw.shape[1] > 4:
            blend = everywhere(raw[:, 4].sigmoid())
        return BranchOutput(density, radiance, blend)

    def view_directions(self, samples: RaySamples, index: Tensor) -> Tensor:
        """View directions (M, 3) of samples `index`; none for grids."""
        if isinstance(self.config.encoding, GridConfig):
            return samples.directions[:0]
        return samples.directions[ray_of(index, samples.depths.shape[1])]

    def composite_weights(
        self, static: BranchOutput, dynamic: BranchOutput, deltas: Tensor
    ) -> volume.Weights:
        """Compositing weights of both branches."""
        match self.config.compositing:
            case "add":
                return volume.add(static.density, dynamic.density, deltas)
            case "superpose":
                return volume.superpose(static.density, dynamic.density, deltas)
            case "blend":
                share = 1 - static.blend
                return volume.blend(static.density, dynamic.density, share, deltas)

    def select_samples(
        self, samples: RaySamples, knot: float, explore: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Samples to query of the static and the dynamic branch: (N, S) bool."""
        coords, shape = samples.coords.reshape(-1, 3), samples.depths.shape
        if not self.config.cull:
            static = torch.ones(shape, dtype=torch.bool, device=coords.device)
            dynamic = static
        else:
            static = self.static_cells.select(coords, 0.0, explore, generator).view(shape)
            dynamic = self.dynamic_cells.select(coords, knot, explore, generator).view(shape)
        return static if self.config.split else torch.zeros_like(static), dynamic

    # Training

    def query(self, batch: PixelBatch, motion: bool) -> BranchPass:
        """Both branches at samples along the batch's rays, composited.

        With `motion`, the pass has raw motion.
        """
        generator = generator_for(batch.rgb.device, batch.seed)
        self.generator = generator
        knot = self.knot(batch.time)
        samples = self.sample(batch.camera, batch.pixels, self.config.samples, generator)
        keep_static, keep_dynamic = self.select_samples(
            samples, knot, self.config.explore, generator
        )
        static = self.query_static(samples, keep_static)
        index = keep_dynamic.reshape(-1).nonzero()[:, 0]
        all_coords = samples.coords.reshape(-1, 3)
        coords = all_coords[index]
        directions = self.view_directions(samples, index)
        dynamic, raw_motion = self.query_dynamic(
            coords, index, keep_dynamic.shape, knot, directions, motion
        )
        weights = self.composite_weights(static, dynamic, samples.deltas)
        if self.config.cull:
            self.static_cells.observe(all_coords, weights.static.reshape(-1))
            self.dynamic_cells.observe(coords, weights.dynamic.reshape(-1)[index], knot)
        return BranchPass(samples, knot, index, coords, raw_motion, static, dynamic, weights)

    # Housekeeping

    def param_groups(self) -> list[ParamGroup]:
        """The branches' groups."""
        return self.branches.param_groups()

    @torch.no_grad()
    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> bool:
        """Refresh the culling grids now and then, once they have seen enough."""
        if self.config.cull and step >= self.config.cull_after and step % REFRESH_EVERY == 0:
            self.static_cells.refresh(STATIC_MIN_WEIGHT, WEIGHT_DECAY)
            self.dynamic_cells.refresh(DYNAMIC_MIN_WEIGHT, WEIGHT_DECAY)
        return False

    def shared_maxima(self) -> list[Tensor]:
        """The culling grids' memories: several processes share their maximum."""
        return [self.static_cells.weight, self.dynamic_cells.weight] if self.config.cull else []

    @torch.no_grad()
    def allow_motion(self, frames: list[Frame], dilation: int = MASK_DILATION_PX) -> None:
        """Allow dynamic content only where the moving masks of its time do.

        Masks are dilated by `dilation` pixels; a time without masks allows it
        everywhere.
        """
        centers = self.space.decode(self.dynamic_cells.cell_centers())
        for k, time in enumerate(self.host_times.tolist()):
            masked = [f for f in frames if f.time == time and f.moving is not None]
            if not masked:
                continue
            allowed = torch.zeros(len(centers), dtype=torch.bool)
            for frame in masked:
                allowed |= seen_as_moving(frame, centers, dilation)
            self.dynamic_cells.allowed[k] = allowed.view_as(self.dynamic_cells.allowed[k])
            self.dynamic_cells.mask[k] = self.dynamic_cells.allowed[k]


def seen_as_moving(frame: Frame, points: Tensor, dilation: int) -> Tensor:
    """Which `points` (P, 3) project into a frame's dilated moving mask: (P,) bool."""
    assert frame.moving is not None
    size = 2 * dilation + 1
    mask = frame.moving[None, None].float()
    moving = nn.functional.max_pool2d(mask, size, 1, dilation)[0, 0] > 0  # (H, W)
    camera = frame.camera
    pixels, depth = camera.project(points)
    x, y = pixels[:, 0].long(), pixels[:, 1].long()
    inside = (depth > 0) & (pixels >= 0).all(-1) & (x < camera.width) & (y < camera.height)
    return inside & moving[y.clamp(0, camera.height - 1), x.clamp(0, camera.width - 1)]


def build_branches(
    encoding: GridConfig | MlpConfig, width: int, height: int, num_knots: int, blending: bool
) -> GridBranches | MlpBranches:
    """Plain branches of the given encoding for frames of `width` x `height`."""
    match encoding:
        case GridConfig():
            return GridBranches(encoding, width, height, num_knots, blending)
        case MlpConfig():
            return MlpBranches(encoding, num_knots)
