"""HDR-HexPlane (METHOD.md 6): density and log radiance at (x, y, z, t) from six feature
planes each, one content for what moves and what stands. Its camera acts on every sample
before compositing: `rgb = sum_i w_i g(gain E_i)`.

The seam of that is `Recorder`: the field asks the callable it is handed for the rgb of
its samples' radiance, and knows neither exposure nor curve. A field whose radiance is
composited first and then recorded, `g(gain sum_i w_i E_i)`, differs wherever a ray sees
more than one radiance: the sigmoid is concave, so by Jensen's inequality recording
samples gives the darker value, and a ray that meets nothing is black in any case. The
HDR picture is `sum_i w_i E_i`, the radiance of the samples in the same weights.

From the paper and its code, to the best of our knowledge: products of planes side by
side, a linear map to density and to 27 appearance features, softplus density, a
view-dependent network of three layers, the weight from which a sample has a color.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from hdr_nsff.fields.base import FrameError, Render
from hdr_nsff.fields.baselines.planes import Planes
from hdr_nsff.fields.knots import knot_of
from hdr_nsff.fields.nsff.encodings import frequencies
from hdr_nsff.fields.nsff.occupancy import Occupancy
from hdr_nsff.fields.nsff.samples import March, in_chunks, march
from hdr_nsff.fields.space import Space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import PixelBatch, Recorder

FEATURES = 27  # that the color network sees
OCTAVES = 2  # of features and of directions, in the color network
UNITS = 75.0  # density per cube side: 25 per unit of a box of three, as published
FAINT = 1e-4  # weight below which a sample has no color
GROWTHS = 3  # times that the grid grows


@dataclass(frozen=True)
class HexPlaneConfig:
    """HDR-HexPlane."""

    density_components: int = 24
    """Numbers per plane that make density."""
    appearance_components: int = 48
    """Numbers per plane that make color."""
    coarsest: int = 64
    """Cells a side of the cube at the start."""
    finest: int = 200
    """Cells a side at the end."""
    grow_every: int = 3000
    """Steps after which the grid grows, three times in all."""
    emptiness: float = 10.0
    """Subtracted from raw density, so that space is empty at the start."""
    width: int = 128
    """Width of the color network."""
    samples: int = 64
    """Samples along a ray while training."""
    render_samples: int = 128
    """Samples along a ray when rendering."""
    cull_after: int = 500
    """Steps before samples in cells that never mattered are skipped."""
    explore: float = 0.04
    """Share of the culled samples that is evaluated all the same."""
    plane_lr: float = 0.02
    network_lr: float = 1e-3


class HexPlane(nn.Module):
    """See the module. `times` (T,) are those of the training frames."""

    times: Tensor
    bias: Tensor
    steps: Tensor

    def __init__(
        self, config: HexPlaneConfig, space: Space, times: Tensor, near: float, far: float
    ) -> None:
        super().__init__()
        self.config, self.space, self.near, self.far = config, space, near, far
        self.register_buffer("times", times.double())
        slices = max(2, -(-len(times) // 2))
        c = config
        self.density_planes = Planes(c.density_components, c.coarsest, c.finest, slices)
        self.appearance_planes = Planes(c.appearance_components, c.coarsest, c.finest, slices)
        self.to_density = nn.Linear(3 * c.density_components, 1, bias=False)
        self.to_features = nn.Linear(3 * c.appearance_components, FEATURES, bias=False)
        inputs = (FEATURES + 3) * (1 + 2 * OCTAVES)
        layers = (
            nn.Linear(inputs, c.width),
            nn.ReLU(),
            nn.Linear(c.width, c.width),
            nn.ReLU(),
            nn.Linear(c.width, 3),
        )
        self.color = nn.Sequential(*layers)
        self.register_buffer("bias", torch.tensor(0.0))  # raw radiance 0 is this log radiance
        self.cells = Occupancy((64, 36, 32))
        self.register_buffer("steps", torch.tensor(0))

    def share(self, time: float) -> float:
        """A time (in frames) as a share of the training times."""
        return knot_of(self.times, time) / max(len(self.times) - 1, 1)

    def see(
        self, m: March, time: float, recorders: Sequence[Recorder], rng: torch.Generator | None
    ) -> tuple[Render, Tensor]:
        """Rays (N rays, S samples) at a time, with what each of the `recorders` records
        before compositing side by side in `rgb`; and the weights (N, S).
        """
        flat, shape, share = m.coords.reshape(-1, 3), m.depths.shape, self.share(time)
        asked = self.cells.asks(
            flat, 0.0, self.config.explore if rng is not None else 0.0, rng
        ).nonzero()[:, 0]
        raw = self.to_density(self.density_planes(flat[asked], share))[:, 0]
        density = flat.new_zeros(len(flat)).index_copy(
            0, asked, UNITS * nn.functional.softplus(raw - self.config.emptiness)
        )
        w = volume.single(density.view(shape), m.deltas)
        colored = asked
        if (
            int(self.steps) >= self.config.cull_after or rng is None
        ):  # at the start nothing would be heavy enough to learn a color
            colored = (w.detach().reshape(-1) > FAINT).nonzero()[:, 0]
        ray = torch.div(colored, shape[1], rounding_mode="floor")
        radiance = self.radiance(flat[colored], m.directions[ray], share)
        packed = w.reshape(-1)[colored, None]

        def composite(values: Tensor) -> Tensor:
            return values.new_zeros(shape[0], values.shape[1]).index_add(0, ray, packed * values)

        rgb = (
            composite(torch.cat([recorder.rgb(radiance) for recorder in recorders], 1))
            if recorders
            else None
        )
        depth = volume.expected_depth(w, m.depths, self.far)
        return Render(composite(radiance), depth, w.sum(-1), torch.zeros_like(depth), rgb=rgb), w

    def radiance(self, coords: Tensor, directions: Tensor, share: float) -> Tensor:
        """Linear radiance (M, 3) at `coords` (M, 3) towards unit `directions` (M, 3)."""
        features = self.to_features(self.appearance_planes(coords, share))
        log = self.color(
            torch.cat([frequencies(features, OCTAVES), frequencies(directions, OCTAVES)], -1)
        )
        return (log + self.bias).clamp(max=14.0).exp()

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A render of the batch's pixels with what is recorded of them, and the planes'
        total variation.
        """
        assert batch.recorder is not None
        rng = torch.Generator().manual_seed(batch.seed)
        m = march(
            self.space, batch.camera, batch.pixels, self.config.samples, self.near, self.far, rng
        )
        render, w = self.see(m, batch.time, [batch.recorder], rng)
        self.cells.observe(m.coords.reshape(-1, 3), w.reshape(-1))
        return render, {
            "total_variation": self.density_planes.total_variation()
            + self.appearance_planes.total_variation()
        }

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
        It tells no scene flow and no share of motion.
        """

        def part(chunk: Tensor) -> Render:
            m = march(
                self.space, camera, chunk, self.config.render_samples, self.near, self.far, None
            )
            return self.see(m, time, recorders, None)[0]

        return in_chunks(self, camera, pixels, part)

    def record(self, camera: Camera, time: float, recorders: Sequence[Recorder]) -> list[Tensor]:
        """What each of the `recorders` records (S, 3) in [0, 1] of every pixel, row by
        row; one render tells them all.
        """
        rgb = self.render(camera, time, recorders=recorders).rgb
        assert rgb is not None
        return list(rgb.clamp(0, 1).split(3, 1))

    def param_groups(self) -> list[dict[str, Any]]:
        """Planes and networks, at the published rates."""
        planes = [*self.density_planes.parameters(), *self.appearance_planes.parameters()]
        networks = [
            *self.to_density.parameters(),
            *self.to_features.parameters(),
            *self.color.parameters(),
        ]
        betas = (0.9, 0.99)
        return [
            {"params": planes, "lr": self.config.plane_lr, "betas": betas},
            {"params": networks, "lr": self.config.network_lr, "betas": betas},
        ]

    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> None:
        """Grow the planes three times, and refresh the culling grid every 16 steps once
        it has seen enough.
        """
        self.steps.fill_(step)
        c = self.config
        if step % c.grow_every == 0 and step <= GROWTHS * c.grow_every:
            cells = round(c.coarsest * (c.finest / c.coarsest) ** (step // c.grow_every / GROWTHS))
            for planes in (self.density_planes, self.appearance_planes):
                planes.grow(cells)
        if step >= c.cull_after and step % 16 == 0:
            self.cells.refresh(threshold=1e-3, decay=0.97)

    def shared_maxima(self) -> list[Tensor]:
        """What several processes must agree on between steps: the culling grid's
        memory.
        """
        return [self.cells.weight]
