"""Dynamic radiance as 4D Gaussians in linear HDR: static ones, moving ones on
shared trajectories, and time-local ones for non-rigid motion.

Color is the exponential of a log radiance, unbounded (a sigmoid bounds it for the
ablation). Colors of moving Gaussians change in time, and static ones brighten or darken
slowly (shadows of movers). The number of Gaussians is fixed by the settings; ones that
fade away draw nothing and cost next to nothing. docs/method.md, section "4D Gaussians".
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
from hdr_nsff.fields.knots import interpolate_linear, knot_of, time_at
from hdr_nsff.fields.outputs import GaussianCloud, select_pixels
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.cuda_backends import kernels_on
from hdr_nsff.fields.splat.fused_cloud import MAX_FLOW, Moment, fused_cloud
from hdr_nsff.fields.splat.fused_picture import fused_composite
from hdr_nsff.fields.splat.gaussians import Gaussians, scale_radiance, to_radiance
from hdr_nsff.fields.splat.late_mixing import LateMixing, Parts, split_late
from hdr_nsff.fields.splat.local_gaussians import LocalGaussians
from hdr_nsff.fields.splat.rasterize import Maps, rasterize
from hdr_nsff.fields.splat.relocate import LocalScores, relocate
from hdr_nsff.fields.splat.shutter import Shutter, apparent_motion
from hdr_nsff.fields.splat.terms import MIN_OPACITY, Model, mixture_difference, regularizers
from hdr_nsff.fields.splat.trajectories import Trajectories
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, Recorder, neighbor_in_turn

NUM_NEIGHBORS = 4  # of a moving Gaussian, for rigidity
MAX_VIEW_LOG_FACTOR = 2.0  # by which log radiance may change with the direction of view
RELOCATE_FRAMES = 24  # training frames whose errors decide what is relocated
MIN_ALPHA = 1e-3  # of a pixel: below, it has no depth of its own
MIN_DEPTH_SHARE = 1e-3  # of `near`: the least z-depth that a pixel gets
ADAM_EPS = 1e-15  # as 3D Gaussian splatting has it (Kerbl et al. 2023)


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
        self.trajectories = Trajectories(config.bases, len(times))
        itself = torch.arange(moving, dtype=torch.int32)[:, None]
        self.register_buffer("neighbors", itself.repeat(1, NUM_NEIGHBORS))  # of moving ones
        # log radiance (or log odds) where no Gaussian is
        self.background = nn.Parameter(torch.zeros(3))
        self.late_mixing = LateMixing() if config.late_mixing else None

    # Time

    def knot(self, time: float) -> float:
        """Position of a time (in frames) on the list of training times."""
        return knot_of(self.host_times, time)

    def share(self, knot: float) -> float:
        """A knot as a share in [0, 1] of the clip."""
        return knot / max(len(self.times) - 1, 1)

    def time(self, knot: float) -> float:
        """The time (in frames) at a knot within the clip."""
        return time_at(self.host_times, knot)

    def has_knot(self, knot: float) -> bool:
        """Whether a knot lies within the clip."""
        return 0 <= knot <= len(self.times) - 1

    # The Gaussians at a time

    def alive(self, knot: float) -> Tensor:
        """Indices (A,) of the time-local Gaussians that are alive at a knot."""
        return self.local.alive(self.time(knot))

    def cloud(self, knot: float, alive: Tensor | None = None) -> GaussianCloud:
        """All Gaussians at a knot, differentiable in everything.

        Static ones first, then moving ones, then the time-local ones `alive` (A,); by
        default those alive at the knot.
        """
        alive = self.alive(knot) if alive is None else alive
        time, local = self.time(knot), self.local
        mixture, share = self.mixture_logits.softmax(0), self.share(knot)
        static, moving = self.static, self.moving
        pose = self.trajectories.pose(knot)
        moved = self.trajectories.move(moving.means, mixture, pose)
        turned = self.trajectories.turn(moving.quaternions, mixture, pose)
        at_rest = static.means.new_zeros(len(static))
        num_moving = len(moving) + len(alive)
        log_scales = [static.log_scales, moving.log_scales, local.log_scales[alive, :3]]
        radiance = [static.radiance(share), moving.radiance(share), local.radiance(alive)]
        return GaussianCloud(
            means=torch.cat([static.means, moved, local.positions(alive, time)]),
            quaternions=torch.cat([static.quaternions, turned, local.quaternions[alive]]),
            scales=torch.cat(log_scales).exp(),
            opacities=torch.cat([self.opacities(share), local.opacities(alive, time)]),
            radiance=torch.cat(radiance),
            motion=torch.cat([at_rest, static.means.new_ones(num_moving)]),
        )

    def opacities(self, share: float) -> Tensor:
        """Opacities (G,) in [0, 1] of static and moving ones at a share of the clip."""
        position = share * (len(self.opacity_offsets) - 1)
        offsets = interpolate_linear(self.opacity_offsets, position)
        return torch.cat(
            [self.static.opacity_logits, self.moving.opacity_logits + offsets]
        ).sigmoid()

    def positions(self, knot: float, alive: Tensor | None = None) -> Tensor:
        """Means (G, 3) of the Gaussians of `cloud` at a knot.

        The time-local ones are those `alive` (A,) at any knot; by default at this one.
        """
        alive = self.alive(knot) if alive is None else alive
        mixture = self.mixture_logits.softmax(0)
        pose = self.trajectories.pose(knot)
        moved = self.trajectories.move(self.moving.means, mixture, pose)
        lived = self.local.positions(alive, self.time(knot))
        return torch.cat([self.static.means, moved, lived])

    @torch.no_grad()
    def gaussians(self, time: float) -> GaussianCloud:
        """The Gaussians that draw anything at `time` in frames, static ones first.

        They are what `render` composites over the background.
        """
        knot = self.knot(time)
        cloud = self.cloud(knot)
        visible = cloud.opacities > MIN_OPACITY
        return tree_map(lambda t: t[visible], cloud)

    # Drawing them

    def draw(self, camera: Camera, cloud: GaussianCloud, extra: list[Tensor]) -> Maps:
        """Rasterize radiance (3), motion (1) and `extra` features (G, ...)."""
        radiance = self.seen_radiance(camera, cloud)
        features = torch.cat([radiance, cloud.motion[:, None], *extra], 1)
        return rasterize(
            cloud.means, cloud.quaternions, cloud.scales, cloud.opacities, features, camera
        )

    def seen_radiance(self, camera: Camera, cloud: GaussianCloud) -> Tensor:
        """Radiance (G, 3) of the Gaussians in the direction of `camera`."""
        if not self.config.view_dependence:
            return cloud.radiance
        log_factor = self.view_log_factor(camera, cloud.means)
        return scale_radiance(cloud.radiance, log_factor, self.bounded)

    def view_log_factor(self, camera: Camera, means: Tensor) -> Tensor:
        """Change (G, 3) of log radiance with the direction in which `camera` sees.

        The directions are those to the `means` (G, 3): spherical harmonics of degree 1.
        """
        directions = nn.functional.normalize(means - camera.c2w[:, 3], dim=-1)
        same_everywhere = means.new_zeros(len(means) - len(self.static) - len(self.moving), 3, 3)
        sh1 = torch.cat([self.static.sh1, self.moving.sh1, same_everywhere])
        change = (sh1 @ directions[..., None])[..., 0]
        return change.clamp(-MAX_VIEW_LOG_FACTOR, MAX_VIEW_LOG_FACTOR)

    def composite(self, maps: Maps) -> tuple[Render, Tensor]:
        """The render of drawn `maps` over the background, and extra features (S, E)."""
        alpha = maps.alpha.reshape(-1)
        features = maps.features.flatten(0, 1)
        drawn, motion, extra = features.split([3, 1, features.shape[-1] - 4], 1)
        background = to_radiance(self.background, self.bounded)
        # not a sum of two products: the result lies in memory like `drawn`
        radiance = torch.addcmul(drawn, (1 - alpha)[:, None], background)
        depth = maps.depth.reshape(-1) / alpha.clamp_min(MIN_ALPHA)
        depth = torch.where(alpha > MIN_ALPHA, depth, self.far)
        depth = depth.clamp_min(MIN_DEPTH_SHARE * self.unit)
        return Render(radiance, depth, alpha, motion[:, 0]), extra

    @torch.no_grad()
    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        """Every pixel of `camera` (row by row) or of `pixels` (S, 2), no gradients.

        `time` is in frames. Scene flow is the displacement to one training interval
        later and earlier; at the clip's ends it continues in a straight line.
        """
        knot = self.knot(time)
        alive = self.alive(knot)
        cloud = self.cloud(knot, alive)
        offsets = (1, -1) if scene_flow else ()
        steps = [self.displacement(cloud.means, alive, knot, o) for o in offsets]
        render, drawn = self.composite(self.draw(camera, cloud, steps))
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
        cloud = self.cloud(self.knot(time))
        pictures = []
        for recorder in recorders:
            parts = self.parts(recorder, camera, cloud)
            render, drawn = self.composite(self.draw(camera, cloud, [parts.gaussians]))
            pictures.append(self.late_mixing(parts, drawn, render))
        return pictures

    def parts(self, recorder: Recorder, camera: Camera, cloud: GaussianCloud) -> Parts:
        """The Gaussians and the background, recorded."""
        radiance = self.seen_radiance(camera, cloud)
        background = to_radiance(self.background, self.bounded)
        return Parts.of(recorder, camera, radiance, cloud.means, background)

    def displacement(self, means: Tensor, alive: Tensor, knot: float, offset: int) -> Tensor:
        """From `means` (G, 3) at a knot to the means one training interval away.

        `alive` (A,) are the time-local ones among them.

        `offset` is +1 (later) or -1 (earlier). Beyond the clip's ends, the displacement
        of the other direction is continued.
        """
        if self.has_knot(knot + offset):
            return self.positions(knot + offset, alive) - means
        if self.has_knot(knot - offset):
            return means - self.positions(knot - offset, alive)
        return torch.zeros_like(means)

    # Training

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A training render of the whole frame at the batch's pixels, and regularizers.

        Two expensive terms take turns, by the batch's seed: flow to one of the
        neighbors, as a warp, and rigidity and evenness.
        """
        knot = self.knot(batch.time)
        flow_turn = batch.seed % 2 == 0
        offsets = neighbor_in_turn(batch) if flow_turn else []
        alive = self.alive(knot)
        if self.can_fuse(batch):
            maps, parts, terms = self.draw_fused(batch, knot, alive, offsets, not flow_turn)
            maps, late = split_late(maps, parts)
            least = MIN_DEPTH_SHARE * self.unit
            numbers = self.bounded, self.far, least, MIN_ALPHA
            render, flow = fused_composite(maps, self.background, *numbers)
        else:
            maps, parts, terms = self.draw_terms(batch, knot, alive, offsets, not flow_turn)
            maps, late = split_late(maps, parts)
            render, drawn = self.composite(maps)
            # features are premultiplied by opacity
            flow = drawn / render.opacity.clamp_min(MIN_ALPHA)[:, None]
        if self.late_mixing is not None and parts is not None and late is not None:
            average, share = self.late_mixing(parts, late, render)
            render = replace(render, late=average, late_share=share)
        certain = constant((1.0,), flow.device, flow.dtype).expand(len(render.opacity))
        warps = tuple(Warp(o, flow, certain, None) for o in offsets)
        render = replace(render, warps=warps)
        if not batch.whole:
            render = select_pixels(render, batch.camera, batch.pixels)
        return render, terms

    def draw_terms(
        self, batch: PixelBatch, knot: float, alive: Tensor, offsets: list[int], rigidity: bool
    ) -> tuple[Maps, Parts | None, dict[str, Tensor]]:
        """What the batch sees, with flow to `offsets`; the recorded parts, which the
        maps hold last; and the field's terms.
        """
        cloud = self.cloud(knot, alive)
        extra = [self.flow_to_neighbor(batch, cloud.means, alive, knot, o) for o in offsets]
        parts = None
        if self.late_mixing is not None and batch.recorder is not None:
            parts = self.parts(batch.recorder, batch.camera, cloud)
            extra.append(parts.gaussians)
        maps = self.expose(batch, cloud, alive, extra)
        self.trajectories.mark(knot)
        self.local.mark(alive)
        terms = regularizers(self.model(), cloud, knot)
        if rigidity:
            terms["rigidity"] = mixture_difference(self.mixture_logits, self.neighbors)
            terms["evenness"] = self.local.unevenness(alive, self.unit)
        return maps, parts, terms

    def can_fuse(self, batch: PixelBatch) -> bool:
        """Whether kernels make the Gaussians of the batch's moment: on a GPU, without
        view dependence, shutter or learned cameras.
        """
        cameras = batch.camera, *batch.neighbors.values()
        learned = any(c.c2w.requires_grad or c.K.requires_grad for c in cameras)
        special = learned or self.shutter is not None or self.config.view_dependence
        return not special and kernels_on(self.background.device)

    def draw_fused(
        self, batch: PixelBatch, knot: float, alive: Tensor, offsets: list[int], rigidity: bool
    ) -> tuple[Maps, Parts | None, dict[str, Tensor]]:
        """`draw_terms` by CUDA kernels, with flow to one neighbor at most."""
        neighbor = None
        for offset in offsets:
            there = min(max(knot + offset, 0), len(self.times) - 1)
            neighbor = there, self.time(there), batch.neighbors[offset]
        when = knot, self.time(knot), self.share(knot)
        moment = Moment(*when, batch.camera, neighbor, rigidity)
        cloud = fused_cloud(self.model(), moment, alive)
        gaussians = cloud.means, cloud.quaternions, cloud.scales, cloud.opacities
        features, parts = cloud.features, None
        if self.late_mixing is not None and batch.recorder is not None:
            background = to_radiance(self.background, self.bounded)
            given = batch.recorder, batch.camera, features[:, :3], cloud.means, background
            parts = Parts.of(*given)
            features = torch.cat([features, parts.gaussians], 1)
        return rasterize(*gaussians, features, batch.camera), parts, cloud.terms

    def model(self) -> Model:
        """All kinds of Gaussians together."""
        kinds = self.static, self.moving, self.local, self.trajectories
        return Model(*kinds, self.opacity_offsets, self.mixture_logits, self.neighbors, self.unit)

    def expose(
        self, batch: PixelBatch, cloud: GaussianCloud, alive: Tensor, extra: list[Tensor]
    ) -> Maps:
        """What the batch's frame sees of the `cloud`, with `extra` features (G, ...).

        `alive` (A,) are the time-local ones in it.
        """

        def draw(means: Tensor) -> Maps:
            return self.draw(batch.camera, replace(cloud, means=means), extra)

        if self.shutter is None or not batch.neighbors:
            return draw(cloud.means)
        neighbors = []
        for offset in sorted(batch.neighbors):
            knot = self.knot(batch.time) + offset
            points = self.positions(knot, alive).detach()
            neighbors.append((batch.neighbors[offset], points, self.time(knot)))
        motion = apparent_motion(batch.camera, neighbors, cloud.means, batch.time)
        return Maps(*self.shutter.expose(draw, batch.camera, cloud.means, motion, batch.bracket))

    def flow_to_neighbor(
        self, batch: PixelBatch, means: Tensor, alive: Tensor, knot: float, offset: int
    ) -> Tensor:
        """Optical flow (G, 2) in pixels, from the batch's camera to a neighboring one.

        From where the camera sees each Gaussian's mean (G, 3), the time-local ones
        `alive` (A,) among them, to where the neighbor sees it at its own time.
        """
        last_knot = len(self.times) - 1
        moved = self.positions(min(max(knot + offset, 0), last_knot), alive)
        camera, neighbor = batch.camera, batch.neighbors[offset]
        limit = MAX_FLOW * camera.width
        return (neighbor.project(moved)[0] - camera.project(means)[0]).clamp(-limit, limit)

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
        """One group for every learning rate, as an optimizer works group by group.

        Of the poses, only those near the drawn frame move.
        """
        config = self.config
        rates = {
            "means": config.position_lr * self.unit,
            "quaternions": config.shape_lr,
            "log_scales": config.shape_lr,
            "opacity_logits": config.opacity_lr,
            "log_radiance": config.color_lr,
            "log_radiance_offsets": config.color_lr,
            "sh1": config.color_lr,
        }
        by_rate: dict[float, list[Tensor]] = {}
        for name, rate in rates.items():
            both = getattr(self.static, name), getattr(self.moving, name)
            by_rate.setdefault(rate, []).extend(p for p in both if p.numel())
        by_rate[config.opacity_lr].append(self.opacity_offsets)
        by_rate[config.color_lr] += [self.mixture_logits, self.background]
        groups = [
            ParamGroup(params, config.lr * rate, eps=ADAM_EPS) for rate, params in by_rate.items()
        ]
        t = self.trajectories
        poses = ParamGroup(
            [t.rotations, t.translations],
            config.lr * config.pose_lr,
            row_marks=[t.rotations_touched, t.translations_touched],
        )
        groups += [poses, *self.local.param_groups(config, self.unit)]
        if self.late_mixing is not None:
            rate = config.lr * config.late_mixing_lr
            groups.append(ParamGroup([self.late_mixing.share], rate))
        return groups

    # Relocation

    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> bool:
        """Relocate Gaussians every `relocate_every` steps, and bound the late share."""
        if self.late_mixing is not None:
            self.late_mixing.share.data.clamp_(0, 1)
        every = self.config.relocate_every
        if frame_errors is None or not every or step % every:
            return False
        self.relocate(frame_errors(RELOCATE_FRAMES), torch.Generator().manual_seed(step))
        self.find_neighbors()
        self.local.find_neighbors(self.unit)
        return True

    @torch.no_grad()
    def relocate(self, frame_errors: list[FrameError], generator: torch.Generator) -> int:
        """Move unseen Gaussians to those of most error; how many were moved.

        Static, moving and time-local ones are relocated separately, see `relocate.py`.
        """
        num_shared = len(self.static) + len(self.moving)
        scores = torch.zeros(num_shared, 2, device=self.background.device)
        local = LocalScores(len(self.local), self.background.device)
        for frame_error in frame_errors:
            of_frame, alive = self.error_scores(frame_error)
            scores += of_frame[:num_shared] / len(frame_errors)
            local.add(alive, of_frame[num_shared:])
        static, moving = scores.split([len(self.static), len(self.moving)])
        companions = [self.opacity_offsets, self.mixture_logits]
        count = relocate(self.static, static, [], generator)
        count += relocate(self.moving, moving, companions, generator)
        return count + relocate(self.local, local.mean(), [], generator)

    @torch.no_grad()
    def error_scores(self, frame_error: FrameError) -> tuple[Tensor, Tensor]:
        """Every Gaussian's weights in a frame, times the error and alone: (G, 2).

        The order is that of `cloud`, with the time-local ones `alive` (A,) that are
        returned too. Both are summed over the frame's pixels, as gradients of two
        drawn features.
        """
        knot = self.knot(frame_error.time)
        alive = self.alive(knot)
        cloud = self.cloud(knot, alive)
        features = torch.zeros(len(cloud.means), 2, device=cloud.means.device, requires_grad=True)
        with torch.enable_grad():
            maps = self.draw(frame_error.camera, cloud, [features])
            render, drawn = self.composite(maps)
            error = frame_error.error(render.radiance.detach())
            pixel_weights = torch.stack([error, torch.ones_like(error)], 1)
            (scores,) = torch.autograd.grad((drawn * pixel_weights).sum(), features)
        return scores, alive

    def shared_maxima(self) -> list[Tensor]:
        """Nothing that several processes must agree on besides gradients."""
        return []
