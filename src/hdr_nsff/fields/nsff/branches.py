"""The two ways to store a field's branches: additive grids (ours) and the published
network. Both answer with raw numbers; `nsff.py` turns them into radiance, density and
flow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from hdr_nsff.fields.nsff.encodings import AdditiveGrid, Shape, frequencies

APPEARANCE = 5  # raw radiance (3), raw density, raw blend share (read from the dynamic branch)
MOTION = 8  # raw scene flow forward (3), raw disocclusion forward, the same backward


@dataclass(frozen=True)
class GridConfig:
    """Additive multiresolution grids without a network behind them."""

    finest: float = 1.0
    """Finest cell across the image, in pixels of the training frames."""
    depth_cells: int = 96
    """Grid points along the third axis at the finest level."""
    levels: int = 4
    """Levels of the appearance grids, each twice as fine as the one before."""
    max_rows: int = 2**20
    """Rows of a hashed level (a power of two)."""
    motion_cell: float = 8.0
    """BenchRun of the finer of the two scene-flow grids, in pixels: scene flow is
    smooth by construction.
    """
    lr: float = 0.1
    motion_lr: float = 0.01


@dataclass(frozen=True)
class MlpConfig:
    """The published network (METHOD.md 2): `layers` x `width`, skip, position encoding,
    a view-dependent head.
    """

    layers: int = 8
    width: int = 256
    skip_after: int = 5
    octaves: int = 10
    direction_octaves: int = 4
    lr: float = 5e-4


class Branches(Protocol):
    """Static and dynamic branch of a field, in cube coordinates."""

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        """Raw radiance (3), density and an unused fifth number: (M, 5), at `coords` (M,
        3) in [0, 1], unit view `directions` (M, 3).
        """
        ...

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        """Raw radiance (3), density, blend share: (M, 5) at time `knot`; with `motion`
        also raw motion (M, 8).
        """
        ...

    def param_groups(self) -> list[dict[str, Any]]:
        """Parameter groups with learning rates; `touched` (row marks) comes with tables
        of which only marked rows should move.
        """
        ...


def pyramid(finest: tuple[float, float, float], levels: int, slices: int) -> list[Shape]:
    """Grid shapes from coarse to fine, each level half of the next."""
    x, y, z = finest
    size = [2**k for k in reversed(range(levels))]
    return [
        (max(4, round(x / s)), max(4, round(y / s)), max(4, round(z / s)), slices) for s in size
    ]


class GridBranches(nn.Module):
    """Grids in the space of the cube; every training time has its own slice of the
    dynamic ones.
    """

    def __init__(self, config: GridConfig, width: int, height: int, num_knots: int) -> None:
        super().__init__()
        self.config = config
        fine = (width / config.finest, height / config.finest, float(config.depth_cells))
        coarse = (width / config.motion_cell, height / config.motion_cell, config.depth_cells / 8)
        self.static_grid = AdditiveGrid(pyramid(fine, config.levels, 1), 1, config.max_rows)
        self.dynamic_grid = AdditiveGrid(
            pyramid(fine, config.levels, num_knots), num_knots, config.max_rows
        )
        self.motion_grids = nn.ModuleList(
            AdditiveGrid(pyramid(coarse, 2, num_knots), num_knots, config.max_rows)
            for _ in range(2)
        )

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        return nn.functional.pad(self.static_grid(coords), (0, 1))

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        appearance = nn.functional.pad(self.dynamic_grid(coords, knot), (0, 1))
        return appearance, torch.cat(
            [g(coords, knot) for g in self.motion_grids], -1
        ) if motion else None

    def param_groups(self) -> list[dict[str, Any]]:
        c = self.config
        appearance, motion = [self.static_grid, self.dynamic_grid], list(self.motion_grids)
        return [
            {"params": [g.table for g in grids], "touched": [g.touched for g in grids], "lr": lr}
            for grids, lr in ((appearance, c.lr), (motion, c.motion_lr))
        ]


class Trunk(nn.Module):
    """`layers` x `width` ReLU layers with one skip, a density head and a view-dependent
    radiance head, which may know a code of `code_size` numbers besides: they come
    behind the directions.
    """

    def __init__(self, config: MlpConfig, dims: int, extra: int, code_size: int = 0) -> None:
        super().__init__()
        self.config = config
        inputs = dims * (1 + 2 * config.octaves)
        sizes = [inputs] + [
            config.width + (inputs if i == config.skip_after else 0)
            for i in range(1, config.layers)
        ]
        self.hidden = nn.ModuleList(nn.Linear(n, config.width) for n in sizes)
        self.extra = nn.Linear(
            config.width, 1 + extra
        )  # density, then whatever else depends on position alone
        self.feature = nn.Linear(config.width, config.width)
        self.view = nn.Linear(
            config.width + 3 * (1 + 2 * config.direction_octaves) + code_size, config.width // 2
        )
        self.radiance = nn.Linear(config.width // 2, 3)

    def forward(self, position: Tensor, directions: Tensor) -> Tensor:
        """Raw radiance (3), density and the extra outputs: (M, 4 + extra)."""
        encoded = frequencies(position, self.config.octaves)
        h = encoded
        for i, layer in enumerate(self.hidden):
            h = torch.cat([encoded, h], -1) if i == self.config.skip_after else h
            h = layer(h).relu()
        views = frequencies(directions[:, :3], self.config.direction_octaves)
        viewed = torch.cat([self.feature(h), views, directions[:, 3:]], -1)
        return torch.cat([self.radiance(self.view(viewed).relu()), self.extra(h)], -1)


class MlpBranches(nn.Module):
    """The published pair of networks; time is a fourth input in [0, 1], space is the
    cube scaled to [-1, 1].
    """

    def __init__(self, config: MlpConfig, num_knots: int) -> None:
        super().__init__()
        self.config, self.num_knots = config, num_knots
        self.static_trunk = Trunk(config, 3, 1)
        self.dynamic_trunk = Trunk(config, 4, 1 + MOTION)

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        return self.static_trunk(2 * coords - 1, directions)

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        time = torch.full_like(coords[:, :1], knot / max(self.num_knots - 1, 1))
        raw = self.dynamic_trunk(torch.cat([2 * coords - 1, time], -1), directions)
        return raw[:, :APPEARANCE], raw[:, APPEARANCE:] if motion else None

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.parameters()), "lr": self.config.lr}]
