"""Start a grid field from what `prepare` knows: every pixel paints its radiance where
its depth prior puts it.

Radiance goes in coarse to fine, each level taking the mean of what the coarser ones
leave (a residual pyramid). Density is the maximum-likelihood one of a medium: rays
stopped in a cell, per length of ray that crossed it. Static pixels paint the static
branch, moving pixels their own time's slice of the dynamic one. Training refines all of
it; this only saves it the first minutes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hdr_nsff.core.progress import track
from hdr_nsff.fields.nsff.branches import GridBranches
from hdr_nsff.fields.nsff.encodings import AdditiveGrid
from hdr_nsff.fields.nsff.two_branches import TwoBranches
from hdr_nsff.fields.surface import ToRadiance, exposure_trust
from hdr_nsff.scene.scene import Frame

CROSSINGS = 24  # places along a ray where its passing is counted
SWEEPS = 4  # over the finest level
HARDEST, SOFTEST = 5.0, -4.0  # bounds of painted raw density


@dataclass(frozen=True)
class Splash:
    """What one frame paints."""

    coords: Tensor  # (P, 3) surface points, cube
    raw_radiance: Tensor  # (P, 3) as the grids store it
    trust: Tensor  # (P,)
    moving: Tensor  # (P,) bool
    crossed: Tensor  # (P, CROSSINGS, 3) cube points in front of the surface
    lengths: Tensor  # (P,) cube length of ray that each of those stands for
    knot: float


def paint(field: TwoBranches, frames: list[Frame], to_radiance: ToRadiance) -> bool:
    """Paint `field` from the frames' depth priors; False where it has no grids or the
    frames no depth in scene units.

    `to_radiance(rgb (P, 3), i)` inverts the recording of frame `i`.
    """
    if not isinstance(field.branches, GridBranches) or any(f.disparity is None for f in frames):
        return False
    splashes = [splash(field, f, i, to_radiance) for i, f in enumerate(track(frames, "painting"))]
    static, dynamic = field.branches.static_grid, field.branches.dynamic_grid
    paint_density(
        static,
        splashes,
        static_density_level(static),
        moving=False,
        bias=field.density_bias(static=True),
    )
    paint_radiance(static, splashes, moving=False)
    for s in splashes:
        field.static_cells.observe(s.coords[~s.moving], torch.ones(int((~s.moving).sum())))
    field.static_cells.refresh(threshold=0.5, decay=0.5)
    if any(s.moving.any() for s in splashes):
        paint_density(
            dynamic,
            splashes,
            static_density_level(dynamic),
            moving=True,
            bias=field.density_bias(static=False),
        )
        paint_radiance(dynamic, splashes, moving=True)
    return True


def static_density_level(grid: AdditiveGrid) -> int:
    """The finest level without hashing: free space painted into a hash would erase
    surfaces elsewhere.
    """
    dense = [i for i, hashed in enumerate(grid.hashed) if not hashed]
    return dense[-1] if dense else 0


def splash(field: TwoBranches, f: Frame, position: int, to_radiance: ToRadiance) -> Splash:
    """Points, colors and crossed space of the frame at `position` of the training
    frames.
    """
    assert f.disparity is not None
    rays = f.camera.rays(f.camera.pixel_grid())
    disparity = f.disparity.reshape(-1).clamp(1 / field.far, 1 / field.near)
    rgb = f.image.reshape(-1, 3)
    coords = field.space.encode(rays.origins + rays.directions / disparity[:, None])
    share = (torch.arange(CROSSINGS) + 0.5) / CROSSINGS
    passing = 1 / field.near + share * (
        disparity[:, None] - 1 / field.near
    )  # (P, CROSSINGS) even in disparity
    crossed = field.space.encode(
        rays.origins[:, None] + rays.directions[:, None] / passing[..., None]
    )
    confidence = (
        torch.ones_like(disparity)
        if f.disparity_confidence is None
        else f.disparity_confidence.reshape(-1)
    )
    return Splash(
        coords=coords,
        raw_radiance=field.from_radiance(to_radiance(rgb, position)),
        trust=(confidence + 0.02) * exposure_trust(rgb),
        moving=torch.zeros_like(disparity, dtype=torch.bool)
        if f.moving is None
        else f.moving.reshape(-1),
        crossed=crossed,
        lengths=(crossed[:, -1] - crossed[:, 0]).norm(dim=-1) / (CROSSINGS - 1),
        knot=field.knot(f.time),
    )


def paint_radiance(grid: AdditiveGrid, splashes: list[Splash], moving: bool) -> None:
    """Coarse to fine, every level the trust-weighted mean of what is left; the finest
    one several times, as one mean blurs.
    """
    finest = len(grid.res) - 1
    for level in [*range(finest), *[finest] * SWEEPS]:
        total = torch.zeros(int(grid.size[level]), 4)
        for s in splashes:
            chosen = s.moving == moving
            coords, trust = s.coords[chosen], s.trust[chosen, None]
            with torch.no_grad():
                left = s.raw_radiance[chosen] - grid(coords, s.knot)[:, :3]
            total += grid.spread_to(level, coords, torch.cat([left * trust, trust], -1), s.knot)
        weight = total[:, 3:]
        grid.rows_of(level)[:, :3] += total[:, :3] / (
            weight + 0.05 * weight[weight > 0].mean().nan_to_num(1.0) + 1e-9
        )


def paint_density(
    grid: AdditiveGrid, splashes: list[Splash], level: int, moving: bool, bias: float
) -> None:
    """Rays stopped per length crossed, as raw density at one level. Unseen cells keep
    the field's own start.
    """
    total = torch.zeros(int(grid.size[level]), 4)
    for s in splashes:
        chosen = s.moving == moving
        stops = torch.zeros(int(chosen.sum()), 4)
        stops[:, 0] = 1
        total += grid.spread_to(level, s.coords[chosen], stops, s.knot)
        passes = torch.zeros(len(s.coords) * CROSSINGS, 4)
        passes[:, 1] = s.lengths[:, None].expand(-1, CROSSINGS).reshape(-1)
        total += grid.spread_to(level, s.crossed.reshape(-1, 3), passes, s.knot)
    stopped, length = total[:, 0], total[:, 1]
    half_cell = 0.5 / float(grid.res[level, 2])
    density = stopped / (length + stopped * half_cell).clamp_min(1e-9)
    raw = density.clamp_min(1e-6).log().clamp(SOFTEST, HARDEST) - bias
    grid.rows_of(level)[:, 3] = torch.where(
        stopped + length > 1e-3 * half_cell, raw, torch.zeros_like(raw)
    )
