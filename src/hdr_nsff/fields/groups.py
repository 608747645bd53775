"""Moving things as rigid groups: chains of optical flow lifted by depth, gathered into things that move together, and each thing's
rigid motion over the clip by robust fits (Kabsch 1976, with iteratively reweighted residuals)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

STRIDE = 3  # pixels between tracks
STARTS = 12  # frames in which tracks start
SHORTEST = 3  # frames a track must last
LINK = 6.0  # pixels: neighbours in a picture
PARTING = 1.5  # pixels a frame: neighbours that never part faster belong together
SMALLEST = 0.04  # of all tracks: smaller groups join the nearest one
ROUNDS = 4  # of fitting poses to canonical points and back


@dataclass(frozen=True)
class View:
    """What one training time knows of moving pixels, as numpy."""

    moving: np.ndarray  # (H, W) bool
    points: np.ndarray  # (H, W, 3) every pixel at its depth, scene units
    trust: np.ndarray  # (H, W) of the depth
    flow: dict[int, np.ndarray]  # {+-1: (H, W, 2)} pixels to the neighbouring times
    valid: dict[int, np.ndarray]  # {+-1: (H, W) bool}


@dataclass(frozen=True)
class Tracks:
    """`N` chains of flow over `T` times."""

    pixels: np.ndarray  # (N, T, 2) xy, NaN where unseen
    points: np.ndarray  # (N, T, 3) scene units, NaN where unseen
    trust: np.ndarray  # (N, T), 0 where unseen


@dataclass(frozen=True)
class Group:
    """A thing that moves as one."""

    rotations: np.ndarray  # (T, 3, 3) from the canonical place
    shifts: np.ndarray  # (T, 3): x(t) = R (x - centre) + centre + shift
    centre: np.ndarray  # (3,) canonical
    members: np.ndarray  # indices of its tracks

    def canonical(self, points: np.ndarray, t: int) -> np.ndarray:
        """Where `points` (P, 3) of time t are canonically."""
        return (points - self.centre - self.shifts[t]) @ self.rotations[t] + self.centre


def follow(views: list[View]) -> Tracks:
    """Chains of flow through moving pixels, both ways from a few starting frames."""
    num = len(views)
    parts = [chain(views, s) for s in sorted({round(i) for i in np.linspace(0, num - 1, min(STARTS, num)).tolist()})]
    pixels = np.concatenate(parts)
    points, trust = np.full((*pixels.shape[:2], 3), np.nan), np.zeros(pixels.shape[:2])
    for t, view in enumerate(views):
        seen = np.isfinite(pixels[:, t, 0])
        x, y = pixels[seen, t].astype(int).T
        points[seen, t], trust[seen, t] = view.points[y, x], view.trust[y, x] + 0.02
    lasting = (trust > 0).sum(1) >= min(SHORTEST, num)
    return Tracks(pixels[lasting], points[lasting], trust[lasting])


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
    """Pixels (N, 2) one time on; NaN where the flow is not believed or leaves the moving pixels."""
    h, w = view.moving.shape
    seen = np.isfinite(at[:, 0])
    x, y = np.where(seen, at[:, 0], 0).astype(int), np.where(seen, at[:, 1], 0).astype(int)
    out = at + view.flow[step][y, x]
    nx, ny = np.nan_to_num(out[:, 0], nan=-1), np.nan_to_num(out[:, 1], nan=-1)
    inside = seen & view.valid[step][y, x] & (nx >= 0) & (ny >= 0) & (nx < w) & (ny < h)
    landed = following.moving[ny.clip(0, h - 1).astype(int), nx.clip(0, w - 1).astype(int)]
    return np.where((inside & landed)[:, None], out, np.nan)


def gather(tracks: Tracks) -> list[np.ndarray]:
    """Tracks that move together: neighbours in a picture that never part, joined. Largest first; crumbs join the nearest."""
    n, num = tracks.trust.shape
    found = [np.zeros((0, 2), int)]
    for t in range(num):
        seen = np.nonzero(tracks.trust[:, t])[0]
        if len(seen):
            found.append(seen[cKDTree(tracks.pixels[seen, t]).query_pairs(LINK, output_type="ndarray")])
    links = np.unique(np.concatenate(found), axis=0)
    links = links[parting(tracks, links) < PARTING]
    graph = coo_matrix((np.ones(len(links)), links.T), (n, n))
    _, label = connected_components(graph, directed=False)
    groups = sorted((np.nonzero(label == k)[0] for k in np.unique(label)), key=len, reverse=True)
    large = [g for g in groups if len(g) >= SMALLEST * n] or groups[:1]
    return absorb(tracks, large, [g for g in groups if not any(g is k for k in large)])


def parting(tracks: Tracks, pairs: np.ndarray) -> np.ndarray:
    """How far (P,), in pixels a frame, the tracks of each pair (P, 2) move against each other at worst; infinite if seen together too briefly."""
    out = np.full(len(pairs), np.inf)
    for some in np.array_split(np.arange(len(pairs)), max(len(pairs) // 20000, 1)):
        apart = tracks.pixels[pairs[some, 0]] - tracks.pixels[pairs[some, 1]]  # (P, T, 2)
        speed = np.linalg.norm(np.diff(apart, axis=1), axis=-1)
        together = np.isfinite(speed)
        worst = np.where(together, speed, 0).max(1)
        out[some] = np.where(together.sum(1) >= min(SHORTEST, tracks.trust.shape[1]) - 1, worst, np.inf)
    return out


def absorb(tracks: Tracks, large: list[np.ndarray], crumbs: list[np.ndarray]) -> list[np.ndarray]:
    """Each crumb added to the group whose mean pixel comes closest to its own at some time both are seen."""
    num = tracks.trust.shape[1]

    def middle(g: np.ndarray) -> np.ndarray:
        seen = tracks.trust[g] > 0
        total = np.where(seen[..., None], tracks.pixels[g], 0).sum(0)
        return np.where(seen.sum(0)[:, None] > 0, total / np.maximum(seen.sum(0), 1)[:, None], np.nan).reshape(num, 2)

    centres = [middle(g) for g in large]
    extra: list[list[np.ndarray]] = [[] for _ in large]
    for crumb in crumbs:
        distance = [np.nan_to_num(np.linalg.norm(c - middle(crumb), axis=-1), nan=np.inf).min() for c in centres]
        extra[int(np.argmin(distance))].append(crumb)
    return [np.concatenate([g, *e]) for g, e in zip(large, extra, strict=True)]


def rigid(source: np.ndarray, target: np.ndarray, weight: np.ndarray, rounds: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and shift (3,) with target = R source + shift, robust; no rotation from fewer than 6 points."""
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
    """The rigid motion of a group of tracks over all times, smoothed; times at which it is unseen are interpolated."""
    points, trust = tracks.points[members], tracks.trust[members]
    num = points.shape[1]
    start = int(np.argmax((trust > 0).sum(0)))
    centre = np.nanmedian(points[:, start], 0)
    points = points - centre
    rotations, shifts, known = np.tile(np.eye(3), (num, 1, 1)), np.zeros((num, 3)), np.zeros(num, bool)
    known[start] = True
    for step in (1, -1):
        last = start
        for t in range(start + step, num if step > 0 else -1, step):
            both = (trust[:, last] > 0) & (trust[:, t] > 0)
            if both.sum() >= 3:
                r, s = rigid(points[both, last], points[both, t], np.minimum(trust[both, last], trust[both, t]))
                rotations[t], shifts[t], known[t] = r @ rotations[last], r @ shifts[last] + s, True
                last = t
    for _ in range(ROUNDS):
        rotations, shifts = refit(points, trust, rotations, shifts, known)
        rotations, shifts = smoothed(rotations, shifts, known)
    return Group(rotations, shifts, centre, members)


def canonical_points(
    points: np.ndarray, trust: np.ndarray, rotations: np.ndarray, shifts: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Each track's canonical place (N, 3): the median over the times with a known pose, NaN where there are none."""
    back = np.einsum("tji,ntj->nti", rotations, points - shifts)
    back[(trust <= 0) | ~known] = np.nan
    out = np.full((len(points), 3), np.nan)
    some = np.isfinite(back[..., 0]).any(1)
    out[some] = np.nanmedian(back[some], 1)
    return out


def refit(
    points: np.ndarray, trust: np.ndarray, rotations: np.ndarray, shifts: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Every known pose fitted to the canonical places that all times agree on."""
    canonical = canonical_points(points, trust, rotations, shifts, known)
    rotations, shifts = rotations.copy(), shifts.copy()
    for t in np.nonzero(known)[0]:
        seen = (trust[:, t] > 0) & np.isfinite(canonical[:, 0])
        if seen.sum() >= 6:
            rotations[t], shifts[t] = rigid(canonical[seen], points[seen, t], trust[seen, t])
    return rotations, shifts


def smoothed(rotations: np.ndarray, shifts: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses averaged with their neighbours in time (1, 2, 1); unknown ones between known ones interpolated, outer ones held."""
    at, times = np.nonzero(known)[0], np.arange(len(known))
    flat = np.concatenate([rotations.reshape(-1, 9), shifts], 1)
    flat = np.stack([np.interp(times, at, column[at]) for column in flat.T], 1)
    flat = ndimage.convolve1d(flat, [0.25, 0.5, 0.25], axis=0, mode="nearest")
    u, _, vt = np.linalg.svd(flat[:, :9].reshape(-1, 3, 3))
    sign = np.sign(np.linalg.det(u @ vt))
    vt[:, 2] *= sign[:, None]
    return u @ vt, flat[:, 9:]
