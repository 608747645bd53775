"""NeRF-W with time (NeRF in the Wild, Martin-Brualla et al. 2021).

An appearance code per image, which the colors of the static branch depend on, explains
what changes with the camera from image to image. Moving content is in the transient
branch, which depends on time and whose density adds up with the static one. There is no
scene flow and no tone mapper: "radiance" is recorded rgb.

On networks, the transient branch is the published one: four layers on the features of
the static trunk and a code of the time, in place of a code of the image.

A picture other than the training images borrows the mean code of the training images of
its exposure (`Recorder.images`); radiance is rendered as the reference exposure looks.
As published, only the static branch depends on the code: movers keep the exposure of
the frames that show them. docs/baselines.md lists the differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.core.settings import Advanced, Count, Rate, Weight
from hdr_nsff.fields.base import Render
from hdr_nsff.fields.knots import interpolate_linear
from hdr_nsff.fields.nsff.branches import (
    DYNAMIC,
    GridBranches,
    GridConfig,
    MlpBranches,
    MlpConfig,
    Trunk,
    table_group,
)
from hdr_nsff.fields.nsff.samples import BranchOutput, render_in_chunks
from hdr_nsff.fields.nsff.two_branches import BranchesConfig, TwoBranches
from hdr_nsff.fields.space import Space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import PixelBatch, Recorder

TRANSIENT_LAYERS = 4  # of half the trunk's width, as published


@dataclass(frozen=True)
class NerfWTConfig(BranchesConfig):
    """NeRF-W with time."""

    type: Advanced[Literal["nerf-wt"]] = "nerf-wt"
    transient: Weight = 0.01
    """Loss: what a sample of the transient branch costs on average."""
    transient_cost: Advanced[Literal["thickness", "density"]] = "thickness"
    """By its optical thickness, or by its density, as published."""
    radiance: Literal["exp", "sigmoid"] = "sigmoid"
    """Unbounded radiance, or the published one below 1."""
    code_size: Count = 48
    """Numbers of an image's appearance code."""
    time_code_size: Advanced[Count] = 16
    """Numbers of a training time's code, where networks are used."""
    head_width: Advanced[Count] = 128
    """Width of the network that turns a grid's values and the code into colors."""
    head_lr: Advanced[Rate] = 5e-3
    """Learning rate of the codes and of that network, where grids are used."""


class Codes(nn.Module):
    """An appearance code per training image.

    `images` are the positions of the training images whose mean code is in use;
    `reference` those of the reference exposure, which it starts with.
    """

    def __init__(self, num_images: int, size: int, reference: tuple[int, ...]) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.randn(num_images, size))
        self.reference = self.images = reference

    def forward(self) -> Tensor:
        """The mean code (size,) of the images in use."""
        return self.table[list(self.images)].mean(0)


class CodedGrids(GridBranches):
    """Grids whose static colors pass a small network that takes the code too.

    At the start the network changes nothing.
    """

    def __init__(
        self,
        config: GridConfig,
        width: int,
        height: int,
        num_knots: int,
        codes: Codes,
        field_config: NerfWTConfig,
    ) -> None:
        super().__init__(config, width, height, num_knots)
        del self.motion_grids
        self.codes, self.head_lr = codes, field_config.head_lr
        head_width = field_config.head_width
        self.from_color = nn.Linear(3, head_width)
        self.from_code = nn.Linear(field_config.code_size, head_width, bias=False)
        self.to_color = nn.Linear(head_width, 3)
        nn.init.zeros_(self.to_color.weight)
        nn.init.zeros_(self.to_color.bias)

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        raw = super().static(coords, directions)
        color, rest = raw[:, :3], raw[:, 3:]
        hidden = (self.from_color(color) + self.from_code(self.codes())).relu()
        return torch.cat([color + self.to_color(hidden), rest], -1)

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        assert not motion, "NeRF-W has no scene flow"
        return self.dynamic_grid(coords, knot), None

    def param_groups(self) -> list[ParamGroup]:
        head = [
            *self.codes.parameters(),
            *self.from_color.parameters(),
            *self.from_code.parameters(),
            *self.to_color.parameters(),
        ]
        tables = table_group([self.static_grid, self.dynamic_grid], self.config.lr)
        return [tables, ParamGroup(head, self.head_lr)]


class CodedMlp(MlpBranches):
    """The published network.

    The static color head takes the image's code as further inputs. The transient head
    sees no view direction: its inputs are features of the static trunk and the code of
    the time, linear between training times.
    """

    def __init__(
        self, config: MlpConfig, num_knots: int, codes: Codes, time_code_size: int
    ) -> None:
        nn.Module.__init__(self)
        self.config, self.num_knots, self.codes = config, num_knots, codes
        self.static_trunk = Trunk(config, 3, 1, codes.table.shape[1])
        self.time_codes = nn.Parameter(torch.randn(num_knots, time_code_size))
        narrow = config.width // 2
        sizes = [config.width + time_code_size] + [narrow] * (TRANSIENT_LAYERS - 1)
        self.transient_hidden = nn.ModuleList(nn.Linear(n, narrow) for n in sizes)
        self.transient = nn.Linear(narrow, DYNAMIC)

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        code = self.codes().expand(len(coords), -1)
        return super().static(coords, torch.cat([directions, code], -1))

    def time_code(self, knot: float) -> Tensor:
        """The code (time_code_size,) of a knot, linear between training times."""
        return interpolate_linear(self.time_codes, knot)

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        assert not motion, "NeRF-W has no scene flow"
        trunk = self.static_trunk
        feature = trunk.feature(trunk.hidden_features(2 * coords - 1))
        h = torch.cat([feature, self.time_code(knot).expand(len(coords), -1)], -1)
        for layer in self.transient_hidden:
            h = layer(h).relu()
        return self.transient(h), None


class NerfWT(TwoBranches):
    """NeRF-W with time.

    Frames are of `size` (width, height); `reference` are the positions of the training
    images of the reference exposure.
    """

    config: NerfWTConfig

    def loss_weights(self) -> dict[str, float]:
        """Of what the transient branch costs."""
        return {"transient": self.config.transient}

    def __init__(
        self,
        config: NerfWTConfig,
        space: Space,
        times: Tensor,
        near: float,
        far: float,
        size: tuple[int, int],
        num_images: int,
        reference: tuple[int, ...],
    ) -> None:
        codes = Codes(num_images, config.code_size, reference)
        match config.encoding:
            case GridConfig() as c:
                branches: CodedGrids | CodedMlp = CodedGrids(c, *size, len(times), codes, config)
            case MlpConfig() as c:
                branches = CodedMlp(c, len(times), codes, config.time_code_size)
        super().__init__(config, space, times, near, far, *size, branches=branches)

    @property
    def codes(self) -> Codes:
        """The codes of the training images."""
        assert isinstance(self.branches, CodedGrids | CodedMlp)
        return self.branches.codes

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A render of the batch's pixels as they were recorded, and `transient`.

        That is what a sample of the transient branch costs on average.
        """
        assert batch.recorder is not None
        self.codes.images = batch.recorder.images
        base = self.query(batch, motion=False)
        render = self.compose(base.static, base.dynamic, base.weights, base.samples.depths)
        if self.config.transient_cost == "density":
            return render, {"transient": base.dynamic.density.mean()}
        # without the last interval, which has no length of its own where it is opaque
        thickness = base.dynamic.density[:, :-1] * base.samples.deltas[:, :-1]
        return render, {"transient": thickness.mean()}

    def compose(
        self, static: BranchOutput, dynamic: BranchOutput, weights: volume.Weights, depths: Tensor
    ) -> Render:
        """The render of both branches along rays with samples at `depths` (N, S)."""
        both = weights.static + weights.dynamic
        if self.config.compositing == "superpose":  # a ray may add up to more than 1
            both = both / both.sum(-1, keepdim=True).clamp_min(1)
        return Render(
            radiance=volume.composite(weights, static.radiance, dynamic.radiance),
            depth=volume.expected_depth(both, depths, self.far),
            opacity=weights.opacity,
            motion=weights.dynamic.sum(-1).clamp(max=1),
        )

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        time: float,
        pixels: Tensor | None = None,
        scene_flow: bool = True,
        recorder: Recorder | None = None,
    ) -> Render:
        """Every pixel of `camera` (row by row) or `pixels` (S, 2) at `time` in frames.

        It looks as `recorder` records it, by default as the reference exposure does.
        """
        self.codes.images = self.codes.reference if recorder is None else recorder.images
        knot = self.knot(time)
        return render_in_chunks(
            self, camera, pixels, lambda chunk: self.render_chunk(camera, knot, chunk)
        )

    def record(self, camera: Camera, time: float, recorders: Sequence[Recorder]) -> list[Tensor]:
        """What each of the `recorders` records (S, 3) in [0, 1] of every pixel.

        Row by row, one render for each.
        """
        renders = [self.render(camera, time, recorder=recorder) for recorder in recorders]
        return [
            recorder.rgb(render.radiance)
            for recorder, render in zip(recorders, renders, strict=True)
        ]

    def render_chunk(self, camera: Camera, knot: float, pixels: Tensor) -> Render:
        """The render of a few thousand `pixels` (N, 2) at a knot."""
        samples = self.sample(camera, pixels, self.config.render_samples, None)
        keep_static, keep_dynamic = self.select_samples(samples, knot, 0.0, None)
        if knot % 1:  # between two times: what either of them selects
            for neighbor in (int(knot), int(knot) + 1):
                _, selected = self.select_samples(samples, neighbor, 0.0, None)
                keep_dynamic = keep_dynamic | selected
        static = self.query_static(samples, keep_static)
        index = keep_dynamic.reshape(-1).nonzero()[:, 0]
        coords = samples.coords.reshape(-1, 3)[index]
        directions = self.view_directions(samples, index)
        dynamic, _ = self.query_dynamic(
            coords, index, keep_dynamic.shape, knot, directions, motion=False
        )
        weights = self.composite_weights(static, dynamic, samples.deltas)
        return self.compose(static, dynamic, weights, samples.depths)
