"""Moving things as rigid groups: chains of optical flow lifted by depth, gathered into
things that move together, and each thing's rigid motion over the clip by robust fits
(Kabsch 1976, with iteratively reweighted residuals).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from inspect import signature

import numpy as np
from scipy import ndimage
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackNoConvergence, eigsh
from scipy.spatial import cKDTree

STRIDE = 3  # pixels between tracks
STARTS = 12  # frames in which tracks start
AVERAGE = 2  # pixels: how far around flow is averaged before it is followed
UNLIKE = 2.0  # pixels: flows that differ more are of different things
SHORTEST = 3  # frames a track must last
LINK = 6.0  # pixels: neighbors in a picture
PARTING = 1.0  # pixels a frame: neighbors that part faster hardly belong together
PARTS = 10  # the graph is cut into, before joining
RESTARTS = (
    {"rng": 0} if "rng" in signature(eigsh).parameters else {}
)  # newer SciPy draws restarts from chance otherwise
CUTTING = 1000  # iterations; a graph that holds together takes ten
WORSE = 1.3  # times the residual that two groups have alone is still one motion
RELIEF = 0.1  # of a thing's size: what wrong depth may add to a residual
MOST = 1000  # tracks that groups are found from
GAP = 6  # frames a thing may be out of sight
SMALLEST = 0.04  # of all tracks: smaller groups are left out
ROUNDS = 4  # of fitting poses to canonical points and back


@dataclass(frozen=True)
class View:
    """What one training time knows of moving pixels, as numpy."""

    moving: np.ndarray  # (H, W) bool
    points: np.ndarray  # (H, W, 3) every pixel at its depth, scene units
    trust: np.ndarray  # (H, W) of the depth
    flow: dict[int, np.ndarray]  # {+-1: (H, W, 2)} pixels to the neighboring times
    valid: dict[int, np.ndarray]  # {+-1: (H, W) bool}


@dataclass(frozen=True)
class Tracks:
    """`N` chains of flow over `T` times."""

    pixels: np.ndarray  # (N, T, 2) xy, NaN where unseen
    points: np.ndarray  # (N, T, 3) scene units, NaN where unseen
    trust: np.ndarray  # (N, T), 0 where unseen
    patch: np.ndarray  # (N, T) which connected patch of moving pixels it lies in, 0 where unseen
    age: np.ndarray  # (N, T) steps of flow since its start: errors add up

    def between(self, a: int, b: int) -> Tracks:
        """What is known of the times from `a` to before `b`."""
        return Tracks(
            *(v[:, a:b] for v in (self.pixels, self.points, self.trust, self.patch, self.age))
        )


@dataclass(frozen=True)
class Group:
    """A thing that moves as one."""

    rotations: np.ndarray  # (T, 3, 3) from the canonical place
    shifts: np.ndarray  # (T, 3): x(t) = R (x - center) + center + shift
    center: np.ndarray  # (3,) canonical
    members: np.ndarray  # indices of its tracks
    # (T,) bool: times at which enough of it was seen; poses between are interpolated,
    # outer ones held
    known: np.ndarray

    def between(self, a: int, b: int) -> Group:
        """The motion at the times from `a` to before `b`."""
        return Group(
            self.rotations[a:b], self.shifts[a:b], self.center, self.members, self.known[a:b]
        )

    def extended(self, start: int, known: np.ndarray) -> Group:
        """The motion over all times, `known` (T,) at some of them, of one that begins
        at `start`: before and after it goes straight on.
        """
        num, at = len(self.shifts), np.arange(len(known)) - start
        inside = at.clip(0, num - 1)
        speed = np.stack(
            [
                self.shifts[min(1, num - 1)] - self.shifts[0],
                self.shifts[-1] - self.shifts[max(num - 2, 0)],
            ]
        )
        beyond = (at - inside)[:, None] * speed[(at > 0).astype(int)]
        return Group(
            self.rotations[inside], self.shifts[inside] + beyond, self.center, self.members, known
        )

    def canonical(self, points: np.ndarray, t: int) -> np.ndarray:
        """Where `points` (P, 3) of time t are canonically."""
        return (points - self.center - self.shifts[t]) @ self.rotations[t] + self.center


def follow(views: list[View]) -> Tracks:
    """Chains of flow through moving pixels, both ways from a few starting frames."""
    num = len(views)
    starts = sorted({round(i) for i in np.linspace(0, num - 1, min(STARTS, num)).tolist()})
    views = [
        replace(
            view, flow={o: settled(f, view.valid[o] & view.moving) for o, f in view.flow.items()}
        )
        for view in views
    ]
    parts = [chain(views, s) for s in starts]
    age = np.concatenate(
        [
            np.tile(np.abs(np.arange(num) - s), (len(p), 1))
            for s, p in zip(starts, parts, strict=True)
        ]
    )
    pixels = np.concatenate(parts)
    points, trust = np.full((*pixels.shape[:2], 3), np.nan), np.zeros(pixels.shape[:2])
    patch = np.zeros(pixels.shape[:2], int)
    for t, view in enumerate(views):
        seen = np.isfinite(pixels[:, t, 0])
        x, y = pixels[seen, t].astype(int).T
        points[seen, t], trust[seen, t] = view.points[y, x], view.trust[y, x] + 0.02
        patch[seen, t] = ndimage.label(view.moving)[0][y, x]
    lasting = (trust > 0).sum(1) >= min(SHORTEST, num)
    return Tracks(pixels[lasting], points[lasting], trust[lasting], patch[lasting], age[lasting])


def settled(flow: np.ndarray, told: np.ndarray) -> np.ndarray:
    """`flow` (H, W, 2) averaged over the pixels around that are `told` (H, W) and move
    alike; NaN where none tell.
    """
    reach = range(-AVERAGE, AVERAGE + 1)
    flow, told = np.where(told[..., None], flow, 0).astype(np.float32), told.astype(np.float32)
    weight, total = np.zeros_like(told), np.zeros_like(flow)
    for shift in itertools.product(reach, reach):
        other = np.roll(flow, shift, (0, 1))
        alike = np.roll(told, shift, (0, 1)) * told * (np.abs(other - flow).max(-1) < UNLIKE)
        weight += alike
        total += other * alike[..., None]
    return np.where((weight > 0)[..., None], total / np.maximum(weight, 1)[..., None], np.nan)


def chain(views: list[View], start: int) -> np.ndarray:
    """Pixels (N, T, 2) of the chains that start in one frame."""
    inner = ndimage.binary_erosion(views[start].moving)
    y, x = np.nonzero(inner)
    keep = (x % STRIDE == 0) & (y % STRIDE == 0)
    out = np.full((int(keep.sum()), len(views), 2), np.nan)
    out[:, start] = np.stack([x[keep], y[keep]], -1) + 0.5
    for step in (1, -1):
        t = start
        while 0 <= t + step < len(views) and step in views[t].flow:
            out[:, t + step] = advance(views[t], views[t + step], step, out[:, t])
            t += step
    return out


def advance(view: View, following: View, step: int, at: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) one time on; NaN where the flow is not believed or leaves the
    moving pixels.
    """
    h, w = view.moving.shape
    seen = np.isfinite(at[:, 0])
    x, y = np.where(seen, at[:, 0], 0).astype(int), np.where(seen, at[:, 1], 0).astype(int)
    places = np.where(seen[:, None], at, 0.5)[:, ::-1].T - 0.5
    moved = np.stack(
        [
            ndimage.map_coordinates(view.flow[step][..., c], places, order=1, mode="nearest")
            for c in (0, 1)
        ],
        -1,
    )
    parted = np.abs(moved - view.flow[step][y, x]).max(-1) > 0.5 * UNLIKE  # between two things
    out = np.where(parted[:, None], np.nan, at + moved)
    nx, ny = np.nan_to_num(out[:, 0], nan=-1), np.nan_to_num(out[:, 1], nan=-1)
    inside = seen & view.valid[step][y, x] & (nx >= 0) & (ny >= 0) & (nx < w) & (ny < h)
    landed = following.moving[ny.clip(0, h - 1).astype(int), nx.clip(0, w - 1).astype(int)]
    return np.where((inside & landed)[:, None], out, np.nan)


def gather(tracks: Tracks, smallest: float = SMALLEST) -> list[Group]:
    """Things that move as one, of a share `smallest` of the tracks at least, largest
    first: parts of the graph of neighboring tracks, joined again where one rigid motion
    explains both.
    """
    label = parts(tracks)
    few = np.unique(
        np.linspace(0, len(label) - 1, MOST).astype(int)
    )  # enough to tell motions apart
    members = [np.nonzero(label == k)[0] for k in range(label.max() + 1)]
    found = [np.intersect1d(m, few) for m in members]
    groups = {k: fit(tracks, m) for k, m in enumerate(m for m in found if len(m) >= 3)}
    cost: dict[tuple[int, int], float] = {}  # most pairs survive a round
    while pair := best_pair(tracks, groups, cost):
        a, b = (groups.pop(k) for k in pair)
        groups[max(*groups, *pair) + 1] = fit(tracks, np.concatenate([a.members, b.members]))
    everyone = [np.nonzero(np.isin(label, label[g.members]))[0] for g in groups.values()]
    large = [m for m in everyone if len(m) >= smallest * len(label)] or everyone[:1]
    return [fit(tracks, m) for m in sorted(large, key=len, reverse=True)]


def best_pair(
    tracks: Tracks, groups: dict[int, Group], cost: dict[tuple[int, int], float]
) -> tuple[int, int] | None:
    """The two groups that one motion explains best compared to their own; None where
    none does nearly as well. Fills `cost`.
    """
    pairs = list(itertools.combinations(sorted(groups), 2))
    for a, b in pairs:
        if (a, b) not in cost:
            cost[a, b] = (
                excess(tracks, groups[a], groups[b])
                if meet(tracks, groups[a], groups[b])
                else np.inf
            )
    best = min(pairs, key=lambda ab: cost[ab], default=None)
    return best if best is not None and cost[best] < 1 else None


def excess(tracks: Tracks, a: Group, b: Group) -> float:
    """What one motion for two groups costs: its worst residual over what is allowed."""
    both = fit(tracks, np.concatenate([a.members, b.members]))
    ratios, size = [], min(size_of(tracks, a), size_of(tracks, b))
    for g in (a, b):
        alone, joint = residuals(tracks, g, g.members), residuals(tracks, both, g.members)
        told = np.isfinite(alone) & np.isfinite(joint)
        ratios.append(
            np.median(joint[told]) / (WORSE * np.median(alone[told]) + RELIEF * size + 1e-9)
            if told.any()
            else np.inf
        )
    return float(max(ratios))


def size_of(tracks: Tracks, group: Group) -> float:
    """Median distance of a group's points from their middle at the time, scene units."""
    points = tracks.points[group.members]
    points = points[:, np.isfinite(points[..., 0]).any(0)]
    return float(np.nanmedian(np.linalg.norm(points - np.nanmedian(points, 0), axis=-1)))


def parts(tracks: Tracks) -> np.ndarray:
    """A part (N,) for every track: normalized cuts (Shi & Malik 2000) through the graph
    of neighbors, too many rather than too few.
    """
    n, num = tracks.trust.shape
    if num < 2 or n < 3 * PARTS:
        return np.zeros(n, int)
    pairs = neighbors(tracks)
    strength = affinity(tracks, pairs)
    graph = coo_matrix((strength, pairs.T), (n, n)).tocsr()
    graph = graph + graph.T + diags(np.full(n, 1e-6))
    scale = diags(1 / np.sqrt(np.asarray(graph.sum(1)).ravel()))
    start = np.random.default_rng(0).standard_normal(n)
    try:
        _, vectors = eigsh(
            scale @ graph @ scale, PARTS, which="LA", v0=start, maxiter=CUTTING, **RESTARTS
        )
    except ArpackNoConvergence:  # the graph lies in pieces, which are parts already
        piece = connected_components(graph)[1]
        rank = np.argsort(np.argsort(-np.bincount(piece), kind="stable"))
        return np.minimum(rank[piece], PARTS - 1)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-12
    return kmeans2(vectors, PARTS, minit="++", rng=np.random.default_rng(0))[1]


def neighbors(tracks: Tracks) -> np.ndarray:
    """Pairs (P, 2) of tracks that come near each other in a picture."""
    found = [np.zeros((0, 2), int)]
    for t in range(tracks.trust.shape[1]):
        seen = np.nonzero(tracks.trust[:, t])[0]
        if len(seen):
            found.append(
                seen[cKDTree(tracks.pixels[seen, t]).query_pairs(LINK, output_type="ndarray")]
            )
    return np.unique(np.concatenate(found), axis=0)


def affinity(tracks: Tracks, pairs: np.ndarray) -> np.ndarray:
    """How sure (P,) it is that two tracks belong together: frames they share, less the
    faster they part.
    """
    out = np.zeros(len(pairs))
    for some in np.array_split(np.arange(len(pairs)), max(len(pairs) // 20000, 1)):
        apart = tracks.pixels[pairs[some, 0]] - tracks.pixels[pairs[some, 1]]  # (P, T, 2)
        speed = np.linalg.norm(np.diff(apart, axis=1), axis=-1)
        together = np.isfinite(speed)
        worst = np.where(together, speed, 0).max(1)
        out[some] = together.sum(1) * np.exp(-((worst / PARTING) ** 2))
    return out


def residuals(tracks: Tracks, group: Group, members: np.ndarray) -> np.ndarray:
    """Median distance (N,) of each of some tracks from where a group's motion puts its
    canonical place, scene units; NaN if never known.
    """
    points, trust = tracks.points[members], tracks.trust[members] * group.known
    canonical = canonical_points(
        points - group.center, trust, group.rotations, group.shifts, group.known
    )
    moved = np.einsum("tij,nj->nti", group.rotations, canonical) + group.shifts + group.center
    distance = np.where(trust > 0, np.linalg.norm(moved - points, axis=-1), np.nan)
    out = np.full(len(members), np.nan)
    enough = (trust > 0).sum(1) >= 0.7 * (tracks.trust[members] > 0).sum(1)
    out[enough] = np.nanmedian(distance[enough], 1)
    return out


def apart(tracks: Tracks, a: Group, b: Group) -> bool:
    """Whether two groups lie in different patches of moving pixels too often to be one
    thing.
    """
    different = together = 0
    for t in range(tracks.trust.shape[1]):
        seen = [tracks.patch[g.members, t][tracks.trust[g.members, t] > 0] for g in (a, b)]
        if min(len(s) for s in seen) >= 3:
            together += 1
            different += np.bincount(seen[0]).argmax() != np.bincount(seen[1]).argmax()
    return different >= 2 and different > 0.3 * together


def meet(tracks: Tracks, a: Group, b: Group) -> bool:
    """Whether two groups are seen together, or one where the other left off, and may be
    one thing.
    """
    if apart(tracks, a, b):
        return False
    seen_a, seen_b = ((tracks.trust[g.members] > 0).sum(0) >= 3 for g in (a, b))
    if (seen_a & seen_b).sum() >= SHORTEST:
        return True
    times_a, times_b = np.nonzero(seen_a)[0], np.nonzero(seen_b)[0]
    if not len(times_a) or not len(times_b):
        return False
    i, j = min(itertools.product(times_a, times_b), key=lambda ij: abs(ij[0] - ij[1]))
    here, there = tracks.points[a.members, i], tracks.points[b.members, j]
    gap = np.linalg.norm(np.nanmedian(here, 0) - np.nanmedian(there, 0))
    size = np.nanmedian(np.linalg.norm(here - np.nanmedian(here, 0), axis=-1))
    return bool(gap < 3 * size and abs(int(i) - int(j)) <= GAP)


def rigid(
    source: np.ndarray, target: np.ndarray, weight: np.ndarray, rounds: int = 5
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and shift (3,) with target = R source + shift, robust; no
    rotation from fewer than 6 points.
    """
    w = weight.copy()
    for _ in range(rounds):
        total = w.sum() + 1e-12
        a, b = (w[:, None] * source).sum(0) / total, (w[:, None] * target).sum(0) / total
        r = np.eye(3)
        if len(source) >= 6:
            u, _, vt = np.linalg.svd((w[:, None] * (source - a)).T @ (target - b))
            r = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt).T
        shift = b - r @ a
        residual = np.linalg.norm(source @ r.T + shift - target, axis=-1)
        w = weight / (1 + (residual / (np.median(residual) + 1e-9)) ** 2)
    return r, shift


def fit(tracks: Tracks, members: np.ndarray) -> Group:
    """The rigid motion of a group of tracks over all times, smoothed; times at which it
    is unseen are interpolated.
    """
    points, trust = tracks.points[members], tracks.trust[members]
    num = points.shape[1]
    start = int(np.argmax((trust > 0).sum(0)))
    center = np.nanmedian(points[:, start], 0)
    points = points - center
    rotations, shifts, known = (
        np.tile(np.eye(3), (num, 1, 1)),
        np.zeros((num, 3)),
        np.zeros(num, bool),
    )
    known[start] = True
    for step in (1, -1):
        last = start
        for t in range(start + step, num if step > 0 else -1, step):
            both = (trust[:, last] > 0) & (trust[:, t] > 0)
            if both.sum() >= 3:
                r, s = rigid(
                    points[both, last],
                    points[both, t],
                    np.minimum(trust[both, last], trust[both, t]),
                )
                rotations[t], shifts[t], known[t] = r @ rotations[last], r @ shifts[last] + s, True
                last = t
            elif (
                (trust[:, t] > 0).sum() >= 6
            ):  # nothing links the two times: the thing has not turned, its middle has moved on
                here, before = (np.nanmedian(points[:, k], 0) for k in (t, last))
                rotations[t], shifts[t], known[t] = (
                    rotations[last],
                    shifts[last] + here - before,
                    True,
                )
                last = t
    for _ in range(ROUNDS):
        rotations, shifts = smoothed(*refit(points, trust, rotations, shifts, known), known)
    return Group(rotations, shifts, center, members, known)


def canonical_points(
    points: np.ndarray,
    trust: np.ndarray,
    rotations: np.ndarray,
    shifts: np.ndarray,
    known: np.ndarray,
) -> np.ndarray:
    """Each track's canonical place (N, 3): the median over the times with a known pose,
    NaN where there are none.
    """
    back = np.einsum("tji,ntj->nti", rotations, points - shifts)
    back[(trust <= 0) | ~known] = np.nan
    out = np.full((len(points), 3), np.nan)
    some = np.isfinite(back[..., 0]).any(1)
    out[some] = np.nanmedian(back[some], 1)
    return out


def refit(
    points: np.ndarray,
    trust: np.ndarray,
    rotations: np.ndarray,
    shifts: np.ndarray,
    known: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Every known pose fitted to the canonical places that all times agree on."""
    canonical = canonical_points(points, trust, rotations, shifts, known)
    rotations, shifts = rotations.copy(), shifts.copy()
    for t in np.nonzero(known)[0]:
        seen = (trust[:, t] > 0) & np.isfinite(canonical[:, 0])
        if seen.sum() >= 6:
            rotations[t], shifts[t] = rigid(canonical[seen], points[seen, t], trust[seen, t])
    return rotations, shifts


def smoothed(
    rotations: np.ndarray, shifts: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses averaged with their neighbors in time (1, 2, 1); unknown ones between known
    ones interpolated, outer ones held.
    """
    at, times = np.nonzero(known)[0], np.arange(len(known))
    flat = np.concatenate([rotations.reshape(-1, 9), shifts], 1)
    flat = np.stack([np.interp(times, at, column[at]) for column in flat.T], 1)
    flat = ndimage.convolve1d(flat, [0.25, 0.5, 0.25], axis=0, mode="nearest")
    u, _, vt = np.linalg.svd(flat[:, :9].reshape(-1, 3, 3))
    sign = np.sign(np.linalg.det(u @ vt))
    vt[:, 2] *= sign[:, None]
    return u @ vt, flat[:, 9:]
