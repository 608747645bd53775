"""Start a field of Gaussians from the prepared scene: static ones where the depth prior
puts what stands still, moving ones on the rigid motions that flow and depth tell, in
the radiance that the initial response recovers from what did not clip.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from hdr_nsff.fields.knots import knot_of
from hdr_nsff.fields.point_cloud import CELLS_PER_KIND as CELLS
from hdr_nsff.fields.point_cloud import PointCloud as Points
from hdr_nsff.fields.point_cloud import ToRadiance
from hdr_nsff.fields.point_cloud import assign_cells as cells_for
from hdr_nsff.fields.point_cloud import concatenate as joined
from hdr_nsff.fields.point_cloud import merge_by_cell as thinned
from hdr_nsff.fields.point_cloud import thin_points as thinned_to
from hdr_nsff.fields.point_cloud import unproject_frame as lift
from hdr_nsff.fields.space import FrustumSpace, build_space
from hdr_nsff.fields.splat.gaussians import Gaussians, from_log_radiance
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.priors.movers.bundle import Cameras, Shape
from hdr_nsff.priors.movers.motion_segmentation import things
from hdr_nsff.priors.movers.mover_shape import apply
from hdr_nsff.priors.movers.rigid_groups import Group, Tracks, View, follow
from hdr_nsff.scene.scene import Frame, Scene

# a cell is this many times longer along the view than across, as shares of the frustum
DEPTH_CELLS = 12.0
FILL = 0.95  # of the places are used at once; the rest go where the error is
OVERLAP = 0.6  # standard deviation relative to the distance to the neighbors
OPACITY = 0.7
KEY_FRAMES = 12  # times whose moving pixels become Gaussians
ABSENT = -6.0  # logit offset of what is not seen
OWN = 4.0  # logit of the nearest basis over the others


def seed(
    field: Splat, scene: Scene, to_radiance: ToRadiance, typical: float, from_priors: bool = True
) -> str:
    """Place all Gaussians; one sentence about what was found. `typical` is the median
    log radiance.
    """
    frames = scene.train
    with torch.no_grad():
        field.background[:] = from_log_radiance(torch.tensor(typical), field.bounded)
        if not from_priors or any(f.disparity is None for f in frames):
            scatter(field, scene, typical)
            return "static Gaussians start at random places and moving ones not at all, without a depth prior in scene units"
        static = joined(
            [lift(f, i, still(f), scene.near, scene.far, to_radiance) for i, f in enumerate(frames)]
        )
        count = place(field.static, thin(static, scene, int(FILL * len(field.static))))
        groups, moving = movers(field, scene, to_radiance)
        return f"{count} static Gaussians from the depth prior; {moving} moving ones in {groups} groups"


def still(f: Frame) -> Tensor:
    """(H * W,) bool: pixels safely outside the moving mask."""
    if f.moving is None:
        return torch.ones(f.image.shape[0] * f.image.shape[1], dtype=torch.bool)
    near = nn.functional.max_pool2d(f.moving[None, None].float(), 3, 1, 1)[0, 0] > 0
    return ~near.reshape(-1)


def thin(points: Points, scene: Scene, limit: int) -> Points:
    """At most `limit` points, one per cell: pixel-shaped in a frustum, cubes elsewhere."""
    space = build_space([f.camera for f in scene.train], scene.near, scene.far)
    coords = space.encode(points.positions)
    if isinstance(space, FrustumSpace):
        extent = space.high - space.low
        coords = coords * torch.stack([extent[0], extent[1], extent[0] / DEPTH_CELLS]) / extent[0]
    return thinned_to(points, coords, limit)


def place(gaussians: Gaussians, points: Points) -> int:
    """Put the first Gaussians at the points, as wide as their neighbors are away; the
    others stay invisible. How many.
    """
    n = min(len(points), len(gaussians))
    if n == 0:
        return 0
    apart = torch.from_numpy(neighbor_distance(points.positions[:n].numpy())).float()
    spacing = apart.clamp(min=0.3 * points.footprint[:n], max=8 * points.footprint[:n])
    gaussians.means[:n] = points.positions[:n]
    gaussians.log_scales[:n] = (OVERLAP * spacing).log()[:, None]
    gaussians.logits[:n] = math.log(OPACITY / (1 - OPACITY))
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
        parts.append(Points(positions, torch.full((per, 3), typical), torch.ones(per), footprint))
    place(field.static, joined(parts))


# Movers


def movers(field: Splat, scene: Scene, to_radiance: ToRadiance) -> tuple[int, int]:
    """Fit groups and their motions, share out the bases, place moving Gaussians; how
    many groups and Gaussians.
    """
    views, frame_of = views_of(field, scene)
    frames = [scene.train[i] for i in frame_of]
    if not any(v.moving.any() for v in views):
        return 0, 0
    tracks = follow(views)
    cameras = [f.camera for f in frames]
    known = Cameras(
        *(
            torch.stack(m).double().numpy()
            for m in ([c.K for c in cameras], [c.c2w for c in cameras])
        )
    )
    found = things(tracks, known)[: field.config.bases] if len(tracks.trust) else []
    groups = [shape.group if shape else group for group, shape in found] or [drift(views)]
    frames = [
        relieved(f, t, tracks, [shape for _, shape in found if shape]) for t, f in enumerate(frames)
    ]
    seen = [t for t, v in enumerate(views) if v.moving.any()]
    key = sorted(
        {seen[round(i)] for i in np.linspace(0, len(seen) - 1, min(KEY_FRAMES, len(seen))).tolist()}
    )
    parts = [
        mover_points(scene, frames[t], frame_of[t], t, tracks, groups, to_radiance) for t in key
    ]
    points, owner = joined([p for p, _ in parts]), torch.cat([o for _, o in parts])
    limit = int(FILL * len(field.moving))
    cell = cells_for(points.positions, owner, limit)  # groups never share one
    kept, kept_owner = thinned(points, cell), torch.unique(cell) // CELLS
    count = place(field.moving, kept)
    hide_unseen(field, tracks, groups, kept_owner[:count])
    share_bases(field, groups, kept.positions[:count], kept_owner[:count])
    field.find_neighbors()
    return len(groups), count


def mover_points(
    scene: Scene,
    f: Frame,
    i: int,
    t: int,
    tracks: Tracks,
    groups: list[Group],
    to_radiance: ToRadiance,
) -> tuple[Points, Tensor]:
    """The moving pixels of a frame (the `i`-th of training, at time `t`) as points at
    their canonical places, and the group of each (P,).
    """
    moving = surely_moving(f)
    f = replace(f, moving=moving)
    points = lift(f, i, moving.reshape(-1), scene.near, scene.far, to_radiance)
    owner = owner_of(f, t, tracks, groups)
    canonical = points.positions.double().numpy().copy()
    for g, group in enumerate(groups):
        canonical[owner == g] = group.canonical(canonical[owner == g], t)
    positions = torch.from_numpy(canonical).float()
    return Points(positions, points.log_radiance, points.trust, points.footprint), torch.from_numpy(
        owner
    )


def surely_moving(f: Frame) -> Tensor:
    """(H, W) bool: the moving mask without its doubtful outline; small and thin things
    stay whole.
    """
    assert f.moving is not None
    if f.outline is None:
        return f.moving
    things, count = ndimage.label(f.moving.numpy())
    sure = f.moving & ~f.outline
    whole = ~np.isin(np.arange(count + 1), np.unique(things[sure.numpy()]))
    return sure | (f.moving & torch.from_numpy(whole[things]))


def relieved(f: Frame, t: int, tracks: Tracks, shapes: list[Shape]) -> Frame:
    """The frame of time `t` with the depth that the movers' shapes tell."""
    assert f.disparity is not None and f.moving is not None
    disparity = f.disparity.numpy().copy()
    confidence = (
        np.ones_like(disparity)
        if f.disparity_confidence is None
        else f.disparity_confidence.numpy().copy()
    )
    apply(f.moving.numpy(), f.camera.c2w.double().numpy(), t, tracks, shapes, disparity, confidence)
    return replace(
        f, disparity=torch.from_numpy(disparity), disparity_confidence=torch.from_numpy(confidence)
    )


def views_of(field: Splat, scene: Scene) -> tuple[list[View], list[int]]:
    """What the movers look like at every training time (one frame of each), and the
    frames' positions.
    """
    chosen: dict[int, int] = {}
    for i, f in enumerate(scene.train):
        chosen.setdefault(round(knot_of(field.times, f.time)), i)
    views = []
    for k in sorted(chosen):
        f = scene.train[chosen[k]]
        assert f.disparity is not None
        shape = f.image.shape[:2]
        moving = np.zeros(shape, bool) if f.moving is None else surely_moving(f).numpy()
        rays = f.camera.rays(f.camera.pixel_grid())
        points = rays.origins + rays.directions / f.disparity.reshape(-1, 1).clamp(
            1 / scene.far, 1 / scene.near
        )
        trust = np.ones(shape) if f.disparity_confidence is None else f.disparity_confidence.numpy()
        leads = [
            o for o in f.flow if chosen.get(k + o) == f.neighbors.get(o)
        ]  # to a frame that speaks for its time
        flow, valid = ({o: v[o].numpy() for o in leads} for v in (f.flow, f.flow_valid))
        views.append(View(moving, points.view(*shape, 3).double().numpy(), trust, flow, valid))
    return views, [chosen[k] for k in sorted(chosen)]


def drift(views: list[View]) -> Group:
    """The fallback where flow gives no chains: all that moves follows the median of its
    points.
    """
    centers = np.array(
        [np.median(v.points[v.moving], 0) if v.moving.any() else np.full(3, np.nan) for v in views]
    )
    at, times = np.nonzero(np.isfinite(centers[:, 0]))[0], np.arange(len(views))
    centers = np.stack([np.interp(times, at, c[at]) for c in centers.T], 1)
    centers = ndimage.gaussian_filter1d(centers, 1.0, axis=0, mode="nearest")
    return Group(
        np.tile(np.eye(3), (len(views), 1, 1)),
        centers - centers[0],
        centers[0],
        np.zeros(0, int),
        np.isin(times, at),
    )


def owner_of(f: Frame, t: int, tracks: Tracks, groups: list[Group]) -> np.ndarray:
    """The group of every moving pixel of a frame (row by row): that of the nearest
    track in the picture.
    """
    assert f.moving is not None
    y, x = np.nonzero(f.moving.numpy())
    at, label = [], []
    for g, group in enumerate(groups):
        pixels = tracks.pixels[group.members, t] if len(group.members) else np.zeros((0, 2))
        pixels = pixels[np.isfinite(pixels[:, 0])]
        at.append(pixels)
        label += [g] * len(pixels)
    if not label:
        return np.zeros(len(x), np.int64)
    nearest = cKDTree(np.concatenate(at)).query(np.stack([x, y], -1) + 0.5)[1]
    return np.array(label, np.int64)[nearest]


def hide_unseen(field: Splat, tracks: Tracks, groups: list[Group], owner: Tensor) -> None:
    """Make moving Gaussians invisible at the times their group (P,) is not seen: it has
    left, or is hidden.
    """
    knots, num = len(field.opacity_offsets), field.trajectories.num_knots
    for g, group in enumerate(groups):
        if not len(group.members):
            continue
        seen = (tracks.trust[group.members] > 0).any(0)
        for k in range(knots):
            low, high = (
                int(np.clip(round((k + o) / max(knots - 1, 1) * (num - 1)), 0, num - 1))
                for o in (-1, 1)
            )
            if not seen[low : high + 1].any():
                field.opacity_offsets[k, : len(owner)][owner == g] = ABSENT


def share_bases(field: Splat, groups: list[Group], points: Tensor, owner: Tensor) -> None:
    """Give every group bases by its size (at least one), spread over it; each Gaussian
    starts with its nearest basis.
    """
    t, num_bases = field.trajectories, field.config.bases
    sizes = torch.bincount(owner, minlength=len(groups)).double()
    given = [1] * len(groups)
    while sum(given) < num_bases:
        g = int(torch.argmax(sizes / torch.tensor(given)))
        given[g] += 1
    turns, shifts = (
        t.turns.data.view(t.num_knots, num_bases, 4),
        t.shifts.data.view(t.num_knots, num_bases, 4),
    )
    field.mixture_logits[:] = 0
    b = 0
    for g, (group, count) in enumerate(zip(groups, given, strict=True)):
        own = owner == g
        centers = spread(points[own], count, torch.from_numpy(group.center).float())
        rotations = torch.from_numpy(group.rotations).float()
        for c in centers:
            t.centers[b] = c
            turns[:, b] = quaternions(rotations)
            moved = (rotations @ (c - torch.from_numpy(group.center).float())) + torch.from_numpy(
                group.center + group.shifts
            ).float()
            shifts[:, b, :3] = moved - c
            b += 1
        distance = torch.cdist(points[own], centers)
        logits = torch.full((num_bases, int(own.sum())), -OWN)
        logits[b - count : b] = -OWN * 0.5
        logits.scatter_(0, (distance.argmin(1) + b - count)[None], 0.0)
        field.mixture_logits[:, : len(points)][:, own] = logits


def spread(points: Tensor, count: int, center: Tensor) -> Tensor:
    """`count` places (count, 3) spread over points by farthest-point choice and a few
    rounds of k-means; the given center where one is enough, or the points are too few.
    """
    if count == 1 or len(points) < count:
        return center.expand(count, 3).clone()
    chosen = [points[(points - points.mean(0)).norm(dim=-1).argmax()]]
    for _ in range(count - 1):
        chosen.append(points[torch.cdist(points, torch.stack(chosen)).amin(1).argmax()])
    places = torch.stack(chosen)
    for _ in range(10):
        nearest = torch.cdist(points, places).argmin(1)
        places = torch.stack(
            [
                points[nearest == k].mean(0) if (nearest == k).any() else places[k]
                for k in range(count)
            ]
        )
    return places


def quaternions(rotations: Tensor) -> Tensor:
    """Unit quaternions (T, 4) w x y z of rotations (T, 3, 3), without sign jumps from
    one to the next.
    """
    q = torch.from_numpy(
        Rotation.from_matrix(rotations.double().numpy()).as_quat()[:, [3, 0, 1, 2]]
    ).to(rotations)
    for i in range(1, len(q)):
        if (q[i] * q[i - 1]).sum() < 0:
            q[i] = -q[i]
    return q
