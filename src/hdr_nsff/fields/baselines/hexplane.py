"""HDR-HexPlane (Wu et al. 2024): density and log radiance at (x, y, z, t) from six
feature planes each, one content for static and moving parts. The camera acts on every
sample before compositing: `rgb = sum_i w_i g(gain E_i)`.

The interface for that is `Recorder`: the field calls it for the rgb of its samples'
radiance, and knows neither exposure nor curve. A field whose radiance is composited
first and then recorded, `g(gain sum_i w_i E_i)`, differs wherever a ray sees more than
one radiance: the sigmoid is concave, so by Jensen's inequality recording samples gives
the darker value, and a ray that meets nothing is black in any case. The HDR picture is
`sum_i w_i E_i`, the radiance of the samples in the same weights.

From the paper and its code, to the best of our knowledge: products of planes side by
side, a linear map to density and to 27 appearance features, softplus density, a
view-dependent network of three layers, the weight from which a sample has a color.
docs/baselines.md lists the differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le
from torch import Tensor, nn

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.core.settings import Advanced, Count, Number, Rate, Share, Weight
from hdr_nsff.core.tensors import generator_for, layers_in_bf16
from hdr_nsff.fields.base import FrameError, Render
from hdr_nsff.fields.baselines.planes import Planes
from hdr_nsff.fields.knots import knot_of
from hdr_nsff.fields.nsff.encodings import frequencies
from hdr_nsff.fields.nsff.occupancy import Occupancy
from hdr_nsff.fields.nsff.samples import (
    MAX_LOG_RADIANCE,
    RaySamples,
    ray_of,
    render_in_chunks,
    sample_rays,
    sum_per_ray,
)
from hdr_nsff.fields.space import Space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import PixelBatch, Recorder

FEATURES = 27  # of appearance, inputs of the color network (TensoRF, Chen et al. 2022)
OCTAVES = 2  # of features and of directions, in the color network
DENSITY_SCALE = 75.0  # per cube side: 25 per unit of a box of three, as published
MIN_COLOR_WEIGHT = 1e-4  # weight below which a sample has no color, as published
NUM_GROWTHS = 3  # times that the grid grows

# culling grid (hand-chosen on rendered scenes)
CULL_CELLS = (64, 36, 32)  # along x, y, z of the cube
CULL_MIN_WEIGHT = 1e-3  # rendered weight that keeps a cell
WEIGHT_DECAY = 0.97  # of remembered weights, at every refresh
REFRESH_EVERY = 16  # steps


@dataclass(frozen=True)
class HexPlaneConfig:
    """HDR-HexPlane."""

    type: Advanced[Literal["hdr-hexplane"]] = "hdr-hexplane"
    total_variation: Weight = 1e-4
    """Loss: mean square difference of neighbors in the planes."""
    density_components: Count = 24
    """Numbers per plane that make density."""
    appearance_components: Count = 48
    """Numbers per plane that make color."""
    coarsest: Count = 64
    """Cells per side of the cube at the start."""
    finest: Count = 200
    """Cells per side at the end."""
    grow_every: Advanced[Count] = 3000
    """Steps after which the grid grows, three times in all."""
    emptiness: Advanced[Weight] = 10.0
    """Subtracted from raw density, so that space is empty at the start."""
    width: Advanced[Count] = 128
    """Width of the color network."""
    samples: Annotated[int, Ge(2), Le(10**6)] = 64
    """Samples along a ray while training."""
    render_samples: Annotated[int, Ge(2), Le(10**6)] = 128
    """Samples along a ray when rendering."""
    cull_after: Advanced[Number] = 500
    """Steps before samples in cells that never mattered are skipped."""
    explore: Advanced[Share] = 0.04
    """Share of the culled samples that is evaluated all the same."""
    plane_lr: Advanced[Rate] = 0.02
    """Learning rate of the planes."""
    network_lr: Advanced[Rate] = 1e-3
    """Learning rate of the linear maps and the color network."""


class HexPlane(nn.Module):
    """HDR-HexPlane in the unit cube.

    `times` (T,) are those of the training frames; `near` and `far` are z-depths in
    scene units.
    """

    times: Tensor
    bias: Tensor
    steps: Tensor
    bf16 = False  # whether the networks compute in bfloat16 while training

    def __init__(
        self, config: HexPlaneConfig, space: Space, times: Tensor, near: float, far: float
    ) -> None:
        super().__init__()
        self.config, self.space = config, space
        self.near, self.far = near, far
        self.register_buffer("times", times.double())
        slices = max(2, math.ceil(len(times) / 2))  # published: half of the frames
        density, appearance = config.density_components, config.appearance_components
        self.density_planes = Planes(density, config.coarsest, config.finest, slices)
        self.appearance_planes = Planes(appearance, config.coarsest, config.finest, slices)
        self.to_density = nn.Linear(3 * density, 1, bias=False)
        self.to_features = nn.Linear(3 * appearance, FEATURES, bias=False)
        self.color = nn.Sequential(
            nn.Linear((FEATURES + 3) * (1 + 2 * OCTAVES), config.width),
            nn.ReLU(),
            nn.Linear(config.width, config.width),
            nn.ReLU(),
            nn.Linear(config.width, 3),
        )
        self.register_buffer("bias", torch.tensor(0.0))  # log radiance of raw radiance 0
        self.cells = Occupancy(CULL_CELLS)
        self.register_buffer("steps", torch.tensor(0))

    def share(self, time: float) -> float:
        """A time (in frames) as a share in [0, 1] of the training times."""
        return knot_of(self.times, time) / max(len(self.times) - 1, 1)

    def render_samples(
        self,
        samples: RaySamples,
        time: float,
        recorders: Sequence[Recorder],
        generator: torch.Generator | None,
    ) -> tuple[Render, Tensor]:
        """The render of rays (N rays, S samples) at a time, and the weights (N, S).

        What each of the `recorders` records before compositing stands side by side in
        the render's `rgb`. A generator is given while training.
        """
        coords, shape = samples.coords.reshape(-1, 3), samples.depths.shape
        share = self.share(time)
        training = generator is not None
        explore = self.config.explore if training else 0.0
        kept = self.cells.select(coords, 0.0, explore, generator).nonzero()[:, 0]
        density = coords.new_zeros(len(coords)).index_copy(
            0, kept, self.density(coords[kept], share)
        )
        weights = volume.single(density.view(shape), samples.deltas)
        colored = kept
        # in the first steps no sample would be heavy enough to learn a color
        if int(self.steps) >= self.config.cull_after or not training:
            colored = (weights.detach().reshape(-1) > MIN_COLOR_WEIGHT).nonzero()[:, 0]
        ray = ray_of(colored, shape[1])
        radiance = self.radiance(coords[colored], samples.directions[ray], share)
        weight = weights.reshape(-1)[colored, None]
        rgb = None
        if recorders:
            recorded = torch.cat([recorder.rgb(radiance) for recorder in recorders], 1)
            rgb = sum_per_ray(weight * recorded, ray, shape[0])
        depth = volume.expected_depth(weights, samples.depths, self.far)
        render = Render(
            radiance=sum_per_ray(weight * radiance, ray, shape[0]),
            depth=depth,
            opacity=weights.sum(-1),
            motion=torch.zeros_like(depth),
            rgb=rgb,
        )
        return render, weights

    def density(self, coords: Tensor, share: float) -> Tensor:
        """Density (M,) per cube side at `coords` (M, 3) and a share of the clip."""
        features = self.density_planes(coords, share)
        with layers_in_bf16(coords, self.bf16 and self.training):
            raw = self.to_density(features)[:, 0].to(coords.dtype)
        return DENSITY_SCALE * nn.functional.softplus(raw - self.config.emptiness)

    def radiance(self, coords: Tensor, directions: Tensor, share: float) -> Tensor:
        """Linear radiance (M, 3) at `coords` (M, 3) and a share of the clip.

        `directions` (M, 3) are unit view directions.
        """
        features = self.appearance_planes(coords, share)
        with layers_in_bf16(coords, self.bf16 and self.training):
            features = self.to_features(features).to(coords.dtype)
            inputs = [frequencies(features, OCTAVES), frequencies(directions, OCTAVES)]
            raw = self.color(torch.cat(inputs, -1)).to(coords.dtype)
        log_radiance = raw + self.bias
        return log_radiance.clamp(max=MAX_LOG_RADIANCE).exp()

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A render of the batch's pixels, recorded, and the planes' total variation."""
        assert batch.recorder is not None
        generator = generator_for(batch.rgb.device, batch.seed)
        samples = self.sample(batch.camera, batch.pixels, self.config.samples, generator)
        render, weights = self.render_samples(samples, batch.time, [batch.recorder], generator)
        self.cells.observe(samples.coords.reshape(-1, 3), weights.reshape(-1))
        variation = self.density_planes.total_variation() + self.appearance_planes.total_variation()
        return render, {"total_variation": variation}

    def sample(
        self, camera: Camera, pixels: Tensor, num_samples: int, generator: torch.Generator | None
    ) -> RaySamples:
        """Samples along the rays of `pixels` (N, 2); jittered with a generator."""
        return sample_rays(self.space, camera, pixels, num_samples, self.near, self.far, generator)

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        time: float,
        pixels: Tensor | None = None,
        scene_flow: bool = True,
        recorders: Sequence[Recorder] = (),
    ) -> Render:
        """Every pixel of `camera` (row by row) or `pixels` (S, 2) at `time` in frames.

        The render has no scene flow, and motion 0.
        """

        def render_chunk(chunk: Tensor) -> Render:
            samples = self.sample(camera, chunk, self.config.render_samples, None)
            return self.render_samples(samples, time, recorders, None)[0]

        return render_in_chunks(self, camera, pixels, render_chunk)

    def record(self, camera: Camera, time: float, recorders: Sequence[Recorder]) -> list[Tensor]:
        """What each of the `recorders` records (S, 3) in [0, 1] of every pixel.

        Row by row; one render serves them all.
        """
        rgb = self.render(camera, time, recorders=recorders).rgb
        assert rgb is not None
        return list(rgb.clamp(0, 1).split(3, 1))

    def loss_weights(self) -> dict[str, float]:
        """Of the planes' total variation."""
        return {"total_variation": self.config.total_variation}

    def param_groups(self) -> list[ParamGroup]:
        """Planes and networks, at the published rates and betas."""
        planes = [*self.density_planes.parameters(), *self.appearance_planes.parameters()]
        networks = [
            *self.to_density.parameters(),
            *self.to_features.parameters(),
            *self.color.parameters(),
        ]
        betas = (0.9, 0.99)
        return [
            ParamGroup(planes, self.config.plane_lr, betas),
            ParamGroup(networks, self.config.network_lr, betas),
        ]

    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> bool:
        """Grow the planes three times, and refresh the culling grid.

        The culling grid waits until it has seen enough.
        """
        self.steps.fill_(step)
        c = self.config
        if step % c.grow_every == 0 and step <= NUM_GROWTHS * c.grow_every:
            growth = step // c.grow_every / NUM_GROWTHS  # share of the way to the finest
            cells = round(c.coarsest * (c.finest / c.coarsest) ** growth)
            self.density_planes.grow(cells)
            self.appearance_planes.grow(cells)
        if step >= c.cull_after and step % REFRESH_EVERY == 0:
            self.cells.refresh(CULL_MIN_WEIGHT, WEIGHT_DECAY)
        return False

    def shared_maxima(self) -> list[Tensor]:
        """The culling grid's memory, of which several processes need the maximum."""
        return [self.cells.weight]
