"""Dynamic radiance as 4D Gaussians in linear HDR: static ones, and moving ones on
shared trajectories. Color is the exponential of a log radiance, unbounded (a sigmoid
bounds it for the ablation); movers' changes in time, and static ones' brightens or
darkens slowly (shadows of movers).

The number of Gaussians is fixed by the settings; ones that fade away draw nothing and
cost next to nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from hdr_nsff.core.tensors import tree_map
from hdr_nsff.fields.base import FrameError, GaussianCloud, Render, Warp
from hdr_nsff.fields.knots import interpolate_linear, knot_of
from hdr_nsff.fields.splat.gaussians import Gaussians, brightened, to_radiance
from hdr_nsff.fields.splat.rasterize import Maps, rasterize
from hdr_nsff.fields.splat.relocate import relocate
from hdr_nsff.fields.splat.trajectories import Trajectories
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch

NUM_NEIGHBORS = 4  # neighbors of a moving Gaussian
GLOSSIEST = 2.0  # log radiance may change by this much with the direction
RELOCATE_FRAMES = 24  # training frames that say what is wrong and what is seen
FAINTEST = 0.003  # opacity below which a Gaussian draws nothing


@dataclass(frozen=True)
class SplatConfig:
    """A field of 4D Gaussians."""

    static: int | None = None
    """Static Gaussians; default: 0.55 for every pixel of a frame, at most 80,000."""
    moving: int | None = None
    """Moving Gaussians; default: 0.15 for every pixel of a frame, at most 20,000."""
    bases: int = 6
    """Shared rigid motions that the moving ones mix."""
    color_knots: int = 7
    """Times at which a moving Gaussian has a color of its own."""
    brightness_knots: int = 5
    """Times at which a static Gaussian has a brightness of its own (1: none)."""
    opacity_knots: int = 13
    """Times at which a moving Gaussian has an opacity of its own: things come and go.
    """
    view_dependence: bool = False
    """Colors change with the direction of view (to first order, in log radiance): for
    shiny things seen from many sides.
    """
    radiance: Literal["exp", "sigmoid"] = "exp"
    """Unbounded radiance, or one below 1."""
    relocate_every: int = 200
    """Steps after which Gaussians that nobody sees are put where the picture is wrong
    (0: never).
    """
    lr: float = 1.0
    """Multiplies all learning rates below."""
    position_lr: float = 2e-3
    """Of positions, per typical scale of the scene (its near depth)."""
    pose_lr: float = 2e-3
    color_lr: float = 2e-2
    shape_lr: float = 2e-2
    opacity_lr: float = 5e-2

    def counts(self, num_pixels: int) -> tuple[int, int]:
        """How many static and moving Gaussians for frames of `num_pixels`."""
        static = min(round(0.55 * num_pixels), 80_000) if self.static is None else self.static
        moving = min(round(0.15 * num_pixels), 20_000) if self.moving is None else self.moving
        return static, moving


class Splat(nn.Module):
    """See the module. `times` (T,) are the training times; `near` is the scene's
    typical length; frames have `num_pixels`.
    """

    times: Tensor
    background: Tensor
    neighbors: Tensor

    def __init__(
        self, config: SplatConfig, times: Tensor, near: float, far: float, num_pixels: int
    ) -> None:
        super().__init__()
        self.config, self.unit, self.near, self.far = config, near, near, far
        self.register_buffer("times", times.double())
        static, moving = config.counts(num_pixels)
        self.bounded = config.radiance == "sigmoid"
        self.static = Gaussians(
            static, config.brightness_knots, 1, config.view_dependence, self.bounded
        )
        self.moving = Gaussians(moving, config.color_knots, 3, config.view_dependence, self.bounded)
        self.opacity_offsets = nn.Parameter(
            torch.zeros(config.opacity_knots, moving)
        )  # offsets to the moving ones' opacity logits
        self.mixture_logits = nn.Parameter(torch.zeros(config.bases, moving))
        self.trajectories = Trajectories(config.bases, len(times))
        self.register_buffer(
            "neighbors", torch.arange(moving, dtype=torch.int32)[:, None].repeat(1, NUM_NEIGHBORS)
        )  # (M, NUM_NEIGHBORS) neighbors
        self.background = nn.Parameter(
            torch.zeros(3)
        )  # log radiance (or log odds) where no Gaussian is

    def knot(self, time: float) -> float:
        """Position of a time (in frames) on the list of training times."""
        return knot_of(self.times, time)

    def share(self, knot: float) -> float:
        """A knot as a share of the clip."""
        return knot / max(len(self.times) - 1, 1)

    def cloud(self, knot: float) -> GaussianCloud:
        """All Gaussians at a knot, static ones first, differentiable in everything."""
        mixture, share = self.mixture_logits.softmax(0), self.share(knot)
        still, moving = self.static, self.moving
        pose = self.trajectories.pose(knot)
        moved = self.trajectories.move(moving.means, mixture, pose)
        turned = self.trajectories.turn(moving.quaternions, mixture, pose)
        return GaussianCloud(
            torch.cat([still.means, moved]),
            torch.cat([still.quaternions, turned]),
            torch.cat([still.log_scales, moving.log_scales]).exp(),
            self.opacities(share),
            torch.cat([still.radiance(share), moving.radiance(share)]),
            torch.cat([still.means.new_zeros(len(still)), still.means.new_ones(len(moving))]),
        )

    def draw(self, camera: Camera, cloud: GaussianCloud, extra: list[Tensor]) -> Maps:
        """Rasterize radiance (3), motion (1) and `extra` features (G, ...)."""
        radiance = cloud.radiance
        if self.config.view_dependence:
            radiance = brightened(radiance, self.gloss(camera, cloud.means), self.bounded)
        features = torch.cat([radiance, cloud.motion[:, None], *extra], 1)
        return rasterize(
            cloud.means, cloud.quaternions, cloud.scales, cloud.opacities, features, camera
        )

    def gloss(self, camera: Camera, means: Tensor) -> Tensor:
        """What the directions in which `camera` sees the `means` (G, 3) add to log
        radiance, (G, 3): spherical harmonics of degree 1.
        """
        toward = nn.functional.normalize(means - camera.c2w[:, 3], dim=-1)
        sh1 = torch.cat([self.static.sh1, self.moving.sh1])
        return (sh1 @ toward[..., None])[..., 0].clamp(-GLOSSIEST, GLOSSIEST)

    def opacities(self, share: float) -> Tensor:
        """(G,) in [0, 1] at a share of the clip."""
        present = interpolate_linear(self.opacity_offsets, share * (len(self.opacity_offsets) - 1))
        return torch.cat([self.static.logits, self.moving.logits + present]).sigmoid()

    def positions(self, knot: float) -> Tensor:
        """Means (G, 3) of all Gaussians at a knot."""
        mixture = self.mixture_logits.softmax(0)
        moved = self.trajectories.move(self.moving.means, mixture, self.trajectories.pose(knot))
        return torch.cat([self.static.means, moved])

    @torch.no_grad()
    def gaussians(self, time: float) -> GaussianCloud:
        """All that draw anything, static ones first, at `time` in frames: what `render`
        composites over the background.
        """
        cloud = self.cloud(self.knot(time))
        return tree_map(lambda t: t[cloud.opacities > FAINTEST], cloud)

    def composed(self, maps: Maps) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Radiance (S, 3) over the background, z-depth (S,), opacity (S,), motion (S,)
        and what else was drawn (S, ...).
        """
        alpha = maps.alpha.reshape(-1)
        seen, motion, extra = maps.features.flatten(0, 1).split(
            [3, 1, maps.features.shape[-1] - 4], 1
        )
        radiance = torch.addcmul(
            seen, (1 - alpha)[:, None], to_radiance(self.background, self.bounded)
        )  # lies in memory like `seen`
        depth = maps.depth.reshape(-1) / alpha.clamp_min(1e-3)
        depth = torch.where(alpha > 1e-3, depth, self.far)
        return radiance, depth.clamp_min(1e-3 * self.unit), alpha, motion[:, 0], extra

    @torch.no_grad()
    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        """Every pixel of `camera` (row by row) or the ones `pixels` (S, 2) lie in, at
        `time` in frames, without gradients. Scene flow is the displacement to one
        training interval later and earlier; at the clip's ends it goes straight on.
        """
        knot = self.knot(time)
        cloud = self.cloud(knot)
        maps = self.draw(camera, cloud, self.steps(cloud.means, knot) if scene_flow else [])
        radiance, depth, opacity, motion, moved = self.composed(maps)
        flows = {1: moved[:, :3], -1: moved[:, 3:]} if scene_flow else {}
        render = Render(radiance, depth.clamp(self.near, self.far), opacity, motion, flows)
        return render if pixels is None else picked(render, camera, pixels)

    def steps(self, means: Tensor, knot: float) -> list[Tensor]:
        """From `means` (G, 3) at a knot to those one training interval later and
        earlier: two (G, 3).
        """
        steps = [torch.zeros_like(means), torch.zeros_like(means)]
        for i, o in enumerate((1, -1)):
            inside = 0 <= knot + o <= len(self.times) - 1
            if inside or 0 <= knot - o <= len(self.times) - 1:
                steps[i] = (
                    self.positions(knot + o) - means if inside else means - self.positions(knot - o)
                )
        return steps

    def forward(self, batch: PixelBatch) -> tuple[Render, dict[str, Tensor]]:
        """A training render of the whole frame, read off at the batch's pixels;
        regularizers. Two dear things take turns, at random: flow to one of the
        neighbors, as a warp, and rigidity.
        """
        knot = self.knot(batch.time)
        sides = [o for o in batch.neighbors if o in batch.flow]
        side, flow_turn = batch.seed // 2 % max(len(sides), 1), batch.seed % 2 == 0
        wanted = sides[side : side + 1] if flow_turn else []
        cloud = self.cloud(knot)
        flows = [self.displacements(batch, cloud.means, knot, o) for o in wanted]
        maps = self.draw(batch.camera, cloud, flows)
        radiance, depth, opacity, motion, moved = self.composed(maps)
        moved = moved / opacity.clamp_min(1e-3)[:, None]
        warps = tuple(
            Warp(o, moved[:, 2 * i : 2 * i + 2], torch.ones_like(opacity), None)
            for i, o in enumerate(wanted)
        )
        render = Render(radiance, depth, opacity, motion, {}, warps)
        self.trajectories.mark(knot)
        own = self.regularizers(cloud, knot) | ({} if flow_turn else {"rigidity": self.rigidity()})
        return picked(render, batch.camera, batch.pixels), own

    def displacements(self, batch: PixelBatch, means: Tensor, knot: float, offset: int) -> Tensor:
        """Pixels (G, 2) from where the batch's camera sees each Gaussian's mean (G, 3)
        to where the neighbor sees it at its time.
        """
        there = self.positions(min(max(knot + offset, 0), len(self.times) - 1))
        camera, neighbor, limit = batch.camera, batch.neighbors[offset], 2.0 * batch.camera.width
        return (neighbor.project(there)[0] - camera.project(means)[0]).clamp(-limit, limit)

    def regularizers(self, cloud: GaussianCloud, knot: float) -> dict[str, Tensor]:
        """Terms of the field's own: opacities and scales (Kheradmand et al. 2024) of
        the `cloud` at `knot`, smooth poses, slow colors.
        """
        still, moving = self.static, self.moving
        alive = cloud.opacities.detach() > FAINTEST
        terms = {
            "opacity": (cloud.opacities * alive).mean(),
            "scale": (cloud.scales * alive[:, None]).mean() / self.unit,
            "trajectory": self.trajectories.roughness(knot, self.unit),
            "brightness_drift": mean_square(still.offsets),
            "opacity_offsets": mean_square(self.opacity_offsets.diff(dim=0)),
            "color_change": mean_square(moving.offsets.diff(dim=0))
            + 0.01 * mean_square(moving.offsets),
        }
        return terms | (
            {"sh1": mean_square(still.sh1) + mean_square(moving.sh1)}
            if self.config.view_dependence
            else {}
        )

    def rigidity(self) -> Tensor:
        """Mean square difference of the mixtures of neighboring moving Gaussians: those
        that mix alike keep their distances.
        """
        mixture = self.mixture_logits.softmax(0)
        return mean_square(
            mixture[:, self.neighbors.long().flatten()]
            - mixture.repeat_interleave(self.neighbors.shape[1], 1)
        )

    @torch.no_grad()
    def find_neighbors(self) -> None:
        """Find out anew which moving Gaussians lie neighbors each other."""
        if len(self.moving) > NUM_NEIGHBORS:
            places = self.moving.means.cpu().numpy()
            self.neighbors.copy_(
                torch.from_numpy(cKDTree(places).query(places, NUM_NEIGHBORS + 1)[1][:, 1:])
            )

    def param_groups(self) -> list[dict[str, Any]]:
        """One group for every learning rate, as an optimizer works group by group; only
        the poses near the drawn frame move.
        """
        c, both = self.config, (self.static, self.moving)
        rates = {
            "means": c.position_lr * self.unit, "quaternions": c.shape_lr, "log_scales": c.shape_lr, "logits": c.opacity_lr,
            "log_radiance": c.color_lr, "offsets": c.color_lr, "sh1": c.color_lr,
        }  # fmt: skip
        at_rate: dict[float, list[Tensor]] = {}
        for name, rate in rates.items():
            at_rate.setdefault(rate, []).extend(
                p for p in (getattr(g, name) for g in both) if p.numel()
            )
        at_rate[c.opacity_lr].append(self.opacity_offsets)
        at_rate[c.color_lr] += [self.mixture_logits, self.background]
        groups: list[dict[str, Any]] = [
            {"params": p, "lr": c.lr * rate, "eps": 1e-15} for rate, p in at_rate.items()
        ]
        t = self.trajectories
        touched = [t.turns_touched, t.shifts_touched]
        groups.append({"params": [t.turns, t.shifts], "lr": c.lr * c.pose_lr, "touched": touched})
        return groups

    @torch.no_grad()
    def relocate(self, frame_errors: list[FrameError], generator: torch.Generator) -> int:
        """Put unseen Gaussians neighbors those with most error in their pixels, static
        and moving ones apart; how many.
        """
        told = torch.stack([self.error_scores(m) for m in frame_errors]).mean(0)
        still, moving = told.split([len(self.static), len(self.moving)])
        return relocate(self.static, still, [], generator) + relocate(
            self.moving, moving, [self.opacity_offsets, self.mixture_logits], generator
        )

    @torch.no_grad()
    def error_scores(self, frame_error: FrameError) -> Tensor:
        """(G, 2): the weights of every Gaussian summed over the pixels of a frame,
        times their error and alone: the gradients of two features.
        """
        cloud = self.cloud(self.knot(frame_error.time))
        told = torch.zeros(len(cloud.means), 2, device=cloud.means.device, requires_grad=True)
        with torch.enable_grad():
            radiance, _, _, _, drawn = self.composed(self.draw(frame_error.camera, cloud, [told]))
            error = frame_error.error(radiance.detach())
            return torch.autograd.grad(
                (drawn * torch.stack([error, torch.ones_like(error)], 1)).sum(), told
            )[0]

    def after_step(self, step: int, frame_errors: Callable[[int], list[FrameError]] | None) -> None:
        """Now and then, Gaussians that nobody sees go where the picture is wrong."""
        if (
            frame_errors is not None
            and self.config.relocate_every
            and step % self.config.relocate_every == 0
        ):
            self.relocate(frame_errors(RELOCATE_FRAMES), torch.Generator().manual_seed(step))
            self.find_neighbors()

    def shared_maxima(self) -> list[Tensor]:
        """Nothing that several processes must agree on besides gradients."""
        return []


def mean_square(values: Tensor) -> Tensor:
    """Mean of the squares; 0 of nothing."""
    return values.square().sum() / max(values.numel(), 1)


def picked(render: Render, camera: Camera, pixels: Tensor) -> Render:
    """The render at the pixels (S, 2) alone; the whole frame in order stays as it is."""
    index = pixels[:, 1].long() * camera.width + pixels[:, 0].long()
    if len(index) == camera.width * camera.height and bool((index.diff() == 1).all()):
        return render
    warps = tuple(Warp(w.offset, w.flow[index], w.confidence[index], None) for w in render.warps)
    flow = {o: f[index] for o, f in render.scene_flow.items()}
    return Render(
        render.radiance[index],
        render.depth[index],
        render.opacity[index],
        render.motion[index],
        flow,
        warps,
    )
