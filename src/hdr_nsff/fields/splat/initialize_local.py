"""Start time-local Gaussians on the movers that are not rigid, in every training frame.

One per square cell of mask pixels. Its velocity is the median of the nearby flow that
ends inside a moving mask. Its radiance is the mean of its pixel's and of those that
believed flow leads to in the two neighboring frames, so that a clipped value is taken
from another exposure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from hdr_nsff.core.stack import spread_frames
from hdr_nsff.fields.point_cloud import (
    MIN_RADIANCE,
    PointCloud,
    ToRadiance,
    concatenate,
    exposure_trust,
    merge_by_cell,
    unproject_frame,
)
from hdr_nsff.fields.splat.gaussians import from_log_radiance
from hdr_nsff.fields.splat.local_gaussians import MAX_AGE, LocalGaussians, frame_step
from hdr_nsff.scene.movers import Mover, PinholeCamera, movers_in_picture
from hdr_nsff.scene.scene import Frame, Scene, surely_moving

OVERLAP = 0.5  # standard deviation relative to the side of a cell (hand-chosen on real clips)
OPACITY = 0.7
NEVER = -1e6  # center time, in frames, of a Gaussian without a place
NEIGHBOR_TRUST = 0.5  # of a color that flow brought, relative to the pixel's own
NUM_FLOW_PIXELS = 24  # nearest ones with flow, whose median is a velocity
# standard deviation of a life in cycles of exposures and at least, in frames: every
# exposure sees it, and little bends meanwhile (0.5 to 1 cycle is best on real clips)
DURATION_CYCLES, MIN_DURATION = 0.7, 1.4
# what is fast bends within that time: its path in one standard deviation, in widths of
# the picture; and the least duration, in gaps between frames, which leaves no hole
# where one is missing (on real clips, twice the path gains less)
DURATION_PATH, MIN_DURATION_GAPS = 0.023, 0.8
# share of its distance by which a Gaussian comes nearer or goes away while it is alive:
# more is noise of depth, and would bring it right before the lens
MAX_APPROACH = 0.5


@dataclass(frozen=True)
class LocalSeeds:
    """Seeds of one training frame."""

    points: PointCloud  # P of them
    velocities: Tensor  # (P, 3) scene units a frame
    durations: Tensor  # (P,) standard deviations of their lives, in frames
    time: float  # in frames


def limit_rigid_movers(scene: Scene, most: int) -> Scene:
    """The scene with at most `most` rigid movers, the largest: others would have no
    motion of their own to share, and count as not rigid.
    """
    rigid = [k for k, mover in enumerate(scene.movers) if mover.rigid]
    movers = list(scene.movers)
    for k in rigid[most:]:
        movers[k] = replace(movers[k], rigid=False)
    return replace(scene, movers=tuple(movers))


def local_mask(scene: Scene, i: int) -> Tensor:
    """(H, W) bool: pixels of training frame `i` that surely move, but with no rigid
    mover.
    """
    moving = surely_moving(scene.train[i])
    rigid = np.array([*(mover.rigid for mover in scene.movers), False])
    if not any(rigid):
        return moving
    owner = mover_map(scene, i, time_of(scene, i), scene.movers)
    return moving & torch.from_numpy(~rigid[owner])


def mover_map(scene: Scene, i: int, t: int, movers: Sequence[Mover]) -> np.ndarray:
    """Which of `movers` (H, W) each moving pixel of training frame `i` shows, at their
    t-th time; `NO_MOVER` elsewhere.
    """
    f = scene.train[i]
    moving = np.zeros(f.image.shape[:2], bool) if f.moving is None else f.moving.numpy()
    in_turn = scene.manifest.rig > 1
    tracked = tracks_are_of(scene, i)
    return movers_in_picture(movers, t, moving, camera_arrays(f), tracked, in_turn)


def time_of(scene: Scene, i: int) -> int:
    """The position of a training frame's time among the movers' times."""
    return int(torch.searchsorted(scene.times, scene.train[i].time))


def tracks_are_of(scene: Scene, i: int) -> bool:
    """Whether the movers' tracks are of frames of the camera of training frame `i`."""
    camera_id = scene.train[i].camera_id
    tracked = set(scene.movers[0].frames.tolist())
    return any(f.index in tracked and f.camera_id == camera_id for f in scene.train)


def camera_arrays(f: Frame) -> PinholeCamera:
    """The camera of a frame in numpy."""
    return f.camera.K.double().numpy(), f.camera.c2w.double().numpy()


def count_local_pixels(scene: Scene) -> int:
    """Pixels of non-rigid movers in all training frames."""
    return sum(int(local_mask(scene, i).sum()) for i in range(len(scene.train)))


def place_local(local: LocalGaussians, scene: Scene, to_radiance: ToRadiance, unit: float) -> int:
    """Place the Gaussians; how many. `unit` is the scene's typical length."""
    masks = [local_mask(scene, i) for i in range(len(scene.train))]
    num_pixels = sum(int(mask.sum()) for mask in masks)
    if not num_pixels or not len(local):
        return 0
    masks = thinned(masks, len(local))
    side = math.sqrt(max(num_pixels / len(local), 1.0))
    while sum(count_cells(mask, side) for mask in masks) > len(local):
        side *= 1.01
    seeds = [
        frame_seeds(scene, i, mask, side, to_radiance) for i, mask in enumerate(masks) if mask.any()
    ]
    points = concatenate([seed.points for seed in seeds])
    n = len(points)
    times = torch.cat([torch.full((len(seed.points),), seed.time) for seed in seeds])
    local.means[:n, :3] = points.positions
    local.means[:n, 3] = times
    local.means[n:, 3] = NEVER
    local.velocities[:n, :3] = torch.cat([seed.velocities for seed in seeds])
    local.log_scales[:n, :3] = (OVERLAP * side * points.footprint).log()[:, None]
    local.log_scales[:, 3] = math.log(start_duration(scene))
    local.log_scales[:n, 3] = torch.cat([seed.durations for seed in seeds]).log()
    local.colors[:n, :3] = from_log_radiance(points.log_radiance, local.bounded)
    local.colors[:n, 3] = math.log(OPACITY / (1 - OPACITY))
    local.find_neighbors(unit)
    return n


def thinned(masks: Sequence[Tensor], most: int) -> list[Tensor]:
    """`masks` (H, W), of which at most `most` mark anything: those spread evenly."""
    marked = [i for i, mask in enumerate(masks) if mask.any()]
    if len(marked) <= most:
        return list(masks)
    kept = {marked[k] for k in spread_frames(len(marked), most)}
    return [m if i in kept else torch.zeros_like(m) for i, m in enumerate(masks)]


def start_duration(scene: Scene) -> float:
    """The standard deviation of the life of what is slow, in frames."""
    step = frame_step(scene.times)
    cycle = scene.manifest.num_brackets * step
    return max(DURATION_CYCLES * cycle, MIN_DURATION * step)


def start_durations(scene: Scene, f: Frame, points: PointCloud, velocities: Tensor) -> Tensor:
    """Standard deviations (P,) of the lives of a frame's points, shorter for fast ones.

    What counts is the part of `velocities` (P, 3) across the ray: along it, most is
    noise of depth.
    """
    across = velocities - along_rays(f, points, velocities)
    speeds = across.norm(dim=1) / (points.footprint * f.camera.width)
    longest = start_duration(scene)
    shortest = min(MIN_DURATION_GAPS * gap_beside(scene, f), longest)
    return (DURATION_PATH / speeds.clamp_min(1e-9)).clamp(shortest, longest)


def along_rays(f: Frame, points: PointCloud, velocities: Tensor) -> Tensor:
    """The parts (P, 3) of velocities along the rays of a frame to its points."""
    rays = functional.normalize(points.positions - f.camera.c2w[:, 3], dim=1)
    return (velocities * rays).sum(1, keepdim=True) * rays


def bound_approach(f: Frame, points: PointCloud, velocities: Tensor, durations: Tensor) -> Tensor:
    """`velocities` (P, 3) with a bounded part along the ray, given the `durations` (P,)
    of the points' lives.
    """
    along = along_rays(f, points, velocities)
    distances = (points.positions - f.camera.c2w[:, 3]).norm(dim=1)
    fastest = MAX_APPROACH * distances / (MAX_AGE * durations)
    excess = (1 - fastest / along.norm(dim=1).clamp_min(1e-12)).clamp_min(0)
    return velocities - excess[:, None] * along


def gap_beside(scene: Scene, f: Frame) -> float:
    """The longest time from a frame to the ones before and after, in frames."""
    times = scene.times
    k = int(torch.searchsorted(times, f.time))
    beside = times[max(k - 1, 0) : k + 2]
    return float(beside.diff().max()) if len(beside) > 1 else 1.0


def cells_of(mask: Tensor, side: float) -> Tensor:
    """The square cell (P,) of every pixel of a mask (H, W), row by row."""
    y, x = mask.nonzero().unbind(1)
    return (y / side).long() * mask.shape[1] + (x / side).long()


def count_cells(mask: Tensor, side: float) -> int:
    """How many square cells a mask (H, W) occupies."""
    return len(torch.unique(cells_of(mask, side)))


def frame_seeds(
    scene: Scene, i: int, mask: Tensor, side: float, to_radiance: ToRadiance
) -> LocalSeeds:
    """One seed per square cell of `mask` (H, W) in training frame `i`."""
    f = scene.train[i]
    points = unproject_frame(f, i, mask.reshape(-1), scene.near, scene.far, to_radiance)
    colors = [points.log_radiance]
    trusts = [exposure_trust(f.image[mask])]
    for offset in f.flow:
        color, trust = colors_along_flow(scene, f, mask, offset, to_radiance)
        colors.append(color)
        trusts.append(NEIGHBOR_TRUST * trust)
    weight = torch.stack(trusts)[..., None]  # (1 to 3, P, 1)
    mean = (weight * torch.stack(colors)).sum(0) / weight.sum(0)
    points = PointCloud(points.positions, mean, weight.sum(0)[:, 0], points.footprint)
    cells = cells_of(mask, side)
    pixels = mask.nonzero().flip(1) + 0.5
    centers = mean_by_cell(pixels, cells)
    velocities = velocities_around(centers, *flow_velocities(scene, f, mask, points.positions))
    seeds = merge_by_cell(points, cells)
    durations = start_durations(scene, f, seeds, velocities)
    velocities = bound_approach(f, seeds, velocities, durations)
    return LocalSeeds(seeds, velocities, durations, f.time)


def mean_by_cell(values: Tensor, cells: Tensor) -> Tensor:
    """The mean (C, K) of `values` (P, K) in each distinct cell of `cells` (P,)."""
    _, index, counts = torch.unique(cells, return_inverse=True, return_counts=True)
    sums = torch.zeros(len(counts), values.shape[1]).index_add_(0, index, values)
    return sums / counts[:, None]


def landing(f: Frame, mask: Tensor, offset: int) -> tuple[Tensor, Tensor, Tensor]:
    """Where flow leads the pixels of a mask in a neighbor.

    Pixels (P, 2) with centers at +0.5, the integer pixels (P, 2) that hold them, and
    whether they are inside the picture (P,).
    """
    target = mask.nonzero().flip(1) + 0.5 + f.flow[offset][mask]
    height, width = mask.shape
    cell = target.floor().long()
    inside = (cell >= 0).all(1) & (cell[:, 0] < width) & (cell[:, 1] < height)
    cell = cell.clamp_min(0).minimum(torch.tensor([width - 1, height - 1]))
    return target, cell, inside


def colors_along_flow(
    scene: Scene, f: Frame, mask: Tensor, offset: int, to_radiance: ToRadiance
) -> tuple[Tensor, Tensor]:
    """Log radiance (P, 3) that a neighbor recorded of them, and its trust (P,)."""
    j = f.neighbors[offset]
    _, cell, inside = landing(f, mask, offset)
    rgb = scene.train[j].image[cell[:, 1], cell[:, 0]]
    log = to_radiance(rgb, j, cell + 0.5).clamp_min(MIN_RADIANCE).log()
    return log, exposure_trust(rgb) * (inside & f.flow_valid[offset][mask])


def flow_velocities(
    scene: Scene, f: Frame, mask: Tensor, positions: Tensor
) -> tuple[Tensor, Tensor]:
    """Pixels (Q, 2) whose flow ends inside a moving mask, and their velocities (Q, 3).

    In scene units a frame, from the pixels' `positions` (P, 3) to where the neighbors'
    depth puts what flow finds there; the mean of both sides. Flow that fails the
    forward-backward check counts too: that of fast, near or blurred content mostly
    does, which would otherwise start at rest.
    """
    total = torch.zeros_like(positions)
    count = torch.zeros(len(positions))
    for offset in f.flow:
        neighbor = scene.train[f.neighbors[offset]]
        if neighbor.disparity is None:
            continue
        target, cell, lands = landing(f, mask, offset)
        column, row = cell.unbind(1)
        if neighbor.moving is not None:  # else it landed on what is behind
            lands = lands & neighbor.moving[row, column]
        disparity = neighbor.disparity[row, column].clamp(1 / scene.far, 1 / scene.near)
        rays = neighbor.camera.rays(target)
        points = rays.origins + rays.directions / disparity[:, None]
        step = (points - positions) / (neighbor.time - f.time)
        total += torch.where(lands[:, None], step, torch.zeros_like(step))
        count += lands
    known = count > 0
    pixels = mask.nonzero().flip(1)[known] + 0.5
    return pixels, total[known] / count[known, None]


def velocities_around(centers: Tensor, pixels: Tensor, velocities: Tensor) -> Tensor:
    """The median (P, 3) of the `velocities` (Q, 3) at the `pixels` (Q, 2) nearest to
    each of `centers` (P, 2); 0 where there are none.
    """
    if not len(pixels):
        return torch.zeros(len(centers), 3)
    num = min(NUM_FLOW_PIXELS, len(pixels))
    _, nearest = cKDTree(pixels.numpy()).query(centers.numpy(), num)
    of_nearest = velocities[torch.from_numpy(nearest.reshape(len(centers), num))]
    return of_nearest.median(1).values
