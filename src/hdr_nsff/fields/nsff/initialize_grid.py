"""Initialize a grid field from the depth prior: every pixel stores its radiance where
its prior depth puts it.

Radiance is fitted coarse to fine: each level takes the mean of what the coarser ones
leave (a residual pyramid). Density is the maximum-likelihood one of a medium: rays
stopped in a cell, per length of ray that crossed it. Static pixels initialize the
static branch, moving pixels their own time's slice of the dynamic one. Training refines
all of it; this only saves it the first minutes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from hdr_nsff.core.progress import track
from hdr_nsff.fields.nsff.branches import GridBranches
from hdr_nsff.fields.nsff.encodings import AdditiveGrid
from hdr_nsff.fields.nsff.two_branches import TwoBranches
from hdr_nsff.fields.point_cloud import ToRadiance, point_trust, prior_confidence, prior_disparity
from hdr_nsff.scene.scene import Frame

FREE_SAMPLES = 24  # per ray, at which the space in front of the surface counts as crossed
FINEST_SWEEPS = 4  # fits of the finest level: one weighted mean blurs (see its test)
# bounds of the raw density, log of density per cube side (hand-chosen on rendered
# scenes)
MIN_LOG_DENSITY, MAX_LOG_DENSITY = -4.0, 5.0
PRIOR_SHARE = 0.05  # of a cell's mean trust that pulls its residual to 0 (hand-chosen)
# of half a cell: a cell crossed or hit by less than this length keeps the field's start
MIN_SEEN = 1e-3
# `refresh` keeps cells near a surface: it observed weight 1, and forgets half of it
SURFACE_THRESHOLD, SURFACE_DECAY = 0.5, 0.5


@dataclass(frozen=True)
class SurfaceSamples:
    """The surface that one frame sees, and the free space in front of it."""

    coords: Tensor  # (P, 3) surface points, cube
    raw_radiance: Tensor  # (P, 3) as the grids store it
    trust: Tensor  # (P,) > 0
    moving: Tensor  # (P,) bool
    knot: float  # of the frame's time
    # cube points (P, FREE_SAMPLES, 3) in front of the surface, and the cube length (P,)
    # of ray that each of them represents: too many to be kept for all frames
    free_space: Callable[[], tuple[Tensor, Tensor]]


def initialize_grid(field: TwoBranches, frames: list[Frame], to_radiance: ToRadiance) -> bool:
    """Initialize `field` from the frames' depths in scene units; whether it could.

    It cannot where it has no grids, or a frame no depth.
    `to_radiance(rgb (P, 3), i)` inverts the recording of frame `i`.
    """
    if not isinstance(field.branches, GridBranches):
        return False
    if any(f.disparity is None for f in frames):
        return False
    samples = [
        sample_surface(field, frame, i, to_radiance)
        for i, frame in enumerate(track(frames, "initializing grids"))
    ]
    static, dynamic = field.branches.static_grid, field.branches.dynamic_grid
    fit_density(static, samples, moving=False, bias=field.density_bias(static=True))
    fit_radiance(static, samples, moving=False)
    for s in samples:
        surface = s.coords[~s.moving]
        field.static_cells.observe(surface, torch.ones(len(surface)))
    field.static_cells.refresh(SURFACE_THRESHOLD, SURFACE_DECAY)
    if any(s.moving.any() for s in samples):
        fit_density(dynamic, samples, moving=True, bias=field.density_bias(static=False))
        fit_radiance(dynamic, samples, moving=True)
    return True


def sample_surface(
    field: TwoBranches, frame: Frame, position: int, to_radiance: ToRadiance
) -> SurfaceSamples:
    """Surface points, their radiance and the free space that one frame sees.

    `position` is the frame's place in the list of training frames.
    """
    rays = frame.camera.rays(frame.camera.pixel_grid())
    disparity = prior_disparity(frame, field.near, field.far)
    rgb = frame.image.reshape(-1, 3)
    surface = rays.origins + rays.directions / disparity[:, None]  # (P, 3)
    if frame.moving is None:
        moving = torch.zeros_like(disparity, dtype=torch.bool)
    else:
        moving = frame.moving.reshape(-1)
    return SurfaceSamples(
        coords=field.space.encode(surface),
        raw_radiance=field.from_radiance(to_radiance(rgb, position)),
        trust=point_trust(rgb, prior_confidence(frame)),
        moving=moving,
        knot=field.knot(frame.time),
        free_space=partial(free_space, field, frame),
    )


def free_space(field: TwoBranches, frame: Frame) -> tuple[Tensor, Tensor]:
    """The `SurfaceSamples.free_space` of a frame: samples even in disparity."""
    rays = frame.camera.rays(frame.camera.pixel_grid())
    disparity = prior_disparity(frame, field.near, field.far)
    share = (torch.arange(FREE_SAMPLES) + 0.5) / FREE_SAMPLES
    nearest = 1 / field.near
    passing = nearest + share * (disparity[:, None] - nearest)  # (P, FREE_SAMPLES)
    in_front = rays.origins[:, None] + rays.directions[:, None] / passing[..., None]
    crossed = field.space.encode(in_front)
    return crossed, (crossed[:, -1] - crossed[:, 0]).norm(dim=-1) / (FREE_SAMPLES - 1)


def fit_radiance(grid: AdditiveGrid, samples: list[SurfaceSamples], moving: bool) -> None:
    """Fit radiance coarse to fine, to static or to moving pixels.

    Every level is the trust-weighted mean of what the others leave. The finest one is
    fitted several times, as one mean blurs.
    """
    finest = len(grid.res) - 1
    for level in [*range(finest), *[finest] * FINEST_SWEEPS]:
        total = torch.zeros(int(grid.size[level]), 4)  # trust * residual (3), trust
        for s in samples:
            chosen = s.moving == moving
            coords, trust = s.coords[chosen], s.trust[chosen, None]
            with torch.no_grad():
                residual = s.raw_radiance[chosen] - grid(coords, s.knot)[:, :3]
            weighted = torch.cat([residual * trust, trust], -1)
            total += grid.scatter_level(level, coords, weighted, s.knot)
        weight = total[:, 3:]
        mean_weight = weight[weight > 0].mean().nan_to_num(1.0)
        grid.rows_of(level)[:, :3] += total[:, :3] / (weight + PRIOR_SHARE * mean_weight + 1e-9)


def fit_density(
    grid: AdditiveGrid, samples: list[SurfaceSamples], moving: bool, bias: float
) -> None:
    """Fit raw density at one level, to static or to moving pixels.

    It is rays stopped in a cell, per length of ray that crossed it. Unseen cells keep
    the field's own start, raw density 0.
    """
    level = finest_dense_level(grid)
    total = torch.zeros(int(grid.size[level]), 4)  # rays stopped, length crossed, unused (2)
    for s in samples:
        chosen = s.moving == moving
        stops = torch.zeros(int(chosen.sum()), 4)
        stops[:, 0] = 1
        total += grid.scatter_level(level, s.coords[chosen], stops, s.knot)
        crossed, lengths = s.free_space()
        passes = torch.zeros(len(s.coords) * FREE_SAMPLES, 4)
        passes[:, 1] = lengths[:, None].expand(-1, FREE_SAMPLES).reshape(-1)
        total += grid.scatter_level(level, crossed.reshape(-1, 3), passes, s.knot)
    stopped, length = total[:, 0], total[:, 1]
    half_cell = 0.5 / float(grid.res[level, 2])  # a ray that stops has crossed half a cell
    density = stopped / (length + stopped * half_cell).clamp_min(1e-9)
    log_density = density.clamp_min(1e-6).log().clamp(MIN_LOG_DENSITY, MAX_LOG_DENSITY)
    raw = log_density - bias
    seen = stopped + length > MIN_SEEN * half_cell
    grid.rows_of(level)[:, 3] = torch.where(seen, raw, torch.zeros_like(raw))


def finest_dense_level(grid: AdditiveGrid) -> int:
    """The finest level without hashing.

    Free space written into a hash table would erase surfaces elsewhere.
    """
    dense = [i for i, hashed in enumerate(grid.hashed) if not hashed]
    return dense[-1] if dense else 0
