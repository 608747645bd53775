"""The two ways to store a field's static and dynamic branch: additive grids (ours), and
the published network (NSFF, Li et al. 2021; HDR-NSFF, eq. 1 and 5).

Both answer with raw numbers at M points of the cube; `two_branches.py` and `nsff.py`
turn them into radiance, density and scene flow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import torch
from annotated_types import Ge, Le
from pydantic import AfterValidator
from torch import Tensor, nn

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.core.settings import Advanced, Count, Number, Positive, Rate
from hdr_nsff.fields.nsff.encodings import AdditiveGrid, Shape, frequencies

STATIC = 5  # raw radiance (3), raw density, raw blend weight v (eq. 5)
DYNAMIC = 4  # raw radiance (3), raw density
MOTION = 8  # raw scene flow forward (3), raw disocclusion forward; the same backward

MIN_GRID_POINTS = 4  # of a level along each axis of space
MOTION_LEVELS = 2  # of the scene-flow grids: smooth by construction
MOTION_DEPTH_SHARE = 8  # times fewer grid points of scene flow than `depth_cells`


def power_of_two(number: int) -> int:
    """The number above 0; ValueError where it is not 1, 2, 4, 8 and so on."""
    if number & (number - 1):
        raise ValueError("choose a power of two")
    return number


@dataclass(frozen=True)
class GridConfig:
    """Additive multiresolution grids without a network behind them."""

    type: Advanced[Literal["grids"]] = "grids"
    finest: Positive = 1.0
    """Size of the finest cell across the image, in pixels of the training frames."""
    depth_cells: Count = 96
    """Grid points along the third axis at the finest level."""
    levels: Advanced[Count] = 4
    """Levels of the appearance grids, each twice as fine as the one before."""
    max_rows: Advanced[Annotated[int, Ge(1), Le(10**9), AfterValidator(power_of_two)]] = 2**20
    """Rows of a hashed level (a power of two)."""
    motion_cell: Advanced[Positive] = 8.0
    """Cell size of the finer of the two scene-flow grids, in pixels."""
    lr: Advanced[Rate] = 0.1
    """Learning rate of the appearance grids."""
    motion_lr: Advanced[Rate] = 0.01
    """Learning rate of the scene-flow grids."""


@dataclass(frozen=True)
class MlpConfig:
    """The published network: a skip connection, position encoding, view dependence."""

    type: Advanced[Literal["network"]] = "network"
    layers: Count = 8
    """Hidden layers of each branch."""
    width: Count = 256
    """Width of a hidden layer."""
    skip_after: Advanced[Number] = 5
    """Layers before the encoded position is fed in again."""
    octaves: Advanced[Number] = 10
    """Octaves of the position encoding."""
    direction_octaves: Advanced[Number] = 4
    """Octaves of the encoding of view directions."""
    lr: Advanced[Rate] = 5e-4
    """Learning rate."""


class Branches(Protocol):
    """Static and dynamic branch of a field, in cube coordinates."""

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        """Raw radiance (3), density and blend weight: (M, 5).

        `coords` (M, 3) are in [0, 1], `directions` (M, 3) unit view directions.
        """
        ...

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        """Raw radiance (3) and density (M, 4) at time `knot`.

        With `motion` also raw motion (M, 8), else None.
        """
        ...

    def param_groups(self) -> list[ParamGroup]:
        """Parameters with their learning rates."""
        ...


def pyramid(finest: tuple[float, float, float], levels: int, slices: int) -> list[Shape]:
    """Grid shapes from coarse to fine, each level half as fine as the next."""
    shapes = []
    for level in reversed(range(levels)):
        x, y, z = (max(MIN_GRID_POINTS, round(points / 2**level)) for points in finest)
        shapes.append((x, y, z, slices))
    return shapes


class GridBranches(nn.Module):
    """Grids over the cube; each training time has a slice of the dynamic ones.

    With `blending`, a static grid as coarse as those of scene flow holds the blend
    weight.
    """

    def __init__(
        self, config: GridConfig, width: int, height: int, num_knots: int, blending: bool = False
    ) -> None:
        super().__init__()
        self.config = config
        fine = (width / config.finest, height / config.finest, float(config.depth_cells))
        coarse = (
            width / config.motion_cell,
            height / config.motion_cell,
            config.depth_cells / MOTION_DEPTH_SHARE,
        )
        static_shapes = pyramid(fine, config.levels, 1)
        dynamic_shapes = pyramid(fine, config.levels, num_knots)
        motion_shapes = pyramid(coarse, MOTION_LEVELS, num_knots)
        self.static_grid = AdditiveGrid(static_shapes, 1, config.max_rows)
        self.dynamic_grid = AdditiveGrid(dynamic_shapes, num_knots, config.max_rows)
        self.blend_grid = None
        if blending:
            self.blend_grid = AdditiveGrid(pyramid(coarse, MOTION_LEVELS, 1), 1, config.max_rows)
        self.motion_grids = nn.ModuleList(  # forward and backward
            AdditiveGrid(motion_shapes, num_knots, config.max_rows) for _ in range(2)
        )

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        raw = self.static_grid(coords)
        if self.blend_grid is None:
            return nn.functional.pad(raw, (0, 1))
        return torch.cat([raw, self.blend_grid(coords)[:, :1]], -1)

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        appearance = self.dynamic_grid(coords, knot)
        if not motion:
            return appearance, None
        return appearance, torch.cat([grid(coords, knot) for grid in self.motion_grids], -1)

    def param_groups(self) -> list[ParamGroup]:
        appearance, motion = [self.static_grid, self.dynamic_grid], list(self.motion_grids)
        if self.blend_grid is not None:
            appearance.append(self.blend_grid)
        return [
            table_group(appearance, self.config.lr),
            table_group(motion, self.config.motion_lr),
        ]


def table_group(grids: list[Any], lr: float) -> ParamGroup:
    """A parameter group of grids' tables, of which only touched rows move."""
    return ParamGroup([g.table for g in grids], lr, row_marks=[g.touched for g in grids])


class Trunk(nn.Module):
    """ReLU layers with one skip, a density head and a view-dependent radiance head.

    `dims` is the number of input coordinates, `extra` the number of outputs besides
    radiance and density. The radiance head may also know a code of `code_size` numbers,
    which follow the directions.
    """

    def __init__(self, config: MlpConfig, dims: int, extra: int, code_size: int = 0) -> None:
        super().__init__()
        self.config = config
        inputs = dims * (1 + 2 * config.octaves)
        sizes = [inputs] + [config.width] * (config.layers - 1)
        if 0 < config.skip_after < config.layers:
            sizes[config.skip_after] += inputs
        self.hidden = nn.ModuleList(nn.Linear(n, config.width) for n in sizes)
        self.extra = nn.Linear(config.width, 1 + extra)  # density, and what else ignores the view
        self.feature = nn.Linear(config.width, config.width)
        views = 3 * (1 + 2 * config.direction_octaves)
        self.view = nn.Linear(config.width + views + code_size, config.width // 2)
        self.radiance = nn.Linear(config.width // 2, 3)

    def forward(self, position: Tensor, directions: Tensor) -> Tensor:
        """Raw radiance (3), density and the extra outputs: (M, 4 + extra).

        `position` is (M, dims) in [-1, 1], `directions` (M, 3 + code_size).
        """
        h = self.hidden_features(position)
        views = frequencies(directions[:, :3], self.config.direction_octaves)
        code = directions[:, 3:]
        h_view = self.view(torch.cat([self.feature(h), views, code], -1)).relu()
        return torch.cat([self.radiance(h_view), self.extra(h)], -1)

    def hidden_features(self, position: Tensor) -> Tensor:
        """The last hidden layer (M, width) at `position` (M, dims) in [-1, 1]."""
        encoded = frequencies(position, self.config.octaves)
        h = encoded
        for i, layer in enumerate(self.hidden):
            if i == self.config.skip_after:
                h = torch.cat([encoded, h], -1)
            h = layer(h).relu()
        return h


class MlpBranches(nn.Module):
    """The published pair of networks.

    Time is a fourth input in [0, 1]; space is the cube scaled to [-1, 1].
    """

    def __init__(self, config: MlpConfig, num_knots: int) -> None:
        super().__init__()
        self.config, self.num_knots = config, num_knots
        self.static_trunk = Trunk(config, 3, 1)
        self.dynamic_trunk = Trunk(config, 4, MOTION)

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        return self.static_trunk(2 * coords - 1, directions)

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        time = torch.full_like(coords[:, :1], knot / max(self.num_knots - 1, 1))
        raw = self.dynamic_trunk(torch.cat([2 * coords - 1, time], -1), directions)
        raw_motion = raw[:, DYNAMIC:] if motion else None
        return raw[:, :DYNAMIC], raw_motion

    def param_groups(self) -> list[ParamGroup]:
        return [ParamGroup(list(self.parameters()), self.config.lr)]
