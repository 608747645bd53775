"""Time-local Gaussians, which model non-rigid motion as many short lives.

Each one is born at its center time, moves at a constant velocity and fades on either
side: x(t) = x + v (t - t0), opacity times exp(-(t - t0)^2 / (2 s^2)). People and cloth
are made of them; no motion is shared, so none is needed that explains an arm and a leg
(space-time Gaussians, Li et al. 2024, with straight paths). Only those alive at a time
are drawn, and only they are updated. Colors are constant: lives are short.

What belongs to one Gaussian stands in tables of four columns, as `TouchedAdam` takes
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.fields.kernels.cuda.launch import blocks_for, launch
from hdr_nsff.fields.kernels.cuda.layout import THREADS
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.cuda_backends import kernels_on
from hdr_nsff.fields.splat.gaussians import START_LOG_SCALE, START_LOGIT, to_radiance

MIN_WINDOW = 0.02  # below this share of its opacity, a Gaussian is not alive ...
MAX_AGE = math.sqrt(-2 * math.log(MIN_WINDOW))  # ... which are 2.8 durations
VELOCITY_SHARE = 0.1  # learning rate of velocities per frame relative to positions
# learning rates of shapes, lives and colors relative to those of the other Gaussians:
# alive around a few frames, they take part in few steps (hand-chosen on real clips)
RATE = 4.0
# steps between frames that a life has at least: shorter ones leave holes between
# frames, where nothing is supervised
LEAST_STEPS = 1.2
NUM_NEIGHBORS = 4  # whose velocities are compared
# scene lengths (in units of the near depth) that count as far as one frame, for
# neighbors in space and time
LENGTHS_PER_FRAME = 0.01


class TakeRows(torch.autograd.Function):
    """Rows (A, 4) of a learned table (G, 4), each taken once. Their gradients are added
    to those of the table where these lie.

    Autograd's own indexing would make a table of zeros for every gradient; few rows of
    a long clip are alive.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor) -> Tensor:
        ctx.table, ctx.rows = table, rows
        return table[rows]

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        table, rows = ctx.table, ctx.rows
        if table.grad is None:
            table.grad = torch.zeros_like(table)
        table.grad[rows] += grad
        return None, None


class KeepAbove(torch.autograd.Function):
    """Learned values, which do not learn to become smaller where they are `least` or
    less.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, least: float) -> Tensor:
        """The values as they are."""
        ctx.save_for_backward(values > least)
        return values.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """Gradients that make small values smaller, removed."""
        (above,) = ctx.saved_tensors
        return gradient.where(above | (gradient < 0), 0.0), None


def frame_step(times: Tensor) -> float:
    """The usual gap between captured `times` (T,), in frames: three of four are no
    longer. A held-out frame here and there does not count; of gaps that alternate the
    longer does.
    """
    if len(times) < 2:
        return 1.0
    gaps = times.diff().sort().values
    return float(gaps[int(0.75 * (len(gaps) - 1))])


def least_duration(times: Tensor) -> float:
    """The standard deviation of the shortest life that is learned, in frames."""
    return LEAST_STEPS * frame_step(times)


@dataclass(frozen=True)
class Living:
    """Time-local Gaussians that are alive, as rows (A, 4) of the tables."""

    means: Tensor
    velocities: Tensor
    quaternions: Tensor
    log_scales: Tensor
    colors: Tensor
    bounded: bool

    def positions(self, time: float) -> Tensor:
        """Where they are at a time: (A, 3)."""
        ages = (time - self.means[:, 3:]).detach()
        return self.means[:, :3] + ages * self.velocities[:, :3]

    def opacities(self, time: float, least: float) -> Tensor:
        """Opacities (A,) in [0, 1] at a time. Lives shorter than `least` frames do not
        learn to be shorter still.
        """
        durations = KeepAbove.apply(self.log_scales[:, 3], math.log(least)).exp()
        ages = (time - self.means[:, 3].detach()) / durations
        return (-0.5 * ages.square()).exp() * self.colors[:, 3].sigmoid()

    def radiance(self) -> Tensor:
        """Linear HDR radiance (A, 3)."""
        return to_radiance(self.colors[:, :3], self.bounded)


class LocalGaussians(nn.Module):
    """`count` (G) time-local Gaussians. Times are in frames."""

    neighbors: Tensor

    def __init__(self, count: int, bounded: bool = False) -> None:
        super().__init__()
        self.bounded = bounded
        # position at the center time in scene units, and the center time, which is not
        # learned
        self.means = nn.Parameter(torch.zeros(count, 4))
        # scene units a frame, and an unused column
        self.velocities = nn.Parameter(torch.zeros(count, 4))
        self.quaternions = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(count, 1))
        # log of standard deviations in scene units, and of the duration in frames
        self.log_scales = nn.Parameter(torch.full((count, 4), START_LOG_SCALE))
        # log radiance (or log odds) and the logit of opacity
        self.colors = nn.Parameter(torch.tensor([0.0, 0, 0, START_LOGIT]).repeat(count, 1))
        itself = torch.arange(count, dtype=torch.int32)[:, None]
        self.register_buffer("neighbors", itself.repeat(1, NUM_NEIGHBORS))
        for name in self.table_names():
            marks = torch.zeros(count, dtype=torch.uint8)
            self.register_buffer(f"{name}_touched", marks, persistent=False)

    def __len__(self) -> int:
        return len(self.means)

    @staticmethod
    def table_names() -> tuple[str, ...]:
        """The tables (G, 4) that are learned."""
        return "means", "velocities", "quaternions", "log_scales", "colors"

    def mark(self, alive: Tensor) -> None:
        """Mark the rows `alive` (A,) as the only ones that this step may change."""
        for name in self.table_names():
            getattr(self, f"{name}_touched")[alive] = 1

    @torch.no_grad()
    def copy(self, source: Tensor, target: Tensor) -> None:
        """Make the Gaussians `target` (N,) like `source` (N,), times included."""
        for name in self.table_names():
            table = getattr(self, name)
            table[target] = table[source]

    def param_groups(self, config: SplatConfig, unit: float) -> list[ParamGroup]:
        """One group for every table; `unit` is the scene's typical length."""
        rates = {
            "means": config.position_lr * unit,
            "velocities": VELOCITY_SHARE * config.position_lr * unit,
            "quaternions": RATE * config.shape_lr,
            "log_scales": RATE * config.shape_lr,
            "colors": RATE * config.color_lr,
        }
        return [
            ParamGroup(
                [getattr(self, name)],
                config.lr * rate,
                row_marks=[getattr(self, f"{name}_touched")],
            )
            for name, rate in rates.items()
        ]

    # At a time

    @torch.no_grad()
    def alive(self, time: float) -> Tensor:
        """Indices (A,) of the Gaussians that are alive at a time."""
        if not len(self):  # the host need not wait for a GPU
            return self.means.new_empty(0, dtype=torch.int64)
        if not kernels_on(self.means.device):
            centers, log_durations = self.means[:, 3], self.log_scales[:, 3]
            longest = MAX_AGE * log_durations.max().exp()
            near = ((time - centers).abs() < longest).nonzero()[:, 0]  # few of a long clip
            reach = MAX_AGE * log_durations[near].exp()
            return near[(time - centers[near]).abs() < reach]
        tables = self.means.detach().contiguous(), self.log_scales.detach().contiguous()
        alive = self.means.new_empty(len(self), dtype=torch.uint8)
        launch("living", blocks_for(len(self)), THREADS, *tables, float(time), MIN_WINDOW, alive)
        return alive.nonzero()[:, 0]

    def living(self, alive: Tensor) -> Living:
        """The Gaussians `alive` (A,), each of them once."""
        rows = {name: TakeRows.apply(getattr(self, name), alive) for name in self.table_names()}
        return Living(**rows, bounded=self.bounded)

    # Evenness of motion

    def unevenness(self, alive: Tensor, living: Living, unit: float) -> Tensor:
        """Mean square difference of the velocities of neighbors, in `unit` a frame, of
        the Gaussians `alive` (A,), which are those `living`.

        The neighbors' velocities count as given.
        """
        own = living.velocities[:, None, :3]
        others = self.velocities[self.neighbors[alive].long(), :3].detach()
        differences = (own - others) / unit
        return differences.square().sum() / max(differences.numel(), 1)

    @torch.no_grad()
    def find_neighbors(self, unit: float) -> None:
        """Find the nearest Gaussians in space and time of each one anew."""
        if len(self) <= NUM_NEIGHBORS:
            return
        scales = self.means.new_tensor([1, 1, 1, LENGTHS_PER_FRAME * unit])
        places = (self.means * scales).cpu().numpy()
        _, nearest = cKDTree(places).query(places, NUM_NEIGHBORS + 1)
        self.neighbors.copy_(torch.from_numpy(nearest[:, 1:]))  # the first is itself
