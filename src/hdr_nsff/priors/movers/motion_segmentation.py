"""Moving things told apart by what their motions explain in pixels: groups of tracks
(`groups.py`), found with depth that may be wrong, get shapes (`bundle.py`), and every
track goes to the motion that explains it over its whole life, its neighbors' lives
included.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from hdr_nsff.core.progress import track
from hdr_nsff.priors.movers.bundle import Cameras, Problem, Shape, State, adjust
from hdr_nsff.priors.movers.rigid_groups import (
    GAP,
    SHORTEST,
    SMALLEST,
    Group,
    Tracks,
    affinity,
    apart,
    fit,
    gather,
    neighbors,
)

LEAST_TRACKS = 60  # of a group that can be adjusted
# standard deviations: reprojection error of a shape, or of a track by one, that is
# believed
GOOD = 1.5
ROUNDS = 3  # of sharing out tracks and adjusting the groups that changed
# standard deviations: of motions that explain a track as well as this, the larger
# group's counts
AS_GOOD = 0.25
WHOLE = 0.7  # of a track's life a motion must be known for
TURNS = 6  # iterations that place a track's point by given poses
PIECE = 0.5  # of the least group: a thing that was hidden may come back for so little
STRAY = 0.1  # of a group's tracks: where fewer are seen they are strays
FAR = 4.0  # of a thing's radius in the picture: no further off does it come back
SETTLED = 0.01  # of a group's tracks: fewer changes change nothing


Found = tuple[Group, Shape | None]


def things(tracks: Tracks, cameras: Cameras) -> list[Found]:
    """Groups of tracks, largest first, each with its shape where its tracks tell one."""
    return groups_by_motion(tracks, [g.members for g in gather(tracks, PIECE * SMALLEST)], cameras)


def groups_by_motion(tracks: Tracks, members: list[np.ndarray], cameras: Cameras) -> list[Found]:
    """The same from groups that may be mixed or in pieces: tracks shared out anew,
    pieces joined, rest left out.
    """
    found = shaped(tracks, members, [], cameras)
    if any(shape for _, shape in found):
        found = settled(tracks, found, cameras)
    return [
        f
        for i, f in enumerate(found)
        if i == 0 or len(f[0].members) >= SMALLEST * len(tracks.trust)
    ]


def settled(tracks: Tracks, found: list[Found], cameras: Cameras) -> list[Found]:
    """Groups joined, and tracks shared out between them, until hardly any changes."""
    near = nearness(tracks)
    for _ in range(ROUNDS):
        found = joined(tracks, found, cameras)
        before = [g.members for g, _ in found]
        owner = share_out(before, misfits(tracks, [s for _, s in found], cameras, near))
        if all(same(m, np.nonzero(owner == k)[0]) for k, m in enumerate(before)):
            break
        found = shaped(tracks, members_of(owner), found, cameras)
    return found


def shaped(
    tracks: Tracks, groups: list[np.ndarray], known: list[Found], cameras: Cameras
) -> list[Found]:
    """Groups of given members, and their shapes; of those that hardly changed what is
    `known`.
    """
    return [
        next((k for k in known if same(k[0].members, m)), None) or with_shape(tracks, m, cameras)
        for m in track(groups, "things that move")
    ]


def with_shape(tracks: Tracks, members: np.ndarray, cameras: Cameras) -> Found:
    """A group of given members, and its shape."""
    group = fit(tracks, members)
    return group, shape_of(tracks, group, cameras)


def joined(tracks: Tracks, found: list[Found], cameras: Cameras) -> list[Found]:
    """Groups made one where one motion explains the tracks of both about as well as
    their own do.
    """
    found, tried = list(found), set()
    while pair := next(
        (p for p in combinations(range(len(found)), 2) if ids(found, p) not in tried), None
    ):
        tried.add(ids(found, pair))
        (a, _), (b, _) = pieces = [found[k] for k in pair]
        if not may_be_one(tracks, a, b):
            continue
        both = with_shape(tracks, np.union1d(a.members, b.members), cameras)
        if both[1] and all(about_as_good(tracks, piece, both[1], cameras) for piece in pieces):
            found = sorted(
                [both, *(f for k, f in enumerate(found) if k not in pair)],
                key=lambda f: -len(f[0].members),
            )
    return found


def may_be_one(tracks: Tracks, a: Group, b: Group) -> bool:
    """Whether two groups lie in one patch where they are seen together, or one begins
    about where and when the other ends.
    """
    counts = [(tracks.trust[g.members] > 0).sum(0) for g in (a, b)]
    seen_a, seen_b = (c >= max(SHORTEST, STRAY * c.max()) for c in counts)
    if not (seen_a.any() and seen_b.any()):
        return False
    if (seen_a & seen_b).sum() >= SHORTEST:
        return not apart(tracks, a, b)
    i, j = min(
        product(np.nonzero(seen_a)[0], np.nonzero(seen_b)[0]),
        key=lambda ij: abs(int(ij[0]) - int(ij[1])),
    )
    here, there = (np.nanmedian(tracks.pixels[g.members, t], 0) for g, t in ((a, i), (b, j)))
    radius = max(
        radius_of(tracks.pixels[g.members][:, seen]) for g, seen in ((a, seen_a), (b, seen_b))
    )
    return bool(abs(int(i) - int(j)) <= GAP and np.linalg.norm(here - there) < FAR * radius)


def radius_of(pixels: np.ndarray) -> float:
    """How far tracks (N, T, 2), some seen at every time, are from their middle in the
    pictures: the median.
    """
    return float(np.nanmedian(np.linalg.norm(pixels - np.nanmedian(pixels, 0), axis=-1)))


def ids(found: list[Found], pair: tuple[int, ...]) -> tuple[int, ...]:
    """What tells a pair of groups from others: how many tracks they have, and their
    first.
    """
    return tuple(int(v) for k in pair for v in (len(found[k][0].members), found[k][0].members[0]))


def about_as_good(tracks: Tracks, alone: Found, both: Shape, cameras: Cameras) -> bool:
    """Whether the motion of `both` explains the tracks of a group about as well as its
    own does, if it has one.
    """
    group, shape = alone
    own = np.median(misfit(tracks, shape, cameras)[group.members]) if shape else GOOD - AS_GOOD
    return bool(np.median(misfit(tracks, both, cameras)[group.members]) < own + AS_GOOD)


def shape_of(tracks: Tracks, group: Group, cameras: Cameras) -> Shape | None:
    """The group's shape and motion where its tracks tell them."""
    if len(group.members) < LEAST_TRACKS or len(cameras.K) < 4:
        return None
    shape = adjust(tracks, group, cameras)
    return shape if shape.error < GOOD else None


def members_of(owner: np.ndarray) -> list[np.ndarray]:
    """The groups, largest first, that tracks with one `owner` (N,) make; -1 and groups
    of few tracks are left out.
    """
    members = sorted(
        (np.nonzero(owner == k)[0] for k in range(owner.max(initial=-1) + 1)), key=len, reverse=True
    )
    return [
        m
        for i, m in enumerate(members)
        if len(m) >= PIECE * SMALLEST * len(owner) or (i == 0 and len(m))
    ]


def same(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether two groups have the same members but for a few."""
    return len(np.setxor1d(before, after)) <= SETTLED * len(before)


def nearness(tracks: Tracks) -> csr_matrix:
    """How much tracks listen to their neighbors in the pictures (N, N), rows of sum 1
    at most.
    """
    n, pairs = len(tracks.trust), neighbors(tracks)
    graph = coo_matrix((affinity(tracks, pairs), pairs.T), (n, n)).tocsr()
    graph = graph + graph.T
    total = np.maximum(np.asarray(graph.sum(1)).ravel(), 1e-9)
    return csr_matrix(graph.multiply(1 / total[:, None]))


def misfits(
    tracks: Tracks, shapes: list[Shape | None], cameras: Cameras, near: csr_matrix
) -> np.ndarray:
    """Reprojection errors (N, K) of every track by every motion in standard deviations,
    averaged with its neighbors'; inf where there is no shape or its motion is not
    known.
    """
    life = (tracks.trust > 0).sum(1).astype(float)  # a long track tells more
    out = np.full((len(life), len(shapes)), np.inf)
    for k, shape in enumerate(shapes):
        if shape is None:
            continue
        own = misfit(tracks, shape, cameras)
        told = np.isfinite(own)
        weight = life * told
        around = near @ weight
        total = np.where(told, own, 0) * weight + near @ (np.where(told, own, 0) * weight)
        out[told, k] = (total / np.maximum(weight + around, 1e-9))[told]
    return out


def misfit(tracks: Tracks, shape: Shape, cameras: Cameras) -> np.ndarray:
    """Mean reprojection error (N,) of every track, its point placed as well as the
    shape's motion lets it, in standard deviations.
    """
    group = replace(shape.group, members=np.arange(len(tracks.trust)))
    problem = Problem(tracks, group, cameras)
    state = problem.points_for(State(problem.start, group.rotations, group.shifts), TURNS)
    error = np.linalg.norm(problem.residuals(state)[0], axis=-1) / problem.noise
    known = problem.seen.sum(1)
    whole = known >= WHOLE * (tracks.trust[problem.use] > 0).sum(1)
    out = np.full(len(tracks.trust), np.inf)
    mean = np.where(problem.seen, error, 0).sum(1) / np.maximum(known, 1)
    out[problem.use] = np.where(whole & np.isfinite(mean), mean, np.inf)
    return out


def share_out(before: list[np.ndarray], cost: np.ndarray) -> np.ndarray:
    """The group (N,) of every track: of those that explain it about as well as the best
    and well enough, the largest; else the one that it was in, -1 for none.
    """
    owner = np.full(len(cost), -1)
    for k, members in enumerate(before):
        owner[members] = k
    fine = (cost <= cost.min(1, keepdims=True) + AS_GOOD) & (cost < GOOD)
    return np.where(fine.any(1), fine.argmax(1), owner)
