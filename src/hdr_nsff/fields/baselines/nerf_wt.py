"""NeRF-W with time (METHOD.md 6): what changes from image to image with the camera is a
code of numbers per image that the colors of the static branch know (Martin-Brualla et
al. 2021); what moves is the transient branch, whose density adds up with the static one
and which knows the time. No scene flow and no tone mapper: "radiance" is recorded rgb.

A picture of another image than those of training borrows the mean code of the training
images of its exposure (`Recorder.images`); asked for radiance, the field shows the look
of the reference exposure. As published, only the static branch knows the code: what
moves keeps the exposure of the frames that show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.nsff.branches import GridBranches, GridConfig, MlpBranches, MlpConfig, Trunk
from hdr_nsff.fields.nsff.samples import Content, in_chunks
from hdr_nsff.fields.nsff.two_branches import BranchesConfig, TwoBranches
from hdr_nsff.fields.space import Space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import PixelBatch, Recorder


@dataclass(frozen=True)
class NerfWTConfig(BranchesConfig):
    """NeRF-W with time."""

    radiance: Literal["exp", "sigmoid"] = "sigmoid"
    code_size: int = 48
    """Numbers of an image's appearance code."""
    head_width: int = 128
    """Width of the network that makes colors of a grid's values and the code."""
    head_lr: float = 5e-3
    """Of the codes and of that network, beside grids."""


class Codes(nn.Module):
    """An appearance code per training image, and the one in force."""

    def __init__(self, num_images: int, size: int, reference: tuple[int, ...]) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.randn(num_images, size))
        self.reference = self.images = reference

    def forward(self) -> Tensor:
        """The mean code (size,) of the images in force."""
        return self.table[list(self.images)].mean(0)


class CodedGrids(GridBranches):
    """Grids whose static colors pass a small network that knows the code; at the start
    it changes nothing.
    """

    def __init__(
        self,
        config: GridConfig,
        width: int,
        height: int,
        num_knots: int,
        codes: Codes,
        wt: NerfWTConfig,
    ) -> None:
        super().__init__(config, width, height, num_knots)
        del self.motion_grids
        self.codes, self.head_lr = codes, wt.head_lr
        self.own, self.of_code = (
            nn.Linear(3, wt.head_width),
            nn.Linear(wt.code_size, wt.head_width, bias=False),
        )
        self.out = nn.Linear(wt.head_width, 3)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        raw = super().static(coords, directions)
        rgb = raw[:, :3] + self.out((self.own(raw[:, :3]) + self.of_code(self.codes())).relu())
        return torch.cat([rgb, raw[:, 3:]], -1)

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        assert not motion, "NeRF-W knows no scene flow"
        return nn.functional.pad(self.dynamic_grid(coords, knot), (0, 1)), None

    def param_groups(self) -> list[dict[str, Any]]:
        grids = [self.static_grid, self.dynamic_grid]
        head = [
            *self.codes.parameters(),
            *self.own.parameters(),
            *self.of_code.parameters(),
            *self.out.parameters(),
        ]
        tables = {
            "params": [g.table for g in grids],
            "touched": [g.touched for g in grids],
            "lr": self.config.lr,
        }
        return [tables, {"params": head, "lr": self.head_lr}]


class CodedMlp(MlpBranches):
    """The published network; the static color head has the code as further inputs, the
    dynamic trunk only the time.
    """

    def __init__(self, config: MlpConfig, num_knots: int, codes: Codes) -> None:
        nn.Module.__init__(self)
        self.config, self.num_knots, self.codes = config, num_knots, codes
        self.static_trunk = Trunk(config, 3, 1, codes.table.shape[1])
        self.dynamic_trunk = Trunk(config, 4, 1)

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        return super().static(
            coords, torch.cat([directions, self.codes().expand(len(coords), -1)], -1)
        )


class NerfWT(TwoBranches):
    """See the module. Frames are of `size` (width, height); `reference` are the
    positions of the training images of the reference exposure.
    """

    config: NerfWTConfig

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
                branches = CodedMlp(c, len(times), codes)
        super().__init__(config, space, times, near, far, *size, branches=branches)

    @property
    def codes(self) -> Codes:
        """The codes of the training images."""
        assert isinstance(self.branches, CodedGrids | CodedMlp)
        return self.branches.codes

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A render of the batch's pixels in the look of its recording, and the mean
        optical thickness of the transient branch.
        """
        assert batch.recorder is not None
        self.codes.images = batch.recorder.images
        p = self.ask(batch, motion=False)
        render = self.compose(p.static, p.dynamic, p.w, p.m.depths)
        return render, {"transient": (p.dynamic.density * p.m.deltas).mean()}

    def compose(
        self, static: Content, dynamic: Content, w: volume.Weights, depths: Tensor
    ) -> Render:
        """Both branches along rays of `depths` (N, S)."""
        radiance = volume.weighted_sum(w.static, static.radiance) + volume.weighted_sum(
            w.dynamic, dynamic.radiance
        )
        depth = volume.expected_depth(w.static + w.dynamic, depths, self.far)
        return Render(radiance, depth, w.opacity, w.dynamic.sum(-1))

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        time: float,
        pixels: Tensor | None = None,
        scene_flow: bool = True,
        recorder: Recorder | None = None,
    ) -> Render:
        """Every pixel of `camera` (row by row) or `pixels` (S, 2) at `time` in frames,
        in the given look or that of the reference exposure.
        """
        self.codes.images = self.codes.reference if recorder is None else recorder.images
        return in_chunks(self, camera, pixels, lambda chunk: self.render_chunk(camera, time, chunk))

    def record(self, camera: Camera, time: float, recorders: Sequence[Recorder]) -> list[Tensor]:
        """What each of the `recorders` records (S, 3) in [0, 1] of every pixel, row by
        row.
        """
        return [
            recorder.rgb(self.render(camera, time, recorder=recorder).radiance)
            for recorder in recorders
        ]

    def render_chunk(self, camera: Camera, time: float, pixels: Tensor) -> Render:
        """A few thousand pixels at once."""
        knot = self.knot(time)
        m = self.march(camera, pixels, self.config.render_samples, None)
        keep_static, keep_dynamic = self.kept(m, knot, 0.0, None)
        if knot % 1:  # between two times, what either of them asks for
            for k in (int(knot), int(knot) + 1):
                keep_dynamic = keep_dynamic | self.kept(m, k, 0.0, None)[1]
        static = self.static_content(m, keep_static)
        index = keep_dynamic.reshape(-1).nonzero()[:, 0]
        coords = m.coords.reshape(-1, 3)[index]
        dynamic, _ = self.dynamic_content(
            coords, index, keep_dynamic.shape, knot, self.views(m, index), motion=False
        )
        return self.compose(static, dynamic, self.weights(static, dynamic, m.deltas), m.depths)
