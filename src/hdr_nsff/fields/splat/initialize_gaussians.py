"""Start a field of Gaussians from the prepared scene.

Static ones start at the depth prior of static pixels, moving ones on the motions of
rigid movers. Both start in the radiance that the response recovers from unclipped
values. `initialize_local.py` starts the time-local ones.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from hdr_nsff.fields.point_cloud import (
    CELLS_PER_KIND,
    PointCloud,
    ToRadiance,
    assign_cells,
    concatenate,
    merge_by_cell,
    unproject_frame,
)
from hdr_nsff.fields.space import FrustumSpace, build_space
from hdr_nsff.fields.splat.detail import cell_sizes, detail_density, scale_by_size
from hdr_nsff.fields.splat.free_space import remove_fog
from hdr_nsff.fields.splat.gaussians import START_LOGIT, Gaussians, from_log_radiance
from hdr_nsff.fields.splat.initialize_local import (
    limit_rigid_movers,
    local_mask,
    mover_map,
    place_local,
    tracks_are_of,
)
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.movers import Mover, fill_mover_depth
from hdr_nsff.scene.scene import Frame, Scene, surely_moving

# a cell is this many times longer along the view than across, as shares of the frustum
DEPTH_CELLS = 12.0
FILL = 0.95  # of the places are used at once; the rest go where the error is
# of the static Gaussians: with less fog its places wait for relocation (hand-chosen: a
# second start takes as long as the first)
MIN_REFILL_SHARE = 0.02
# of all frames that become points; of more, a lattice (a hundred for every Gaussian)
MAX_START_PIXELS = 8_000_000
OVERLAP = 0.6  # standard deviation relative to the distance to the neighbors
OPACITY = 0.7
KEY_FRAMES = 12  # times whose moving pixels become Gaussians
ABSENT = -6.0  # logit offset of what is not seen
KMEANS_ROUNDS = 10
OWN = 4.0  # logit of the nearest basis over the others


def initialize_gaussians(
    field: Splat, scene: Scene, to_radiance: ToRadiance, typical: float, from_priors: bool = True
) -> str:
    """Place all Gaussians; one sentence about what was found. `typical` is the median
    log radiance.
    """
    frames = scene.train
    with torch.no_grad():
        field.background[:] = from_log_radiance(torch.tensor(typical), field.bounded)
        in_scene_units = scene.manifest.depth_kind == "scene"
        if not (from_priors and in_scene_units) or any(f.disparity is None for f in frames):
            scatter(field, scene, typical)
            return (
                "static Gaussians start at random places and moving ones not at all, "
                "without a depth prior in scene units"
            )
        found = sum(mover.rigid for mover in scene.movers)
        scene = limit_rigid_movers(scene, field.config.bases)
        num_movers, moving = place_movers(field, scene, to_radiance)
        local = place_local(field.local, scene, to_radiance, field.unit)
        count = place_static(field, scene, to_radiance)
        of_all = f" of {found}" if found > num_movers else ""
        return (
            f"{count} static Gaussians from the depth prior; "
            f"{moving} moving ones on {num_movers}{of_all} rigid movers; {local} time-local ones"
        )


def place_static(field: Splat, scene: Scene, to_radiance: ToRadiance) -> int:
    """Place the static Gaussians where the depth prior sees surfaces; how many.

    Points whose Gaussians are fog are left out. The others are then merged into finer
    cells, so that the places of fog are used for what is there. Movers are placed
    before: they may hide what is static.
    """
    points, density = static_points(scene, to_radiance)
    limit = int(FILL * len(field.static))
    cells = thin_cells(points, density, scene, limit)
    count = place(field.static, merge_by_cell(points, cells))
    fog = remove_fog(field, scene.train)
    if len(fog) < MIN_REFILL_SHARE * len(field.static):
        return count - len(fog)
    _, gaussian = torch.unique(cells, return_inverse=True)  # of every point
    clear = ~torch.isin(gaussian, fog)
    points, density = points.select(clear), density[clear]
    cells = thin_cells(points, density, scene, limit)
    count = place(field.static, merge_by_cell(points, cells))
    return count - len(remove_fog(field, scene.train))


def static_points(scene: Scene, to_radiance: ToRadiance) -> tuple[PointCloud, Tensor]:
    """Pixels of all training frames outside the moving masks, as points; and the
    relative density (P,) that the detail of their frames asks for.
    """
    frames = scene.train
    num_pixels = sum(f.camera.width * f.camera.height for f in frames)
    step = max(1, math.ceil(math.sqrt(num_pixels / MAX_START_PIXELS)))
    clouds, densities = [], []
    for i, f in enumerate(frames):
        chosen = still(f) & lattice(f, i, step)
        clouds.append(unproject_frame(f, i, chosen, scene.near, scene.far, to_radiance))
        densities.append(detail_density(f.image)[chosen])
    return concatenate(clouds), torch.cat(densities)


def still(f: Frame) -> Tensor:
    """(H * W,) bool: pixels safely outside the moving mask."""
    if f.moving is None:
        return torch.ones(f.image.shape[0] * f.image.shape[1], dtype=torch.bool)
    near = nn.functional.max_pool2d(f.moving[None, None].float(), 3, 1, 1)[0, 0] > 0
    return ~near.reshape(-1)


def lattice(f: Frame, position: int, step: int) -> Tensor:
    """(H * W,) bool: every `step`-th pixel in x and y, others in every frame."""
    rows = torch.arange(f.camera.height) % step == position % step
    columns = torch.arange(f.camera.width) % step == position // step % step
    return (rows[:, None] & columns).reshape(-1)


def thin_cells(points: PointCloud, density: Tensor, scene: Scene, limit: int) -> Tensor:
    """The cell (P,) of every point: a pixel's frustum, or a cube in a box. They are the
    finest of which at most `limit` are occupied, larger where the relative `density`
    (P,) is low.
    """
    space = build_space([f.camera for f in scene.train], scene.near, scene.far)
    coords = space.encode(points.positions)
    if isinstance(space, FrustumSpace):
        extent = space.high - space.low
        coords = coords * torch.stack([extent[0], extent[1], extent[0] / DEPTH_CELLS]) / extent[0]
    size = cell_sizes(points, coords, density, scene.manifest.width)
    if not len(points):
        return size
    return assign_cells(scale_by_size(coords, size), size, limit)


def place(gaussians: Gaussians, points: PointCloud) -> int:
    """Put the first Gaussians at the points, as wide as their neighbors are away; the
    others are invisible. How many.
    """
    n = min(len(points), len(gaussians))
    gaussians.opacity_logits[n:] = START_LOGIT
    if n == 0:
        return 0
    apart = torch.from_numpy(neighbor_distance(points.positions[:n].numpy())).float()
    spacing = apart.clamp(min=0.3 * points.footprint[:n], max=8 * points.footprint[:n])
    gaussians.means[:n] = points.positions[:n]
    gaussians.log_scales[:n] = (OVERLAP * spacing).log()[:, None]
    gaussians.opacity_logits[:n] = math.log(OPACITY / (1 - OPACITY))
    gaussians.log_radiance[:n] = from_log_radiance(points.log_radiance[:n], gaussians.bounded)
    return n


def neighbor_distance(points: np.ndarray) -> np.ndarray:
    """Mean distance (P,) to the three nearest other points."""
    if len(points) < 4:
        return np.full(len(points), np.inf)
    return cKDTree(points).query(points, 4)[0][:, 1:].mean(1)


def scatter(field: Splat, scene: Scene, typical: float) -> None:
    """Static Gaussians at random along random rays, evenly in disparity: what is left
    where no depth is known.
    """
    generator = torch.Generator().manual_seed(0)
    per = max(len(field.static) // len(scene.train), 1)
    parts = []
    for f in scene.train:
        grid = f.camera.pixel_grid()
        pixels = grid[torch.randint(len(grid), (per,), generator=generator)]
        disparity = torch.lerp(
            torch.tensor(1 / scene.far),
            torch.tensor(1 / scene.near),
            torch.rand(per, generator=generator),
        )
        rays = f.camera.rays(pixels)
        positions = rays.origins + rays.directions / disparity[:, None]
        footprint = 2 / (disparity * f.camera.K[0, 0])
        parts.append(
            PointCloud(positions, torch.full((per, 3), typical), torch.ones(per), footprint)
        )
    place(field.static, concatenate(parts))


# Movers


def place_movers(field: Splat, scene: Scene, to_radiance: ToRadiance) -> tuple[int, int]:
    """Place moving Gaussians on rigid movers, at most as many as there are shared
    motions, and give them these.

    Returns the number of movers and of Gaussians.
    """
    movers = [mover for mover in scene.movers if mover.rigid]
    if not movers:
        return 0, 0
    position = {f.index: i for i, f in enumerate(scene.train)}
    frames = [position[int(index)] for index in movers[0].frames]
    parts = [
        mover_points(scene, i, t, movers, to_radiance)
        for t in key_times(scene, frames)
        for i in frames_at(scene, frames[t])
    ]
    points, owner = concatenate([p for p, _ in parts]), torch.cat([o for _, o in parts])
    limit = int(FILL * len(field.moving))
    cell = assign_cells(points.positions, owner, limit)  # movers never share one
    kept, kept_owner = merge_by_cell(points, cell), torch.unique(cell) // CELLS_PER_KIND
    count = place(field.moving, kept)
    hide_unseen(field, movers, kept_owner[:count])
    share_bases(field, movers, kept.positions[:count], kept_owner[:count])
    field.find_neighbors()
    return len(movers), count


def key_times(scene: Scene, frames: list[int]) -> list[int]:
    """Up to `KEY_FRAMES` of the times with moving pixels, evenly spread."""
    moving = [surely_moving(scene.train[i]) for i in frames]
    seen = [t for t, mask in enumerate(moving) if mask.any()]
    if not seen:
        return list(range(len(frames)))[:1]
    chosen = np.linspace(0, len(seen) - 1, min(KEY_FRAMES, len(seen)))
    return sorted({seen[round(i)] for i in chosen.tolist()})


def frames_at(scene: Scene, i: int) -> list[int]:
    """Training frame `i`, and those of other cameras at its time."""
    frame = scene.train[i]
    others = [
        k
        for k, f in enumerate(scene.train)
        if f.time == frame.time and f.camera_id != frame.camera_id
    ]
    return [i, *others]


def mover_points(
    scene: Scene, i: int, t: int, movers: Sequence[Mover], to_radiance: ToRadiance
) -> tuple[PointCloud, Tensor]:
    """The pixels of rigid `movers` in training frame `i`, at the t-th time of these, as
    points at their canonical places, and the mover of each (P,).
    """
    f = scene.train[i]
    if tracks_are_of(scene, i):
        f = with_mover_depth(f, t, movers)
    moving = surely_moving(f) & ~local_mask(scene, i)
    points = unproject_frame(f, i, moving.reshape(-1), scene.near, scene.far, to_radiance)
    owner = mover_map(scene, i, t, movers)[moving.numpy()]
    canonical = points.positions.double().numpy().copy()
    for k, mover in enumerate(movers):
        canonical[owner == k] = mover.canonical(canonical[owner == k], t)
    positions = torch.from_numpy(canonical).float()
    return replace(points, positions=positions), torch.from_numpy(owner)


def with_mover_depth(f: Frame, t: int, movers: Sequence[Mover]) -> Frame:
    """The frame of the t-th time with the depth of the movers' shapes."""
    assert f.disparity is not None
    moving = np.zeros(f.image.shape[:2], bool) if f.moving is None else f.moving.numpy()
    confidence = f.disparity_confidence
    if confidence is None:
        confidence = torch.ones_like(f.disparity)
    c2w = f.camera.c2w.double().numpy()
    maps = fill_mover_depth(movers, t, moving, c2w, f.disparity.numpy(), confidence.numpy())
    disparity, confidence = (torch.from_numpy(m) for m in maps)
    return replace(f, disparity=disparity, disparity_confidence=confidence)


def hide_unseen(field: Splat, movers: Sequence[Mover], owner: Tensor) -> None:
    """Make moving Gaussians invisible at the times their mover (P,) is not seen: it has
    left, or is hidden.
    """
    knots, num_times = len(field.opacity_offsets), field.trajectories.num_knots
    for k, mover in enumerate(movers):
        if not len(mover.trust):
            continue
        seen = np.any(mover.trust > 0, axis=0, keepdims=True)[0]
        for knot in range(knots):
            ends = [(knot + side) / max(knots - 1, 1) * (num_times - 1) for side in (-1, 1)]
            low, high = (int(np.clip(round(end), 0, num_times - 1)) for end in ends)
            if not np.any(seen[low : high + 1]):
                field.opacity_offsets[knot, : len(owner)][owner == k] = ABSENT


def share_bases(field: Splat, movers: Sequence[Mover], points: Tensor, owner: Tensor) -> None:
    """Give every mover motion bases by its number of Gaussians (at least one), spread
    over it; each Gaussian starts with its nearest basis.

    `points` (P, 3): canonical places of the first moving Gaussians; `owner` (P,): their
    mover.
    """
    motions, num_bases = field.trajectories, field.config.bases
    turns = motions.rotations.data.view(motions.num_knots, num_bases, 4)
    shifts = motions.translations.data.view(motions.num_knots, num_bases, 4)
    field.mixture_logits[:] = 0
    first = 0
    counts = bases_per_mover(torch.bincount(owner, minlength=len(movers)), num_bases)
    for k, (mover, count) in enumerate(zip(movers, counts, strict=True)):
        own = owner == k
        center = torch.from_numpy(mover.center).float()
        rotations = torch.from_numpy(mover.rotations).float()
        path = torch.from_numpy(mover.center + mover.translations).float()
        centers = spread_centers(points[own], count, center)
        for b, c in enumerate(centers, start=first):
            motions.centers[b] = c
            turns[:, b] = quaternions(rotations)
            shifts[:, b, :3] = rotations @ (c - center) + path - c
        nearest = torch.cdist(points[own], centers).argmin(1) + first
        logits = torch.full((num_bases, int(own.sum())), -OWN)
        logits[first : first + count] = -OWN * 0.5
        logits.scatter_(0, nearest[None], 0.0)
        field.mixture_logits[:, : len(points)][:, own] = logits
        first += count


def bases_per_mover(sizes: Tensor, num_bases: int) -> list[int]:
    """How many of `num_bases` each mover gets, by its `sizes` (M,): at least one."""
    counts = [1] * len(sizes)
    while sum(counts) < num_bases:
        counts[int(torch.argmax(sizes.double() / torch.tensor(counts)))] += 1
    return counts


def spread_centers(points: Tensor, count: int, center: Tensor) -> Tensor:
    """`count` places (count, 3) spread over points (P, 3) by k-means from a
    farthest-point start; the given center where one is enough or points are too few.
    """
    if count == 1 or len(points) < count:
        return center.expand(count, 3).clone()
    chosen = [points[(points - points.mean(0)).norm(dim=-1).argmax()]]
    for _ in range(count - 1):
        chosen.append(points[torch.cdist(points, torch.stack(chosen)).amin(1).argmax()])
    start = torch.stack(chosen).double().numpy()
    with warnings.catch_warnings():  # coinciding points leave a cluster empty, which is fine
        warnings.simplefilter("ignore", UserWarning)
        places, _ = kmeans2(points.double().numpy(), start, iter=KMEANS_ROUNDS, minit="matrix")
    return torch.from_numpy(places).to(points)


def quaternions(rotations: Tensor) -> Tensor:
    """Unit quaternions (T, 4) w x y z of rotations (T, 3, 3), without sign jumps from
    one to the next.
    """
    xyzw = Rotation.from_matrix(rotations.double().numpy()).as_quat()
    products = np.einsum("tk,tk->t", xyzw[1:], xyzw[:-1])
    signs = np.cumprod(np.concatenate([[1.0], np.where(products < 0, -1.0, 1.0)]))
    xyzw = xyzw * signs[:, None]
    return torch.from_numpy(xyzw[:, [3, 0, 1, 2]]).to(rotations)
