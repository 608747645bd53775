"""Dynamic radiance as 4D Gaussians in linear HDR: static ones, and moving ones on
shared trajectories.

Color is the exponential of a log radiance, unbounded (a sigmoid bounds it for the
ablation). Colors of moving Gaussians change in time, and static ones brighten or darken
slowly (shadows of movers). The number of Gaussians is fixed by the settings; ones that
fade away draw nothing and cost next to nothing. docs/method.md, section "4D Gaussians".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le
from scipy.spatial import cKDTree
from torch import Tensor, nn

from hdr_nsff.core.settings import Advanced, Count, Number, Rate, Weight
from hdr_nsff.core.tensors import tree_map
from hdr_nsff.fields.base import FrameError, ParamGroup, Render, Warp
from hdr_nsff.fields.knots import interpolate_linear, knot_of
from hdr_nsff.fields.outputs import GaussianCloud, select_pixels
from hdr_nsff.fields.splat.gaussians import Gaussians, scale_radiance, to_radiance
from hdr_nsff.fields.splat.rasterize import Maps, rasterize
from hdr_nsff.fields.splat.relocate import relocate
from hdr_nsff.fields.splat.trajectories import Trajectories
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch

# default number of Gaussians, per pixel of a frame and at most (hand-chosen on rendered
# scenes, for minutes of training on a CPU)
STATIC_PER_PIXEL, MAX_STATIC = 0.55, 80_000
MOVING_PER_PIXEL, MAX_MOVING = 0.15, 20_000
NUM_NEIGHBORS = 4  # of a moving Gaussian, for rigidity
MAX_VIEW_LOG_FACTOR = 2.0  # by which log radiance may change with the direction of view
RELOCATE_FRAMES = 24  # training frames whose errors decide what is relocated
MIN_OPACITY = 0.003  # below, a Gaussian draws nothing: less than ALPHA_MIN = 1/255
MIN_ALPHA = 1e-3  # of a pixel: below, it has no depth of its own
MIN_DEPTH_SHARE = 1e-3  # of `near`: the least z-depth that a pixel gets
MAX_FLOW = 2.0  # picture widths: keeps the flow of Gaussians near the camera finite
COLOR_OFFSET_SHARE = 0.01  # weight of color offsets relative to their changes in time
ADAM_EPS = 1e-15  # as 3D Gaussian splatting has it (Kerbl et al. 2023)


@dataclass(frozen=True)
class SplatLosses:
    """Weights of the field's own terms; 0 turns one off."""

    opacity: Weight = 0.01
    """Mean opacity: what is not needed fades and is used elsewhere."""
    scale: Weight = 0.01
    """Mean scale, in units of the near depth."""
    trajectory: Weight = 30.0
    """Third differences of the shared motions, in units of the near depth."""
    brightness_drift: Weight = 0.01
    """Changes of static Gaussians' log radiance in time."""
    opacity_offsets: Weight = 1e-3
    """Changes of moving Gaussians' opacity from one knot to the next."""
    color_change: Weight = 0.01
    """Changes of moving Gaussians' log radiance from one knot to the next."""
    rigidity: Weight = 2.0
    """Differences in how neighboring moving Gaussians mix the shared motions."""
    sh1: Weight = 0.01
    """Changes of log radiance with the direction of view."""


@dataclass(frozen=True)
class SplatConfig:
    """A field of 4D Gaussians."""

    type: Advanced[Literal["splat"]] = "splat"
    loss: Advanced[SplatLosses] = field(default_factory=SplatLosses)
    static: Annotated[int, Ge(1), Le(10**8)] | None = None
    """Static Gaussians; default: 0.55 for every pixel of a frame, at most 80,000."""
    moving: Annotated[int, Ge(0), Le(10**8)] | None = None
    """Moving Gaussians; default: 0.15 for every pixel of a frame, at most 20,000."""
    bases: Count = 6
    """Shared rigid motions that the moving ones mix."""
    color_knots: Advanced[Count] = 7
    """Times at which a moving Gaussian has a color of its own."""
    brightness_knots: Advanced[Count] = 5
    """Times at which a static Gaussian has a brightness of its own (1: none)."""
    opacity_knots: Advanced[Count] = 13
    """Times at which a moving Gaussian has an opacity of its own, to appear and vanish.
    """
    view_dependence: bool = False
    """Let colors change with the direction of view (to first order, in log radiance),
    for shiny objects seen from many sides.
    """
    radiance: Literal["exp", "sigmoid"] = "exp"
    """Unbounded radiance, or one below 1."""
    relocate_every: Advanced[Number] = 200
    """Steps after which unseen Gaussians are moved to where the picture is wrong (0:
    never).
    """
    lr: Advanced[Rate] = 1.0
    """Multiplies all learning rates below."""
    position_lr: Advanced[Rate] = 2e-3
    """Learning rate of positions, per typical length of the scene (its near depth)."""
    pose_lr: Advanced[Rate] = 2e-3
    """Learning rate of the shared motions."""
    color_lr: Advanced[Rate] = 2e-2
    """Learning rate of colors and of the mixtures of motions."""
    shape_lr: Advanced[Rate] = 2e-2
    """Learning rate of orientations and log scales."""
    opacity_lr: Advanced[Rate] = 5e-2
    """Learning rate of opacities."""

    def counts(self, num_pixels: int) -> tuple[int, int]:
        """How many static and moving Gaussians, for frames of `num_pixels`."""
        static, moving = self.static, self.moving
        if static is None:
            static = min(round(STATIC_PER_PIXEL * num_pixels), MAX_STATIC)
        if moving is None:
            moving = min(round(MOVING_PER_PIXEL * num_pixels), MAX_MOVING)
        return static, moving


class Splat(nn.Module):
    """A field of 4D Gaussians.

    `times` (T,) are the training times; `near` and `far` are z-depths in scene units,
    and `near` is the scene's typical length; frames have `num_pixels`.
    """

    times: Tensor
    neighbors: Tensor

    def __init__(
        self, config: SplatConfig, times: Tensor, near: float, far: float, num_pixels: int
    ) -> None:
        super().__init__()
        self.config, self.unit = config, near
        self.near, self.far = near, far
        self.register_buffer("times", times.double())
        static, moving = config.counts(num_pixels)
        self.bounded = config.radiance == "sigmoid"
        views, bounded = config.view_dependence, self.bounded
        self.static = Gaussians(static, config.brightness_knots, 1, views, bounded)
        self.moving = Gaussians(moving, config.color_knots, 3, views, bounded)
        # added to the moving ones' opacity logits
        self.opacity_offsets = nn.Parameter(torch.zeros(config.opacity_knots, moving))
        self.mixture_logits = nn.Parameter(torch.zeros(config.bases, moving))
        self.trajectories = Trajectories(config.bases, len(times))
        itself = torch.arange(moving, dtype=torch.int32)[:, None]
        self.register_buffer("neighbors", itself.repeat(1, NUM_NEIGHBORS))  # of moving ones
        # log radiance (or log odds) where no Gaussian is
        self.background = nn.Parameter(torch.zeros(3))

    # Time

    def knot(self, time: float) -> float:
        """Position of a time (in frames) on the list of training times."""
        return knot_of(self.times, time)

    def share(self, knot: float) -> float:
        """A knot as a share in [0, 1] of the clip."""
        return knot / max(len(self.times) - 1, 1)

    def has_knot(self, knot: float) -> bool:
        """Whether a knot lies within the clip."""
        return 0 <= knot <= len(self.times) - 1

    # The Gaussians at a time

    def cloud(self, knot: float) -> GaussianCloud:
        """All Gaussians at a knot, static ones first, differentiable in everything."""
        mixture, share = self.mixture_logits.softmax(0), self.share(knot)
        static, moving = self.static, self.moving
        pose = self.trajectories.pose(knot)
        moved = self.trajectories.move(moving.means, mixture, pose)
        turned = self.trajectories.turn(moving.quaternions, mixture, pose)
        at_rest = static.means.new_zeros(len(static))
        return GaussianCloud(
            means=torch.cat([static.means, moved]),
            quaternions=torch.cat([static.quaternions, turned]),
            scales=torch.cat([static.log_scales, moving.log_scales]).exp(),
            opacities=self.opacities(share),
            radiance=torch.cat([static.radiance(share), moving.radiance(share)]),
            motion=torch.cat([at_rest, static.means.new_ones(len(moving))]),
        )

    def opacities(self, share: float) -> Tensor:
        """Opacities (G,) in [0, 1] at a share of the clip."""
        position = share * (len(self.opacity_offsets) - 1)
        offsets = interpolate_linear(self.opacity_offsets, position)
        return torch.cat(
            [self.static.opacity_logits, self.moving.opacity_logits + offsets]
        ).sigmoid()

    def positions(self, knot: float) -> Tensor:
        """Means (G, 3) of all Gaussians at a knot."""
        mixture = self.mixture_logits.softmax(0)
        pose = self.trajectories.pose(knot)
        moved = self.trajectories.move(self.moving.means, mixture, pose)
        return torch.cat([self.static.means, moved])

    @torch.no_grad()
    def gaussians(self, time: float) -> GaussianCloud:
        """The Gaussians that draw anything at `time` in frames, static ones first.

        They are what `render` composites over the background.
        """
        cloud = self.cloud(self.knot(time))
        visible = cloud.opacities > MIN_OPACITY
        return tree_map(lambda t: t[visible], cloud)

    # Drawing them

    def draw(self, camera: Camera, cloud: GaussianCloud, extra: list[Tensor]) -> Maps:
        """Rasterize radiance (3), motion (1) and `extra` features (G, ...)."""
        radiance = cloud.radiance
        if self.config.view_dependence:
            log_factor = self.view_log_factor(camera, cloud.means)
            radiance = scale_radiance(radiance, log_factor, self.bounded)
        features = torch.cat([radiance, cloud.motion[:, None], *extra], 1)
        return rasterize(
            cloud.means, cloud.quaternions, cloud.scales, cloud.opacities, features, camera
        )

    def view_log_factor(self, camera: Camera, means: Tensor) -> Tensor:
        """Change (G, 3) of log radiance with the direction in which `camera` sees.

        The directions are those to the `means` (G, 3): spherical harmonics of degree 1.
        """
        directions = nn.functional.normalize(means - camera.c2w[:, 3], dim=-1)
        sh1 = torch.cat([self.static.sh1, self.moving.sh1])
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
        cloud = self.cloud(knot)
        offsets = (1, -1) if scene_flow else ()
        steps = [self.displacement(cloud.means, knot, o) for o in offsets]
        render, drawn = self.composite(self.draw(camera, cloud, steps))
        flow = {o: drawn[:, 3 * i : 3 * i + 3] for i, o in enumerate(offsets)}
        depth = render.depth.clamp(self.near, self.far)
        render = replace(render, depth=depth, scene_flow=flow)
        return render if pixels is None else select_pixels(render, camera, pixels)

    def displacement(self, means: Tensor, knot: float, offset: int) -> Tensor:
        """From `means` (G, 3) at a knot to the means one training interval away.

        `offset` is +1 (later) or -1 (earlier). Beyond the clip's ends, the displacement
        of the other direction is continued.
        """
        if self.has_knot(knot + offset):
            return self.positions(knot + offset) - means
        if self.has_knot(knot - offset):
            return means - self.positions(knot - offset)
        return torch.zeros_like(means)

    # Training

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A training render of the whole frame at the batch's pixels, and regularizers.

        Two expensive terms take turns, by the batch's seed: flow to one of the
        neighbors, as a warp, and rigidity.
        """
        knot = self.knot(batch.time)
        flow_turn = batch.seed % 2 == 0
        offsets = self.choose_neighbor(batch) if flow_turn else []
        cloud = self.cloud(knot)
        flows = [self.flow_to_neighbor(batch, cloud.means, knot, o) for o in offsets]
        render, drawn = self.composite(self.draw(batch.camera, cloud, flows))
        # features are premultiplied by opacity
        flow = drawn / render.opacity.clamp_min(MIN_ALPHA)[:, None]
        certain = torch.ones_like(render.opacity)
        warps = tuple(Warp(o, flow, certain, None) for o in offsets)
        render = replace(render, warps=warps)
        self.trajectories.mark(knot)
        terms = self.regularizers(cloud, knot)
        if not flow_turn:
            terms["rigidity"] = self.rigidity()
        return select_pixels(render, batch.camera, batch.pixels), terms

    @staticmethod
    def choose_neighbor(batch: PixelBatch) -> list[int]:
        """The offset of the one neighbor with known flow whose turn it is, if any."""
        offsets = [o for o in batch.neighbors if o in batch.flow]
        turn = batch.seed // 2 % max(len(offsets), 1)
        return offsets[turn : turn + 1]

    def flow_to_neighbor(
        self, batch: PixelBatch, means: Tensor, knot: float, offset: int
    ) -> Tensor:
        """Optical flow (G, 2) in pixels, from the batch's camera to a neighboring one.

        From where the camera sees each Gaussian's mean (G, 3) to where the neighbor
        sees it at its own time.
        """
        last_knot = len(self.times) - 1
        moved = self.positions(min(max(knot + offset, 0), last_knot))
        camera, neighbor = batch.camera, batch.neighbors[offset]
        limit = MAX_FLOW * camera.width
        return (neighbor.project(moved)[0] - camera.project(means)[0]).clamp(-limit, limit)

    def regularizers(self, cloud: GaussianCloud, knot: float) -> dict[str, Tensor]:
        """The field's own terms of the `cloud` at `knot`, by their `LossWeights` names.

        Mean opacity and scale keep Gaussians few and small (3DGS-MCMC, Kheradmand et
        al. 2024); the others keep poses smooth and changes in time small.
        """
        static, moving = self.static, self.moving
        visible = cloud.opacities.detach() > MIN_OPACITY
        color_change = mean_square(moving.log_radiance_offsets.diff(dim=0))
        color_offset = mean_square(moving.log_radiance_offsets)
        terms = {
            "opacity": (cloud.opacities * visible).mean(),
            "scale": (cloud.scales * visible[:, None]).mean() / self.unit,
            "trajectory": self.trajectories.roughness(knot, self.unit),
            "brightness_drift": mean_square(static.log_radiance_offsets),
            "opacity_offsets": mean_square(self.opacity_offsets.diff(dim=0)),
            "color_change": color_change + COLOR_OFFSET_SHARE * color_offset,
        }
        if self.config.view_dependence:
            terms["sh1"] = mean_square(static.sh1) + mean_square(moving.sh1)
        return terms

    def rigidity(self) -> Tensor:
        """Mean square difference of the mixtures of neighboring moving Gaussians.

        Gaussians with the same mixture of motions keep their distances.
        """
        mixture = self.mixture_logits.softmax(0)  # (B, M)
        of_neighbors = mixture[:, self.neighbors.long().flatten()]
        own = mixture.repeat_interleave(self.neighbors.shape[1], 1)
        return mean_square(of_neighbors - own)

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
        return [*groups, poses]

    # Relocation

    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> None:
        """Relocate Gaussians every `relocate_every` steps."""
        every = self.config.relocate_every
        if frame_errors is None or not every or step % every:
            return
        self.relocate(frame_errors(RELOCATE_FRAMES), torch.Generator().manual_seed(step))
        self.find_neighbors()

    @torch.no_grad()
    def relocate(self, frame_errors: list[FrameError], generator: torch.Generator) -> int:
        """Move unseen Gaussians to those of most error; how many were moved.

        Static and moving ones are relocated separately, see `relocate.py`.
        """
        scores = torch.stack([self.error_scores(e) for e in frame_errors]).mean(0)
        static, moving = scores.split([len(self.static), len(self.moving)])
        companions = [self.opacity_offsets, self.mixture_logits]
        count = relocate(self.static, static, [], generator)
        return count + relocate(self.moving, moving, companions, generator)

    @torch.no_grad()
    def error_scores(self, frame_error: FrameError) -> Tensor:
        """Every Gaussian's weights in a frame, times the error and alone: (G, 2).

        Both are summed over the frame's pixels, as gradients of two drawn features.
        """
        cloud = self.cloud(self.knot(frame_error.time))
        features = torch.zeros(len(cloud.means), 2, device=cloud.means.device, requires_grad=True)
        with torch.enable_grad():
            maps = self.draw(frame_error.camera, cloud, [features])
            render, drawn = self.composite(maps)
            error = frame_error.error(render.radiance.detach())
            pixel_weights = torch.stack([error, torch.ones_like(error)], 1)
            (scores,) = torch.autograd.grad((drawn * pixel_weights).sum(), features)
        return scores

    def shared_maxima(self) -> list[Tensor]:
        """Nothing that several processes must agree on besides gradients."""
        return []


def mean_square(values: Tensor) -> Tensor:
    """Mean of the squares; 0 of no values."""
    return values.square().sum() / max(values.numel(), 1)
