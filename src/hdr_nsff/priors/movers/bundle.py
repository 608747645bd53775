"""Bundle adjustment of one moving thing: its shape and its rigid motion from tracks in
cameras with known poses.

A thing that turns, or that a moving camera goes round, shows its relief as a static
scene does; only how far away it is as a whole stays a matter of the prior.
Levenberg-Marquardt with the points eliminated (Triggs et al., "Bundle adjustment: a
modern synthesis", 1999), Huber weights, weak priors on the mean z-depth of every time,
on the path's third differences, whose covariance is estimated with it, and on the
shape.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.rigid_groups import Group, Tracks, canonical_points

ITERATIONS = 25
REVERSALS = 4  # rounds of looking for reversed depth
SPLIT = 3  # frames between the times tried, at least
SPLITS = 12  # times tried, about
QUICK = 8  # iterations that tell whether a try is better
BETTER = 0.98  # of the cost: what a reversal must gain
MOST = 200  # tracks that poses are found from
FEWEST = 3  # tracks that have a shape
NOISE = 0.4  # pixels: standard deviation of one step of a track; neighbors share their errors
# how well mean z-depth is known, as a share of it: one observation of all times that
# tracks join ...
FAR_SIGMA = 0.25
UNSURE, FAR_SIGMA_SURE = (
    0.52,
    0.01,
)  # ... where it is trusted no more than the one (geometry claims 0.5), and fully
FAR_SIGMA_ALONE = 0.02  # the same of every time of a path too short to tell
# of the path's third differences, as a share of z-depth, in the direction in which it
# is smoothest
PATH_SIGMA = 0.001
ROUGH = 0.01  # the same before anything is known
LEAST_ROWS = 6  # third differences that tell how smooth a path is, and so how far away
SMOOTHINGS = 4  # rounds of telling how smooth the path is in which direction
TURN_SIGMA = np.radians(2.0)  # of the second differences of its turning
SHAPE_SIGMA = 2.0  # of a point's distance from the thing's middle, as a share of the thing's size


@dataclass(frozen=True)
class Cameras:
    """Known cameras of the tracks' times."""

    K: np.ndarray  # (T, 3, 3) pixels
    c2w: np.ndarray  # (T, 3, 4) OpenCV, scene units


@dataclass(frozen=True)
class Shape:
    """A group with the place of every one of its tracks."""

    group: Group
    points: np.ndarray  # (N, 3) canonical, scene units; NaN where unknown
    # median reprojection error in its standard deviations; inf where no track could be
    # placed
    error: float

    def at(self, t: int) -> np.ndarray:
        """World points (N, 3) at a time."""
        g = self.group
        return (self.points - g.center) @ g.rotations[t].T + g.center + g.shifts[t]


def adjust(tracks: Tracks, group: Group, cameras: Cameras) -> Shape:
    """The shape and motion that explain the tracks' pixels best, from the motion that
    depth gave, or from none where that is better.
    """
    times = np.nonzero((tracks.trust[group.members] > 0).any(0))[0]
    a, b = (
        (int(times[0]), int(times[-1]) + 1) if len(times) else (0, len(cameras.K))
    )  # what is not seen costs as much time
    shape = adjusted(
        tracks.between(a, b), group.between(a, b), Cameras(cameras.K[a:b], cameras.c2w[a:b])
    )
    return replace(shape, group=shape.group.extended(a, group.known))


def adjusted(tracks: Tracks, group: Group, cameras: Cameras) -> Shape:
    """The same of a group that is seen at the first and the last time."""
    points = np.full((len(group.members), 3), np.nan)
    some, solved = group.members[telling(tracks.trust[group.members] > 0, MOST)], []
    for start in (group, without_turning(tracks, group)):
        problem = Problem(tracks, replace(start, members=some), cameras)
        if problem.use.sum() >= FEWEST:
            solved.append(
                (
                    *problem.solve(State(problem.start, start.rotations, start.shifts), ITERATIONS),
                    problem,
                    start,
                )
            )
    if not solved:
        return Shape(group, points, np.inf)
    state, cost, problem, start = min(solved, key=lambda s: s[1])
    state = problem.unreversed(state, cost)
    for _ in range(SMOOTHINGS):
        problem.roughened(state)
        state, _ = problem.solve(state, ITERATIONS)
    every = Problem(tracks, start, cameras)
    state = every.points_for(state)
    points[every.use] = state.points + group.center
    error = (np.linalg.norm(every.residuals(state)[0], axis=-1) / every.noise)[every.seen]
    return Shape(
        replace(start, rotations=state.rotations, shifts=state.shifts),
        points,
        float(np.median(error)),
    )


def telling(seen: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the tracks `seen` (N, T) at some times, in order: at every
    time the longest.
    """
    length = seen.sum(1)
    order = np.argsort(-length, kind="stable")
    rank = np.where(seen[order], np.cumsum(seen[order], 0), len(seen) + 1).min(
        1, initial=len(seen) + 1
    )
    return np.sort(order[np.argsort(rank, kind="stable")[:most]])


def without_turning(tracks: Tracks, group: Group) -> Group:
    """The group's path as its tracks' median steps tell it, without rotation: rotations
    fitted to flat depth would mislead.
    """
    points, trust = tracks.points[group.members], tracks.trust[group.members] > 0
    num, seen = trust.shape[1], trust.sum(0) >= 3
    start = int(np.argmax(trust.sum(0)))
    shifts = np.zeros((num, 3))
    for step in (1, -1):
        last = start
        for t in range(start + step, num if step > 0 else -1, step):
            both = trust[:, t] & trust[:, last]
            shifts[t] = shifts[t - step]
            if both.sum() >= 3:
                shifts[t], last = (
                    shifts[last] + np.median(points[both, t] - points[both, last], 0),
                    t,
                )
            elif seen[t]:
                shifts[t], last = (
                    shifts[last] + np.nanmedian(points[:, t], 0) - np.nanmedian(points[:, last], 0),
                    t,
                )
    return replace(group, rotations=np.tile(np.eye(3), (num, 1, 1)), shifts=shifts, known=seen)


@dataclass(frozen=True)
class State:
    """What is looked for, about the group's center."""

    points: np.ndarray  # (N, 3)
    rotations: np.ndarray  # (T, 3, 3)
    shifts: np.ndarray  # (T, 3)


class Problem:
    """Residuals, their derivatives and a damped step."""

    def __init__(self, tracks: Tracks, group: Group, cameras: Cameras) -> None:
        seen = (tracks.trust[group.members] > 0) & group.known
        points = tracks.points[group.members] - group.center
        start = canonical_points(
            points, seen.astype(float), group.rotations, group.shifts, group.known
        )
        use = np.isfinite(start[:, 0]) & (seen.sum(1) >= 2)
        seen, start, self.use = seen[use], start[use], use  # which members can be placed at all
        self.pixels = np.nan_to_num(tracks.pixels[group.members][use])  # (N, T, 2)
        self.seen, self.start, self.K = seen, start, cameras.K
        self.noise = NOISE * np.sqrt(1.0 + tracks.age[group.members][use])  # (N, T) pixels
        self.w2c = np.swapaxes(cameras.c2w[:, :, :3], 1, 2)  # (T, 3, 3)
        self.eye = cameras.c2w[:, :, 3] - group.center
        self.middle = np.median(start, 0) if len(start) else np.zeros(3)
        self.size = (
            np.median(np.linalg.norm(start - self.middle, axis=-1)) + 1e-9 if len(start) else 1.0
        )
        prior = np.einsum(
            "tj,ntj->nt",
            self.w2c[:, 2],
            tracks.points[group.members][use] - group.center - self.eye,
        )
        count = np.maximum(seen.sum(0), 1)
        self.mean_depth = np.where(seen, np.nan_to_num(prior), 0).sum(0) / count  # (T,)
        self.told = seen.sum(0) >= 3
        self.second = (
            np.diff(np.eye(len(self.K)), n=2, axis=0)
            if len(self.K) > 2
            else np.zeros((0, len(self.K)))
        )
        self.third = (
            np.diff(np.eye(len(self.K)), n=3, axis=0)
            if len(self.K) > 3
            else np.zeros((0, len(self.K)))
        )
        self.unit = np.median(self.mean_depth[self.told]) if self.told.any() else 1.0
        self.nearing = (
            self.told[:, None] * self.w2c[:, 2] / max(int(self.told.sum()), 1)
        )  # (T, 3) of the distance by the shifts
        self.path_scale = (
            np.eye(3) / ROUGH
        )  # (3, 3): makes third differences, as shares of z-depth, standard deviations
        linked = (seen[:, 1:] & seen[:, :-1]).sum(0) >= FEWEST
        piece = np.concatenate(
            [[0], np.cumsum(~linked)]
        )  # (T,) times that tracks join: within, depth is known but for a factor
        self.rows = ((np.abs(self.third) > 0) @ ~self.told == 0) & (piece[3:] == piece[:-3])
        each = np.bincount(piece, self.told)[piece]
        tells = self.rows.sum() >= LEAST_ROWS
        trust = tracks.trust[group.members][use][seen]
        sure = np.clip((np.median(trust) - UNSURE) / (1 - UNSURE), 0, 1) if len(trust) else 0.0
        far = FAR_SIGMA + (FAR_SIGMA_SURE - FAR_SIGMA) * sure
        self.far_sigma = self.unit * (
            far * np.sqrt(np.maximum(each, 1))
            if tells
            else np.full(len(self.K), min(far, FAR_SIGMA_ALONE))
        )

    def solve(self, state: State, iterations: int) -> tuple[State, float]:
        """The best state nearby and its cost."""
        cost, damping = self.cost(state), 1e-3
        for _ in range(iterations):
            trial = self.step(state, damping)
            new = self.cost(trial)
            state, cost, damping = (
                (trial, new, damping / 4) if new < cost else (state, cost, damping * 8)
            )
            if damping > 1e6:
                break
        return state, cost

    def points_for(self, state: State, iterations: int = ITERATIONS) -> State:
        """The same poses with all of this problem's points placed as they say."""
        points, spread = self.on_rays(state), self.spread(state)
        middle = np.median(points, 0)
        for _ in range(iterations):
            error, turned, local = self.residuals(replace(state, points=points))
            _, point, weight = self.slopes(error, turned, local, state)
            V = (
                np.einsum("ntij,ntik->njk", point * weight[..., None], point)
                + np.eye(3) / spread**2
            )
            slope = (
                np.einsum("ntij,nti->nj", point * weight[..., None], error)
                + (points - middle) / spread**2
            )
            points = points - np.linalg.solve(V, slope[..., None])[..., 0]
        return replace(state, points=points)

    def on_rays(self, s: State) -> np.ndarray:
        """Canonical places (N, 3) of points as far away as the thing's center: the
        median over time.
        """
        depth = np.einsum("tj,tj->t", self.w2c[:, 2], s.shifts - self.eye)
        rays = (self.pixels - self.K[:, :2, 2]) / self.K[:, [0, 1], [0, 1]]
        local = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1) * depth[:, None]
        back = np.einsum(
            "tji,ntj->nti",
            s.rotations,
            np.einsum("tji,ntj->nti", self.w2c, local) + self.eye - s.shifts,
        )
        return np.nanmedian(np.where(self.seen[..., None], back, np.nan), 1)

    def unreversed(self, state: State, cost: float) -> State:
        """The state with depth no longer reversed: seen from afar, a thing turning one
        way and its mirror image turning the other look alike (Necker 1832), and a start
        without relief may take either, a different one at different times. Perspective
        tells.
        """
        num = len(self.K)
        for _ in range(REVERSALS):
            apart = max(SPLIT, num // SPLITS)
            splits = [*range(apart, num - apart // 2, apart), num]
            tries = [self.solve(self.reversed(state, k), QUICK) for k in splits]
            best, lowest = min(tries, key=lambda t: t[1])
            if lowest > BETTER * cost:
                break
            state, cost = self.solve(best, ITERATIONS)
        return state

    def reversed(self, s: State, split: int) -> State:
        """The state with its depth mirrored before the time `split`, joined there to
        what follows.
        """
        k = min(split, len(self.K) - 1)
        view = s.shifts[k] - self.eye[k]
        view = view / np.linalg.norm(view)
        mirror = np.eye(3) - 2 * np.outer(view, view)
        joined = s.rotations[k].T @ mirror @ s.rotations[k]
        rotations, points = s.rotations.copy(), s.points.copy()
        rotations[:split] = mirror @ s.rotations[:split] @ joined
        before = self.seen[:, :split].sum(1) > 0.5 * self.seen.sum(1)
        middle = np.median(points[before], 0) if before.any() else np.zeros(3)
        points[before] = (points[before] - middle) @ joined + middle
        return State(points, rotations, s.shifts)

    def residuals(self, s: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Reprojection errors (N, T, 2) px, the turned points (N, T, 3), camera points
        (N, T, 3).
        """
        turned = np.einsum("tij,nj->nti", s.rotations, s.points)
        local = np.einsum("tij,ntj->nti", self.w2c, turned + s.shifts - self.eye)
        z = np.maximum(local[..., 2:], 1e-3 * self.unit)
        focal, center = self.K[:, [0, 1], [0, 1]], self.K[:, :2, 2]
        return (
            np.where(self.seen[..., None], local[..., :2] / z * focal + center - self.pixels, 0),
            turned,
            local,
        )

    def priors(
        self, s: State, local: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Residuals in standard deviations: mean z-depth (T,), third differences of the
        path (T - 3, 3), second ones of the turning (T - 2, 3), shape (N, 3).
        """
        turns = Rotation.from_matrix(
            s.rotations[1:] @ np.swapaxes(s.rotations[:-1], 1, 2)
        ).as_rotvec()
        turning = np.diff(turns, axis=0) / TURN_SIGMA
        mean = np.where(self.seen, local[..., 2], 0).sum(0) / np.maximum(self.seen.sum(0), 1)
        far = np.where(self.told, (mean - self.mean_depth) / self.far_sigma, 0)
        path = self.third @ s.shifts / self.distance(s) @ self.path_scale
        return far, path, turning, (s.points - self.middle) / self.spread(s)

    def distance(self, s: State) -> float:
        """How far away the thing is on the whole: its mean z-depth."""
        return max(float((self.nearing * (s.shifts - self.eye)).sum()), 0.05 * self.unit)

    def spread(self, s: State) -> float:
        """Standard deviation of a point's distance from the middle, which grows with
        the thing's distance as pixels leave it open.
        """
        return SHAPE_SIGMA * self.size * self.distance(s) / self.unit

    def path_slopes(self, s: State, path: np.ndarray) -> np.ndarray:
        """Derivatives (T - 3, 3, T, 3) of the path's residuals by the shifts. They are
        shares of the distance: else all would do well to come nearer, as whatever is
        near moves little.
        """
        out = (
            self.third[:, None, :, None] * self.path_scale[:, None]
            - path[..., None, None] * self.nearing
        )
        return out / self.distance(s)

    def roughened(self, s: State) -> None:
        """Believe in smooth paths as far as this state's is, in every direction by
        itself, where it was seen for long enough to tell. What goes to and fro does so
        along a line or in a plane: across it nothing but the camera's own shake is
        left, which tells the distance.
        """
        if self.rows.sum() >= LEAST_ROWS:
            path = (self.third @ s.shifts)[self.rows] / self.distance(s)
            variance, axes = np.linalg.eigh(path.T @ path / len(path) + PATH_SIGMA**2 * np.eye(3))
            self.path_scale = axes / np.sqrt(variance) @ axes.T

    def cost(self, s: State) -> float:
        """Huber cost of everything."""
        error, _, local = self.residuals(s)
        length = np.linalg.norm(error, axis=-1) / self.noise
        huber = np.where(length < 1, 0.5 * length**2, length - 0.5)[self.seen].sum()
        return float(huber + 0.5 * sum((r**2).sum() for r in self.priors(s, local)))

    def slopes(
        self, error: np.ndarray, turned: np.ndarray, local: np.ndarray, s: State
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the reprojection errors by pose (N, T, 2, 6: turn, shift) and
        by point (N, T, 2, 3), and weights (N, T, 1).
        """
        length = np.linalg.norm(error, axis=-1) / self.noise
        weight = (self.seen / np.maximum(length, 1) / self.noise**2)[..., None]  # (N, T, 1)
        z = np.maximum(local[..., 2], 1e-3 * self.unit)
        fx, fy = self.K[:, 0, 0], self.K[:, 1, 1]
        zero = np.zeros_like(z)
        projection = np.stack(
            [fx / z, zero, -fx * local[..., 0] / z**2, zero, fy / z, -fy * local[..., 1] / z**2], -1
        )
        to_world = projection.reshape(*z.shape, 2, 3) @ self.w2c  # (N, T, 2, 3)
        pose = np.concatenate([-to_world @ cross(turned), to_world], -1)  # (N, T, 2, 6)
        point = to_world @ s.rotations  # (N, T, 2, 3)
        return pose, point, weight

    def step(self, s: State, damping: float) -> State:
        """The state after one damped Gauss-Newton step; the points' 3x3 blocks are
        eliminated.
        """
        error, turned, local = self.residuals(s)
        far, path, turning, shape = self.priors(s, local)
        n, num = self.seen.shape
        pose, point, weight = self.slopes(error, turned, local, s)
        wp, wx = pose * weight[..., None], point * weight[..., None]
        U = np.einsum("ntij,ntik->tjk", wp, pose)
        V = np.einsum("ntij,ntik->njk", wx, point)
        W = np.einsum("ntij,ntik->ntjk", wp, point)  # (N, T, 6, 3)
        gp = np.einsum("ntij,nti->tj", wp, error)
        gx = np.einsum("ntij,nti->nj", wx, error)
        V, gx = V + np.eye(3) / self.spread(s) ** 2, gx + shape / self.spread(s)
        W[:, :, 3:] -= (self.nearing / self.distance(s))[None, :, :, None] * (
            shape / self.spread(s)
        )[:, None, None]
        row = (
            np.concatenate([np.zeros((num, 3)), self.w2c[:, 2]], -1)
            / self.far_sigma[:, None]
            * self.told[:, None]
        )
        U, gp = U + row[:, :, None] * row[:, None], gp + row * far[:, None]
        full = np.zeros((num, 6, num, 6))
        full[np.arange(num), :, np.arange(num)] = U
        smooth = self.path_slopes(s, path).reshape(path.size, 3 * num)
        full[:, 3:, :, 3:] += (smooth.T @ smooth).reshape(num, 3, num, 3)
        gp[:, 3:] += (smooth.T @ path.reshape(-1)).reshape(num, 3) - (
            shape**2
        ).sum() * self.nearing / self.distance(s)
        nearing = np.sqrt((shape**2).sum()) * self.nearing.reshape(-1) / self.distance(s)
        full[:, 3:, :, 3:] += np.outer(nearing, nearing).reshape(num, 3, num, 3)
        for axis in range(3):
            full[:, axis, :, axis] += self.second.T @ self.second / TURN_SIGMA**2
        gp[:, :3] += self.second.T @ turning / TURN_SIGMA
        full, gp = full.reshape(6 * num, 6 * num), gp.reshape(-1)
        full[np.diag_indices(6 * num)] *= 1 + damping
        full[np.diag_indices(6 * num)] += 1e-9 * np.trace(full) / len(full) + 1e-12
        V[:, np.arange(3), np.arange(3)] *= 1 + damping
        inverse = np.linalg.inv(V)
        flat = W.reshape(n, num * 6, 3)
        carried = flat @ inverse  # (N, 6T, 3)
        reduced = full - np.tensordot(carried, flat, ((0, 2), (0, 2)))
        delta = np.linalg.solve(reduced, -gp + np.einsum("nij,nj->i", carried, gx))
        moved = -np.einsum("nij,nj->ni", inverse, gx + np.einsum("nij,i->nj", flat, delta))
        turn, shift = delta.reshape(num, 6)[:, :3], delta.reshape(num, 6)[:, 3:]
        rotations = Rotation.from_rotvec(turn).as_matrix() @ s.rotations
        return State(s.points + moved, rotations, s.shifts + shift)


def cross(v: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) that take the cross product with `v` (..., 3) from the left."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)
