"""Dynamic radiance as 4D Gaussians in linear HDR: static ones, moving ones on
shared trajectories, and time-local ones for non-rigid motion.

Color is the exponential of a log radiance, unbounded (a sigmoid bounds it for the
ablation). Colors of moving Gaussians change in time, and static ones brighten or darken
slowly (shadows of movers). The number of Gaussians is fixed by the settings; ones that
fade away draw nothing and cost next to nothing. docs/method.md, section "Gaussians".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.core.tensors import constant, tree_map
from hdr_nsff.fields.base import FrameError, Render, Warp
from hdr_nsff.fields.outputs import GaussianCloud, select_pixels
from hdr_nsff.fields.splat.cloud import alive_at, cloud_at, displacement, positions_at
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.draw import composite, draw, record_parts, seen_radiance
from hdr_nsff.fields.splat.gaussians import Gaussians
from hdr_nsff.fields.splat.late_mixing import LateMixing
from hdr_nsff.fields.splat.learning_rates import param_groups
from hdr_nsff.fields.splat.local_gaussians import LocalGaussians
from hdr_nsff.fields.splat.model import Model
from hdr_nsff.fields.splat.relocate import relocate_unseen
from hdr_nsff.fields.splat.shutter import Shutter
from hdr_nsff.fields.splat.terms import MIN_OPACITY
from hdr_nsff.fields.splat.training_view import TrainingView, see
from hdr_nsff.fields.splat.trajectories import Trajectories
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, Recorder, neighbor_in_turn

NUM_NEIGHBORS = 4  # of a moving Gaussian, for rigidity
RELOCATE_FRAMES = 24  # training frames whose errors decide what is relocated


class Splat(nn.Module):
    """A field of 4D Gaussians.

    `times` (T,) are the training times; `near` and `far` are z-depths in scene units,
    and `near` is the scene's typical length; frames have `num_pixels`, and movers that
    are not rigid `local_pixels` in all of them. Training frames see what the `shutter`
    lets them see; None: each a moment.
    """

    times: Tensor
    neighbors: Tensor

    def __init__(
        self,
        config: SplatConfig,
        times: Tensor,
        near: float,
        far: float,
        num_pixels: int,
        local_pixels: int = 0,
        shutter: Shutter | None = None,
    ) -> None:
        super().__init__()
        self.shutter = shutter
        self.config, self.unit = config, near
        self.near, self.far = near, far
        self.host_times = times.double()  # reading the buffer would wait for a GPU
        self.register_buffer("times", self.host_times)
        static, moving, local = config.counts(num_pixels, local_pixels, len(times))
        self.bounded = config.radiance == "sigmoid"
        views, bounded = config.view_dependence, self.bounded
        self.static = Gaussians(static, config.brightness_knots, 1, views, bounded)
        self.moving = Gaussians(moving, config.color_knots, 3, views, bounded)
        self.local = LocalGaussians(local, bounded)
        # added to the moving ones' opacity logits
        self.opacity_offsets = nn.Parameter(torch.zeros(config.opacity_knots, moving))
        self.mixture_logits = nn.Parameter(torch.zeros(config.bases, moving))
        self.trajectories = Trajectories(config.bases, self.host_times)
        itself = torch.arange(moving, dtype=torch.int32)[:, None]
        self.register_buffer("neighbors", itself.repeat(1, NUM_NEIGHBORS))  # of moving ones
        # log radiance (or log odds) where no Gaussian is
        self.background = nn.Parameter(torch.zeros(3))
        self.late_mixing = LateMixing() if config.late_mixing else None

    # The Gaussians at a time

    def model(self) -> Model:
        """All kinds of Gaussians together, and what is behind them."""
        kinds = self.static, self.moving, self.local, self.trajectories
        tables = self.opacity_offsets, self.mixture_logits, self.neighbors, self.background
        return Model(*kinds, *tables, self.host_times, self.unit, self.far)

    def knot(self, time: float) -> float:
        """Position of a time (in frames) on the list of training times."""
        return self.model().knot(time)

    def alive(self, knot: float) -> Tensor:
        """Indices (A,) of the time-local Gaussians that are alive at a knot."""
        return alive_at(self.model(), knot)

    def cloud(self, knot: float, alive: Tensor | None = None) -> GaussianCloud:
        """All Gaussians at a knot, differentiable in everything.

        Static ones first, then moving ones, then the time-local ones `alive` (A,); by
        default those alive at the knot.
        """
        alive = self.alive(knot) if alive is None else alive
        return cloud_at(self.model(), knot, self.local.living(alive))

    def positions(self, knot: float, alive: Tensor | None = None) -> Tensor:
        """Means (G, 3) of the Gaussians of `cloud` at a knot.

        The time-local ones are those `alive` (A,) at any knot; by default at this one.
        """
        alive = self.alive(knot) if alive is None else alive
        return positions_at(self.model(), knot, self.local.living(alive))

    @torch.no_grad()
    def gaussians(self, time: float) -> GaussianCloud:
        """The Gaussians that draw anything at `time` in frames, static ones first.

        They are what `render` composites over the background.
        """
        cloud = self.cloud(self.knot(time))
        visible = cloud.opacities > MIN_OPACITY
        return tree_map(lambda t: t[visible], cloud)

    # Pictures

    @torch.no_grad()
    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        """Every pixel of `camera` (row by row) or of `pixels` (S, 2), no gradients.

        `time` is in frames. Scene flow is the displacement to one training interval
        later and earlier; at the clip's ends it continues in a straight line.
        """
        model = self.model()
        knot = model.knot(time)
        living = self.local.living(alive_at(model, knot))
        cloud = cloud_at(model, knot, living)
        offsets = (1, -1) if scene_flow else ()
        steps = [displacement(model, cloud.means, living, knot, o) for o in offsets]
        render, drawn = composite(model, draw(model, camera, cloud, steps))
        flow = {o: drawn[:, 3 * i : 3 * i + 3] for i, o in enumerate(offsets)}
        depth = render.depth.clamp(self.near, self.far)
        render = replace(render, depth=depth, scene_flow=flow)
        return render if pixels is None else select_pixels(render, camera, pixels)

    @torch.no_grad()
    def recorded_late(
        self, camera: Camera, time: float, recorders: Sequence[Recorder]
    ) -> list[tuple[Tensor, Tensor]]:
        """For each of the `recorders` the averages (S, 3) of what it records, row by
        row, and their shares (S, 1) in the pixels; nothing without late mixing.
        """
        if self.late_mixing is None:
            return []
        model, cloud = self.model(), self.cloud(self.knot(time))
        pictures = []
        for recorder in recorders:
            radiance = seen_radiance(model, camera, cloud)
            parts = record_parts(model, recorder, camera, radiance, cloud.means)
            render, drawn = composite(model, draw(model, camera, cloud, [parts.gaussians]))
            pictures.append(self.late_mixing(parts, drawn, render))
        return pictures

    # Training

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A training render of the whole frame at the batch's pixels, and regularizers.

        Two expensive terms take turns, by the batch's seed: flow to one of the
        neighbors, as a warp, and rigidity and evenness.
        """
        knot = self.knot(batch.time)
        flow_turn = batch.seed % 2 == 0
        offsets = neighbor_in_turn(batch) if flow_turn else []
        late = None if batch.recorder is None else self.late_mixing
        due = offsets, not flow_turn, late, self.shutter
        seen = see(self.model(), TrainingView(batch, knot, self.alive(knot), *due))
        render, flow = seen.render, seen.flow
        certain = constant((1.0,), flow.device, flow.dtype).expand(len(render.opacity))
        warps = tuple(Warp(o, flow, certain, None) for o in offsets)
        render = replace(render, warps=warps)
        if not batch.whole:
            render = select_pixels(render, batch.camera, batch.pixels)
        return render, seen.terms

    @torch.no_grad()
    def find_neighbors(self) -> None:
        """Find the nearest moving Gaussians of each moving Gaussian anew."""
        if len(self.moving) <= NUM_NEIGHBORS:
            return
        places = self.moving.means.cpu().numpy()
        _, nearest = cKDTree(places).query(places, NUM_NEIGHBORS + 1)
        self.neighbors.copy_(torch.from_numpy(nearest[:, 1:]))  # the first is itself

    def loss_weights(self) -> dict[str, float]:
        """Of the field's own terms; `sh1` only where colors depend on the view."""
        weights = asdict(self.config.loss)
        if not self.config.view_dependence:
            del weights["sh1"]
        return weights

    def param_groups(self) -> list[ParamGroup]:
        """One group for every learning rate."""
        config, groups = self.config, param_groups(self.model(), self.config)
        if self.late_mixing is not None:
            rate = config.lr * config.late_mixing_lr
            groups.append(ParamGroup([self.late_mixing.share], rate))
        return groups

    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> bool:
        """Relocate Gaussians every `relocate_every` steps, and bound the late share."""
        if self.late_mixing is not None:
            self.late_mixing.share.data.clamp_(0, 1)
        every = self.config.relocate_every
        if frame_errors is None or not every or step % every:
            return False
        generator = torch.Generator().manual_seed(step)
        relocate_unseen(self.model(), frame_errors(RELOCATE_FRAMES), generator)
        self.find_neighbors()
        self.local.find_neighbors(self.unit)
        return True

    def shared_maxima(self) -> list[Tensor]:
        """Nothing that several processes must agree on besides gradients."""
        return []
